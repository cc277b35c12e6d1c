"""Stand-ins for wires: a pseudo terminal, a tree of IIO files, a datagram sender, a virtual CAN bus."""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from surffollow.hw.wire.frame_format import crc16_modbus
from surffollow.shm import layout_slot as ls

# a frame of 8 bytes: AA 55, distance in µm, CRC
FRAME_FORMAT = {
    "header": "aa 55",
    "length": 8,
    "value": {"offset": 2, "type": "u32le"},
    "unit": "1 um",
    "checksum": {"kind": "crc16-modbus", "offset": 6, "type": "u16le"},
}
LINE_FORMAT = {"pattern": "(?P<range>[0-9]{3}[.][0-9]{3})", "unit": "mm", "terminator": "\r\n"}
WINDOW = {"range_min_m": 0.05, "range_max_m": 0.5}


def frame(range_m: float) -> bytes:
    """A distance as `FRAME_FORMAT` has it."""
    body = b"\xaa\x55" + struct.pack("<I", round(range_m * 1e6))
    return body + struct.pack("<H", crc16_modbus(body))


def line(range_m: float) -> bytes:
    """A distance as `LINE_FORMAT` has it."""
    return f"{1e3 * range_m:07.3f}\r\n".encode()


class Pty:
    """A pseudo terminal under a name of its own that can be pulled out and put in again."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "tty"
        self.master = -1
        self.plug()

    def plug(self) -> None:
        self.master, slave = os.openpty()
        os.set_blocking(self.master, False)
        self.path.symlink_to(os.ttyname(slave))
        self._slave = slave

    def unplug(self) -> None:
        if self.master >= 0:
            self.path.unlink()
            os.close(self._slave)
            os.close(self.master)
            self.master = -1

    def write(self, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError, OSError):  # no reader, or unplugged
            os.write(self.master, data)


@contextlib.contextmanager
def feeding(send: Callable[[float], None], period_s: float = 0.002) -> Iterator[None]:
    """Send a distance again and again from a thread: 0.100, 0.101, … 0.199 m and round again."""
    over = threading.Event()

    def run() -> None:
        k = 0
        while not over.wait(period_s):
            send(0.1 + 0.001 * (k % 100))
            k += 1

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


class FakeIio:
    """A converter with two 12-bit inputs and a time stamp: files for sysfs, a FIFO for its device."""

    def __init__(self, root: Path, name: str = "fakeadc") -> None:
        self.root, self.name = root, name
        self.folder = root / "sys/bus/iio/devices/iio:device0"
        self.fifo = root / "dev/iio:device0"
        self.plug()

    def plug(self) -> None:
        scan, buffer = self.folder / "scan_elements", self.folder / "buffer"
        for folder in (scan, buffer, self.fifo.parent):
            folder.mkdir(parents=True, exist_ok=True)
        files = {
            "name": f"{self.name}\n",
            "in_voltage_scale": "0.5\n",  # mV per count
            "in_voltage1_scale": "0.25\n",
            "in_voltage1_offset": "-8\n",
            "current_timestamp_clock": "realtime\n",
            "buffer/enable": "0\n",
            "buffer/length": "2\n",
        }
        for index, (element, text) in enumerate(
            {
                "voltage0": "le:u12/16>>4",
                "voltage1": "be:s12/16",
                "voltage2": "le:u16/32",
                "timestamp": "le:s64/64",
            }.items()
        ):
            files[f"scan_elements/in_{element}_type"] = f"{text}\n"
            files[f"scan_elements/in_{element}_index"] = f"{index}\n"
            files[f"scan_elements/in_{element}_en"] = "1\n"
        for path, text in files.items():
            (self.folder / path).write_text(text)
        os.mkfifo(self.fifo)
        self.fd = os.open(self.fifo, os.O_RDWR | os.O_NONBLOCK)

    def unplug(self) -> None:
        import shutil

        os.close(self.fd)
        self.fifo.unlink()
        shutil.rmtree(self.folder)

    def scan(self, first: int, second: int, t_ns: int | None = None) -> bytes:
        t_ns = time.monotonic_ns() if t_ns is None else t_ns
        return (
            struct.pack("<H", first << 4 | 5) + struct.pack(">h", second) + bytes(4) + struct.pack("<q", t_ns)
        )

    def write(self, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError, OSError):
            os.write(self.fd, data)


def datagrams(port: Callable[[], int]) -> Callable[[bytes], None]:
    """A sender to whichever port that is."""
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def send(data: bytes) -> None:
        with contextlib.suppress(OSError):
            sender.sendto(data, ("127.0.0.1", port()))

    return send


class Ring:
    """A ring as it lies in a slot, written as a client writes it, or wrongly."""

    def __init__(self) -> None:
        self.words = np.zeros((ls.RANGES_AT + ls.RANGE_ITEMS * ls.RangeItem.SIZE) // 8, np.int64)
        self.floats = self.words.view(np.float64)
        self.pushed: list[tuple[int, int, int, float]] = []

    @property
    def address(self) -> int:
        return int(self.words.ctypes.data)

    @property
    def head(self) -> int:
        return int(self.words[0])

    def push(self, t_ns: int, channel: int, range_m: float, number: int | None = None) -> None:
        at = ls.RANGES_AT // 8 + (self.head & (ls.RANGE_ITEMS - 1)) * ls.RangeItem.SIZE // 8
        number = self.head + 1 if number is None else number
        self.words[at : at + 3] = number, t_ns, channel
        self.floats[at + 3] = range_m
        self.words[0] = self.head + 1
        self.pushed.append((number, t_ns, channel, range_m))
