"""Common parts of long commands: a line of progress on a terminal's standard error, and an end by signals."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

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
