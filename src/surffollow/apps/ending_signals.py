"""Signals that ask a program to end: collected, for a loop that looks at them."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator

NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextlib.contextmanager
def ending_signals() -> Iterator[list[int]]:
    """A list of the numbers of SIGINT, SIGTERM and SIGHUP as they arrive; ignored ones stay ignored."""
    caught: list[int] = []
    before = {
        n: signal.signal(n, lambda number, _: caught.append(number))
        for n in NUMBERS
        if signal.getsignal(n) != signal.SIG_IGN
    }
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
