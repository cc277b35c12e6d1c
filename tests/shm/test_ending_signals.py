"""Signals that ask a program to end."""

from __future__ import annotations

import ctypes
import signal
import sys
import threading
from collections.abc import Callable

import pytest

from surffollow.shm.ending_signals import EndedEarly, Terminated, ended_by_signals, ending_signals, sent_again


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


def in_a_callback(number: int) -> None:
    """Let a signal arrive in a function that C code calls, as the compiler does; then wait."""
    ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(number))()
    threading.Event().wait(60.0)


def in_an_import(number: int) -> None:
    """Let a signal arrive in an import of C code that prints the exception, as NumPy's does; then wait."""
    assert ctypes.pythonapi.PyRun_SimpleString(f"import signal; signal.raise_signal({number})".encode()) == -1
    threading.Event().wait(60.0)


@pytest.mark.parametrize("arrive", [in_a_callback, in_an_import])
def test_an_interrupt_whose_exception_c_code_dropped_comes_again(
    arrive: Callable[[int], None], capfd: pytest.CaptureFixture[str]
) -> None:
    """The command ran to its end, after a traceback: 40 s in `latency --seconds 20`."""
    # a shell's background job, such as a CI, ignores it
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with sent_again() as lost, pytest.raises(KeyboardInterrupt):
            arrive(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
    assert lost.number == signal.SIGINT
    assert capfd.readouterr() == ("", "")


def test_other_signals_that_a_callback_dropped_come_again(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(Terminated) as ended, ended_by_signals(), sent_again():
        in_a_callback(signal.SIGTERM)
    assert ended.value.code == 128 + signal.SIGTERM

    def compiling(number: int, _: object) -> None:
        raise EndedEarly(number)

    before = signal.signal(signal.SIGHUP, compiling)
    try:
        with pytest.raises(EndedEarly), sent_again():
            in_a_callback(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert capfd.readouterr() == ("", "")


def test_a_dropped_signal_of_a_program_that_ended_meanwhile_does_not_come_again() -> None:
    came = []
    before = signal.signal(signal.SIGTERM, lambda number, _: came.append(number))
    try:
        with sent_again() as lost:
            sys.excepthook(Terminated, Terminated(128 + signal.SIGTERM), None)
        assert lost.number == signal.SIGTERM
        assert lost.again is not None
        lost.again.join()
        assert came == []
    finally:
        signal.signal(signal.SIGTERM, before)


def test_other_exceptions_of_callbacks_are_shown_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda error: shown.append(error.exc_type))
    monkeypatch.setattr(sys, "excepthook", lambda kind, *_: shown.append(kind))
    with sent_again() as lost:
        ctypes.CFUNCTYPE(None)(lambda: {}["missing"])()
        ctypes.pythonapi.PyRun_SimpleString(b"[][1]")
    assert lost.number == 0
    assert shown == [KeyError, IndexError]
