"""Common parts of long commands: a line of progress on a terminal's standard error, and an end by signals."""

from __future__ import annotations

import contextlib
import functools
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import click

from surffollow.shm.ending_signals import handle_ending


class _SignalledEvent(threading.Event):
    """An event that a signal handler may set while the same thread waits for it.

    A `threading.Event` takes a lock to wait and to be set: the handler would wait for ever. A signal just
    before the wait ends it by a byte in the pipe: its handler runs later.
    """

    def __init__(self) -> None:
        super().__init__()
        self._signalled = False
        self._read_fd, write_fd = os.pipe()
        os.set_blocking(write_fd, False)
        signal.set_wakeup_fd(write_fd, warn_on_full_buffer=False)

    def set(self) -> None:
        self._signalled = True

    def is_set(self) -> bool:
        return self._signalled

    def wait(self, timeout: float | None = None) -> bool:
        if not self._signalled and select.select([self._read_fd], [], [], timeout)[0]:
            os.read(self._read_fd, 64)  # also of a signal that sets nothing
        return self._signalled


def stop_event() -> threading.Event:
    """An event that Ctrl-C, SIGTERM and SIGHUP set, instead of ending the process (main thread only)."""
    stop = _SignalledEvent()
    handle_ending(lambda *_: stop.set())
    return stop


@contextlib.contextmanager
def progress_line() -> Iterator[Callable[[str], None] | None]:
    """A function that shows a line in the place of the one before; None without a terminal."""
    if not sys.stderr.isatty():
        yield None
        return

    def show(line: str) -> None:
        sys.stderr.write(f"\r\x1b[K{line}")
        sys.stderr.flush()

    try:
        yield show
    finally:
        sys.stderr.write("\n")


_Command = TypeVar("_Command", bound=Callable[..., Any])
COMPILING_AFTER_S = 0.5  # kernels of a usual run come out of the cache; a few small ones are compiled


def shows_compiling(command: _Command) -> _Command:
    """Show on a terminal that the function of a command compiles its kernels, which takes a minute once."""

    @functools.wraps(command)
    def shown(*words: Any, **options: Any) -> Any:
        with compiling_line():
            return command(*words, **options)

    return shown  # type: ignore[return-value]


@contextlib.contextmanager
def compiling_line() -> Iterator[None]:
    """A line on a terminal while kernels are compiled; it is cleared when that ends."""
    if not sys.stderr.isatty():
        yield
        return
    from numba.core import event

    class Listener(event.Listener):  # type: ignore[misc]
        depth = count = 0
        begin_s, shown = 0.0, False

        def on_start(self, happened: Any) -> None:
            now_s = time.monotonic()
            self.begin_s = self.begin_s or now_s
            self.depth, self.count = self.depth + 1, self.count + 1
            if now_s - self.begin_s >= COMPILING_AFTER_S:
                self.shown = True
                took = f"{self.count} ({now_s - self.begin_s:.0f} s)"
                self._write(f"\r\x1b[Ksurffollow: compiling kernels for this machine, once: {took}")

        def on_end(self, happened: Any) -> None:
            self.depth -= 1
            if self.depth == 0 and self.shown:
                self.shown = False
                self._write("\r\x1b[K")

        def _write(self, text: str) -> None:
            sys.stderr.write(text)
            sys.stderr.flush()

    with event.install_listener("numba:compile", Listener()):
        yield


class progress_bar:  # noqa: N801 - used like a function
    """A progress bar on a terminal, silence elsewhere; gives a callback for the map's writers."""

    def __init__(self, label: str) -> None:
        self._bar = (
            click.progressbar(length=1000, label=label, file=sys.stderr) if sys.stderr.isatty() else None
        )
        self._done = 0

    def __enter__(self) -> Any:
        if self._bar is None:
            return None
        self._bar.__enter__()
        return self._report

    def _report(self, fraction: float) -> None:
        if self._bar is not None:
            self._bar.update(int(1000 * fraction) - self._done)
            self._done = int(1000 * fraction)

    def __exit__(self, *error: Any) -> None:
        if self._bar is not None:
            self._bar.__exit__(*error)
