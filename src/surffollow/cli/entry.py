"""Entry point of the `surffollow` command: Ctrl-C during the imports ends the process at once.

KeyboardInterrupt would be a traceback there, or would be swallowed by a callback of the import system. What
this module imports itself is loaded by the interpreter already.
"""

from __future__ import annotations

import os
import signal


class EndedAtOnceByInterrupts:
    """Lets SIGINT end the process at once inside, with 130; where it is ignored or handled it stays so."""

    def __enter__(self) -> None:
        self._raises = signal.getsignal(signal.SIGINT) is signal.default_int_handler
        if self._raises:
            signal.signal(signal.SIGINT, lambda *_: os._exit(128 + signal.SIGINT))

    def __exit__(self, *error: object) -> None:
        if self._raises:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def main() -> None:
    """Run the command line."""
    with EndedAtOnceByInterrupts():
        from surffollow.cli.main import main as run
    run()
