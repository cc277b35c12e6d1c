"""Signals that ask a long-running program to end: Ctrl-C, a service manager's, the closed terminal's."""

from __future__ import annotations

import signal
from collections.abc import Callable
from typing import Any


def ending_signals() -> tuple[signal.Signals, ...]:
    """SIGINT, SIGHUP and SIGTERM; without SIGHUP where it is ignored, as nohup does."""
    ignored = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    return (signal.SIGINT, *(() if ignored else (signal.SIGHUP,)), signal.SIGTERM)


def handle_ending(handler: Callable[[int, Any], object]) -> None:
    """Give each of them a handler (main thread only)."""
    for number in ending_signals():
        signal.signal(number, handler)
