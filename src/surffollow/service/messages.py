"""Lines on standard error and for the service manager, written by a thread of their own.

A terminal that is stopped, a full pipe, a reader that went away: a write may block for ever or fail, and
following must not notice. Lines wait in a bounded queue; those that find no room, come too fast or cannot be
written are counted.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import threading
import time
from collections import deque

from surffollow.shm.readable import wait_writable

WAITING, RESERVED = 512, 256  # lines; those for lines that count against no rate
BURST, PER_SECOND = 200.0, 50.0
STDOUT, STDERR = 1, 2
LOOK_S = 0.2  # how long a full pipe is waited for before another look
END_S = 0.5


def hold_standard_files() -> None:
    """Make the standard files safe to write to, before the first line.

    Closed ones become /dev/null before another file takes their numbers: a message would be written into
    the object with number 2, for example shared memory. A line to a terminal of which this process is not
    in the foreground (`stty tostop`) must not stop the process, cycle and all.
    """
    signal.signal(signal.SIGTTOU, signal.SIG_IGN)
    while True:
        fd = os.open(os.devnull, os.O_RDWR)
        if fd > STDERR:
            os.close(fd)
            return


class Messages:
    """A queue of lines for stdout and stderr, drained by a thread of its own.

    Attributes
    ----------
    lost : int   lines that were dropped: no room, too many per second, or a file that takes none
    unwritten : int   of them, those that found room, count against no rate and could not be written
    """

    def __init__(self) -> None:
        self.lost = self.unwritten = 0
        self._lines: deque[tuple[int, bytes, bool]] = deque()
        self._credit, self._earned_s = BURST, time.monotonic()
        self._reported = 0
        self._ready, self._over = threading.Event(), False
        self._idle = threading.Event()
        self._idle.set()
        self._thread = threading.Thread(target=self._drain, name="messages", daemon=True)

    def start(self) -> Messages:
        """Begin to write."""
        self._thread.start()
        return self

    def report(self, text: str, *, fd: int = STDERR, limited: bool = True) -> bool:
        """Queue one line; never blocks, never raises. False: it is dropped, and counted.

        `limited` False: not counted against the rate, and there is room of its own for it.
        """
        return self.write(f"surffollow: {text}\n", fd=fd, limited=limited)

    def write(self, text: str, *, fd: int = STDERR, limited: bool = True) -> bool:
        """Queue text as it is, such as READY; otherwise as `report`."""
        if len(self._lines) >= WAITING + (0 if limited else RESERVED) or (limited and not self._may()):
            self.lost += 1
            return False
        self._idle.clear()
        self._lines.append((fd, text.encode(errors="replace"), limited))
        self._ready.set()
        return True

    def _may(self) -> bool:
        now = time.monotonic()
        self._credit = min(BURST, self._credit + PER_SECOND * (now - self._earned_s))
        self._earned_s = now
        if self._credit < 1.0:
            return False
        self._credit -= 1.0
        return True

    def _drain(self) -> None:
        while True:
            self._ready.wait()
            self._ready.clear()
            while self._lines:
                fd, data, limited = self._lines.popleft()
                if not self._put(fd, data):
                    self.lost += 1
                    self.unwritten += not limited
                if self.lost > self._reported and not self._lines:
                    before, self._reported = self._reported, self.lost
                    self._put(STDERR, f"surffollow: {self._reported - before} messages were lost\n".encode())
            self._idle.set()
            if self._over:
                return

    def _put(self, fd: int, data: bytes) -> bool:
        """Write all of it; False when the file takes it no more."""
        with contextlib.suppress(OSError, ValueError):
            while data:
                # a file that other processes use, too, stays blocking: look before each write
                while not wait_writable(fd, LOOK_S):
                    if self._over:
                        return False
                data = data[os.write(fd, data[: select.PIPE_BUF]) :]
        return not data

    def end(self) -> None:
        """Give the thread a moment to write what waits; then it is left to itself."""
        if not self._thread.is_alive():
            return
        self._idle.wait(END_S)
        self._over = True
        self._ready.set()
        self._thread.join(END_S)
