"""Report the state of the service to systemd (sd_notify), and the progress of compiling to users."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable
from typing import Any

from surffollow.service.messages import STDERR

PUBLISH_EVERY_S = 0.3  # a warm start, which compiles nothing, says nothing


def sd_notify(message: str) -> bool:
    """Send one notification; False when systemd did not start us."""
    path = os.environ.get("NOTIFY_SOCKET", "")
    if not path:
        return False
    address = "\0" + path[1:] if path.startswith("@") else path
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as s:
            s.setblocking(False)  # a manager that does not read must not delay housekeeping
            s.sendto(message.encode(), address)
    except OSError:
        return False
    return True


class CompileProgress:
    """Shows which kernel numba compiles while a cold start lasts.

    Parameters
    ----------
    write : takes text for stderr and never blocks
    quiet : show nothing
    publish : takes one line for clients that wait; compiles nothing
    """

    def __init__(
        self,
        write: Callable[[str], object],
        quiet: bool = False,
        publish: Callable[[str], object] | None = None,
    ) -> None:
        self._write, self.quiet, self.count, self._publish = write, quiet, 0, publish
        self._start = self._reported = self._published = time.monotonic()
        self._tty = os.isatty(STDERR)
        self._guard: Any = None

    def __enter__(self) -> CompileProgress:
        from numba.core import event

        outer = self

        class Listener(event.Listener):  # type: ignore[misc]
            def on_start(self, happened: Any) -> None:
                outer.compiling(happened)

            def on_end(self, happened: Any) -> None:
                pass

        self._guard = event.install_listener("numba:compile", Listener())
        self._guard.__enter__()
        return self

    def compiling(self, happened: Any) -> None:
        """One more kernel begins to compile."""
        self.count += 1
        dispatcher = happened.data.get("dispatcher")
        self._report(f"{self.count}: {getattr(getattr(dispatcher, 'py_func', None), '__name__', '?')}")

    def waiting(self) -> None:
        """A second process still compiles the map's."""
        self._report("waiting for the map's")

    def _report(self, what: str) -> None:
        now = time.monotonic()
        line = f"compiling kernels for this machine, {what} ({now - self._start:.0f} s)"
        if self._publish is not None and now - self._published >= PUBLISH_EVERY_S:
            self._published = now
            self._publish(line)
        if self.quiet or now - self._reported < (0.1 if self._tty else 2.0):
            return
        self._reported = now
        text = f"surffollow: {line}"
        self._write(f"\r\033[K{text}" if self._tty else f"{text}\n")

    def __exit__(self, *exc: object) -> None:
        self._guard.__exit__(*exc)
        if self._tty and self.count and not self.quiet:
            self._write("\r\033[K")
