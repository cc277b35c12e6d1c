"""A range sensor that writes lines of text into a FIFO, one distance in metres per line.

[driver]
kind = "line_fifo:make"
path = "/run/laser"
"""

import os
import select
import time

from surffollow.errors import DriverError
from surffollow.hw import DriverInfo, PolledDriver, metre_info, pack_range


class LineFifo:
    """The source: opened, read and closed by `PolledDriver`, in a thread of its own."""

    def __init__(self, path: str, info: DriverInfo) -> None:
        self.name, self.rejected = f"FIFO {path}", 0
        self._path, self._info = path, info
        self._fd, self._rest = -1, b""

    def open(self) -> None:
        self._fd = os.open(self._path, os.O_RDONLY | os.O_NONBLOCK)  # waits for no writer
        self._rest = b""

    def read(self, timeout_s: float) -> list[tuple[int, int]]:
        if not select.select([self._fd], [], [], timeout_s)[0]:
            return []
        data, now_ns = os.read(self._fd, 4096), time.monotonic_ns()
        if not data:
            raise DriverError("no program writes into it")  # `PolledDriver` opens it again
        *lines, rest = (self._rest + data).split(b"\n")
        self._rest = rest[-64:]  # the beginning of the next line
        found = []
        for line in lines:
            try:
                found.append((now_ns, pack_range(self._info, 0, float(line))))  # "nan": it sees nothing
            except ValueError:
                self.rejected += 1
        return found

    def close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def make(settings: dict, name: str) -> PolledDriver:
    # window 50 mm to 500 mm; a distance is 2 ms old when its line arrives
    info = metre_info("laser on a FIFO", 0.05, 0.5, latency_ns=2_000_000)
    return PolledDriver(info, LineFifo(settings["path"], info))
