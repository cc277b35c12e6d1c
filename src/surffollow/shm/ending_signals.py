"""Signals that ask a long-running program to end: Ctrl-C, a service manager's, the closed terminal's."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
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


class EndedEarly(BaseException):
    """A signal to end came while kernels were being compiled; nothing in between may catch it."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def ends_already(*kinds: type[BaseException]) -> bool:
    """Whether the present code tidies up behind an exception of these kinds."""
    error = sys.exc_info()[1]
    while error is not None and not isinstance(error, kinds):
        error = error.__context__
    return error is not None


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP raise `Terminated`, so that everything is tidied up.

    A signal while the program tidies up has no effect. One after an exception that Python ignored, such as
    in `__del__`, raises again (`sent_again`).
    """

    def end(number: int, _: object) -> None:
        if not ends_already(Terminated):
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


AGAIN_S = 0.01  # a callback from C lasts less long


def _number_of(error: BaseException | None) -> int:
    """The signal whose handler raised an exception; 0: no handler did."""
    if isinstance(error, Terminated):
        return int(error.code or 0) - 128
    if isinstance(error, EndedEarly):
        return error.number
    return signal.SIGINT if isinstance(error, KeyboardInterrupt) else 0


class sent_again:  # noqa: N801 - used like a function
    """Sends a signal once more whose exception ended nothing.

    Python runs a handler between two bytecodes of the main thread, also inside a callback of the compiler's C
    code, in `__del__`, or in an import that C code of NumPy makes. Python prints an exception and continues:
    the program would run to its end, after a traceback.

    Attributes
    ----------
    number : int      of the newest signal that was lost; 0: none was
    again : Timer     sends it; None: none was lost
    """

    def __init__(self) -> None:
        self.number = 0
        self.again: threading.Timer | None = None

    def __enter__(self) -> sent_again:
        self._before = sys.unraisablehook, sys.excepthook
        unraisable, uncaught = self._before

        def ignored(lost: Any) -> None:
            if not self._is_lost(lost.exc_value):
                unraisable(lost)

        def printed(kind: Any, error: Any, trace: Any) -> None:
            if not self._is_lost(error):
                uncaught(kind, error, trace)

        sys.unraisablehook, sys.excepthook = ignored, printed
        return self

    def __exit__(self, *error: object) -> None:
        sys.unraisablehook, sys.excepthook = self._before
        if self.again is not None:
            self.again.cancel()

    def _is_lost(self, error: BaseException | None) -> bool:
        """Whether an exception is of a signal, which then comes again when the callback has ended."""
        number = _number_of(error)
        if number:
            self.number = number
            self.again = threading.Timer(AGAIN_S, os.kill, (os.getpid(), number))
            self.again.daemon = True
            self.again.start()
        return number != 0
