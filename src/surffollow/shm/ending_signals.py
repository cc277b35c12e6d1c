"""Signals that ask a long-running program to end: Ctrl-C, a service manager's, the closed terminal's."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Callable, Iterator
from typing import Any


def ending_signals() -> tuple[signal.Signals, ...]:
    """SIGINT, SIGHUP and SIGTERM; without SIGHUP where it is ignored, as nohup does."""
    ignored = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    return (signal.SIGINT, *(() if ignored else (signal.SIGHUP,)), signal.SIGTERM)


def handle_ending(handler: Callable[[int, Any], object]) -> None:
    """Give each of them a handler (main thread only)."""
    for number in ending_signals():
        signal.signal(number, handler)


class Terminated(SystemExit):
    """A signal asked the program to end; the code is 128 and its number."""


def _ends_already() -> bool:
    """Whether the present code tidies up behind a `Terminated`."""
    error = sys.exc_info()[1]
    while error is not None and not isinstance(error, Terminated):
        error = error.__context__
    return error is not None


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP raise `Terminated`, so that everything is tidied up.

    A signal while the program tidies up has no effect. One after an exception that Python ignored, such as
    in `__del__`, raises again.
    """

    def end(number: int, _: object) -> None:
        if not _ends_already():
            raise Terminated(128 + number)

    numbers = (signal.SIGTERM, signal.SIGHUP)
    # signals that nohup ignores stay ignored
    before = {n: h for n in numbers if (h := signal.getsignal(n)) != signal.SIG_IGN}
    try:
        for n in before:
            signal.signal(n, end)
        yield
    finally:
        for n, handler in before.items():
            signal.signal(n, handler)
