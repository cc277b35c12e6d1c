"""The thread of a driver: a nogil kernel that runs until a word in memory asks it to end."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable

import numpy as np

from surffollow.errors import DriverError

# words of a control block; drivers use those from USER on as they like
STOP, USER = 0, 1
CONTROL_WORDS = 16
PERIOD_NS = 500_000
CATCH_UP_NS = 100_000_000  # a thread that was held up longer drops what it missed, and counts it
JOIN_S = 5.0
FIFO_PRIORITY = 30  # hardware does not wait for a busy machine; below the cycle, above a simulated robot


class DriverThread:
    """Runs `kernel(control address)` on its own thread.

    The kernel must not hold the GIL, must look at the word `STOP` at least every few milliseconds, and is
    called once with it set before the thread starts: so it is compiled when `start` returns.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.control = np.zeros(CONTROL_WORDS, np.int64)
        self._thread: threading.Thread | None = None
        self._kept: object = None

    @property
    def address(self) -> int:
        """Of the control words."""
        return int(self.control.ctypes.data)

    def start(self, kernel: Callable[[int], None], keep: object) -> None:
        """Compile the kernel and start the thread.

        Parameters
        ----------
        kernel : called with the address of the control words
        keep : what the kernel knows by its address only; held until the thread starts anew

        Raises
        ------
        DriverError
            when it runs already
        """
        if self._thread is not None:
            raise DriverError(f"driver '{self.name}' was started twice; stop it first")
        self._kept = keep
        self.control[STOP] = 1
        kernel(self.address)
        self.control[STOP] = 0
        self._thread = threading.Thread(target=kernel, args=(self.address,), name=self.name, daemon=True)
        self._thread.start()
        if self._thread.native_id is not None:
            with contextlib.suppress(OSError):  # not permitted: then it runs at normal priority
                param = os.sched_param(FIFO_PRIORITY)
                os.sched_setscheduler(self._thread.native_id, os.SCHED_FIFO, param)

    @property
    def running(self) -> bool:
        """True between `start` and `stop`."""
        return self._thread is not None

    def stop(self) -> None:
        """End the thread and wait for it; harmless when it does not run.

        Raises
        ------
        DriverError
            when it does not end within 5 s: its memory must not be given up then
        """
        if self._thread is None:
            return
        self.control[STOP] = 1
        self._thread.join(JOIN_S)
        if self._thread.is_alive():
            raise DriverError(f"the thread of driver '{self.name}' did not end within {JOIN_S:g} s")
        self._thread = None
