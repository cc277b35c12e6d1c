"""Entry point of the `surffollow` command: Ctrl-C during the imports ends the process at once.

KeyboardInterrupt would be a traceback there, or would be swallowed by a callback of the import system.
"""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator


@contextlib.contextmanager
def ended_at_once_by_interrupts() -> Iterator[None]:
    """Let SIGINT end the process at once, with 130; where it is ignored or handled it stays so."""
    raises = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if raises:
        signal.signal(signal.SIGINT, lambda *_: os._exit(128 + signal.SIGINT))
    try:
        yield
    finally:
        if raises:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def main() -> None:
    """Run the command line."""
    with ended_at_once_by_interrupts():
        from surffollow.cli.main import main as run
    run()
