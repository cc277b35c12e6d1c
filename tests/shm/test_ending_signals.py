"""Signals that ask a program to end."""

from __future__ import annotations

import signal
import sys

import pytest

from surffollow.shm.ending_signals import Terminated, ended_by_signals, ending_signals


def test_a_closed_terminal_ends_a_program_unless_nohup_protects_it() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        assert set(ending_signals()) == {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        assert set(ending_signals()) == {signal.SIGINT, signal.SIGTERM}
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_signal_whose_exception_a_finalizer_swallowed_does_not_stop_later_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The handler had set SIG_IGN: every later signal was ignored."""
    swallowed: list[type[BaseException] | None] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda error: swallowed.append(error.exc_type))

    class Finalized:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGTERM)

    def work() -> None:
        made = Finalized()
        del made
        assert swallowed == [Terminated]
        signal.raise_signal(signal.SIGHUP)

    with pytest.raises(Terminated) as ended, ended_by_signals():
        work()
    assert ended.value.code == 128 + signal.SIGHUP


def test_later_signals_do_not_disturb_what_tidies_up() -> None:
    before = signal.getsignal(signal.SIGTERM)
    done = []

    def work() -> None:
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            signal.raise_signal(signal.SIGHUP)
            try:
                raise ValueError
            except ValueError:
                signal.raise_signal(signal.SIGTERM)  # also within what is handled meanwhile
            done.append("tidied up")

    with pytest.raises(Terminated) as ended, ended_by_signals():
        work()
    assert done == ["tidied up"]
    assert ended.value.code == 128 + signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) == before
