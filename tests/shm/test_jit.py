"""Effects of compiling a kernel on its process."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import pytest
from numba import njit
from numba.core import event
from numba.core.errors import TypingError

from surffollow.shm.jit import YOUNG_OBJECTS, jit


@pytest.fixture(autouse=True)
def thresholds() -> Iterator[None]:
    before = gc.get_threshold()
    yield
    gc.set_threshold(*before)


class ThresholdRecorder(event.Listener):  # type: ignore[misc]
    """Notes the collector's threshold while a kernel compiles."""

    def __init__(self) -> None:
        self.seen: list[int] = []

    def on_start(self, happened: event.Event) -> None:
        self.seen.append(gc.get_threshold()[0])

    def on_end(self, happened: event.Event) -> None:
        pass


def compile_two(fails: bool = False) -> list[int]:
    """Thresholds at the start of two kernels, one inside the other."""

    @njit
    def inner(x: int) -> int:
        return x + (1 if not fails else "one")  # type: ignore[operator]

    @njit
    def outer(x: int) -> int:
        return inner(x) * 2

    spy = ThresholdRecorder()
    with event.install_listener("numba:compile", spy):
        if fails:
            with pytest.raises(TypingError):
                outer(1)
        else:
            assert outer(1) == 4
    return spy.seen


@pytest.mark.parametrize("fails", [False, True])
def test_garbage_is_collected_seldom_while_kernels_compile_and_as_before_after_them(fails: bool) -> None:
    gc.set_threshold(701, 11, 12)
    assert set(compile_two(fails)) == {YOUNG_OBJECTS}
    assert gc.get_threshold() == (701, 11, 12)


@pytest.mark.parametrize("own", [0, 10 * YOUNG_OBJECTS])
def test_a_collector_that_its_user_calmed_stays_as_it_is(own: int) -> None:
    gc.set_threshold(own, 11, 12)
    assert set(compile_two()) == {own}
    assert gc.get_threshold() == (own, 11, 12)


def test_kernels_let_the_gil_go_and_are_kept_on_disk() -> None:
    @jit
    def kernel(x: int) -> int:
        return x + 1

    assert kernel.targetoptions["nogil"]
    assert kernel._cache is not None
