"""Signals that ask a program to end."""

from __future__ import annotations

import signal

from surffollow.shm.ending_signals import ending_signals


def test_a_closed_terminal_ends_a_program_unless_nohup_protects_it() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        assert set(ending_signals()) == {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        assert set(ending_signals()) == {signal.SIGINT, signal.SIGTERM}
    finally:
        signal.signal(signal.SIGHUP, before)
