"""Kernels of a package between processes: parts, wholes, callers of numba's own kind."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import njit
from numba.core.errors import UnsupportedError

from surffollow.forecast.pose import pose_at, push_pose
from surffollow.hw.simulation.counter_noise import hashed_uniform
from surffollow.shm.cache_directory import cache_directory
from surffollow.shm.dtypes import zeros
from surffollow.shm.jit import jit, jit_uncounted
from surffollow.shm.kernel import Kernel, types_of
from surffollow.shm.layout_follow import FollowState
from surffollow.shm.ring import make_ring, ring_drop, ring_length

COUNT = """
import numpy as np
from numba.core import event
from surffollow.shm.kernel import types_of
from surffollow.service.compile_helper import compile_share
from surffollow.service.cycle import count_duration
compiled = []
class Names(event.Listener):
    def on_start(self, happened): compiled.append(happened.data["dispatcher"].py_func.__name__)
    def on_end(self, happened): pass
with event.install_listener("numba:compile", Names()):
    {work}
print(*sorted(n for n in compiled if n != "impl"))  # numba's own
"""
PART = "count_duration.part(types_of(0, 0, 0, 0))"
WHOLE = "count_duration(np.zeros(100, np.int64).ctypes.data, 0, 792, 5)"


def compiled_by(work: str, folder: Path) -> list[str]:
    """Names of the kernels that a process compiles for `work`, with its cache in `folder`."""
    command = [sys.executable, "-c", COUNT.format(work=work)]
    environment = os.environ | {"SURFFOLLOW_CACHE_DIR": str(folder)}
    run = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return run.stdout.split()


def test_another_process_finds_parts_and_makes_the_whole_of_them(tmp_path: Path) -> None:
    assert compiled_by(PART, tmp_path) == ["count_duration", "histogram_bin"]  # "count" is pasted
    assert compiled_by(PART, tmp_path) == []
    assert compiled_by(WHOLE, tmp_path) == []
    wholes = [f.name for f in tmp_path.rglob("*.whole-*")]
    assert len(wholes) == 1, "machine code of what Python called alone"


def test_a_part_that_is_lost_is_compiled_again_with_its_callers(tmp_path: Path) -> None:
    compiled_by(PART, tmp_path)
    (lost,) = tmp_path.rglob("cycle.histogram_bin.*.part-*")
    lost.unlink()
    assert compiled_by(WHOLE, tmp_path) == ["count_duration", "histogram_bin"]


def test_a_kernel_is_called_by_kernels_by_python_and_by_functions_of_numba_in_any_order() -> None:
    @njit
    def by_numba(ring: int) -> int:
        return ring_length(ring) + 1

    @jit
    def by_kernel(ring: int) -> int:
        return ring_length(ring) + 2

    at = make_ring(8, 1).ctypes.data
    for _ in range(2):
        assert (by_kernel(at), ring_length(at), by_numba(at)) == (2, 0, 1)
        ring_drop(at, 0)

    @njit
    def push(state: object, pose: object) -> None:
        push_pose(state[0].sense, 6, pose, 0)  # type: ignore[index]

    state, pose = zeros(FollowState), np.arange(7.0)
    push_pose(state[0]["sense"], 5, pose, 0)
    push(state, pose)
    assert state[0]["sense"]["pose_count"] == 2


def test_a_kernel_returns_what_numba_knows() -> None:
    @jit
    def halves(values: object) -> object:
        return values[:2], values[2:] + 1.0, len(values)  # type: ignore[index, arg-type]

    first, second, n = halves(np.arange(4.0))
    assert (list(first), list(second), n) == ([0.0, 1.0], [3.0, 4.0], 4)


def test_calls_with_different_constants_share_a_part() -> None:
    @jit
    def half(n, whole):
        return n // 2 if whole else 0.5 * n

    @jit
    def sum_of_halves(n):
        return half(4, True) + half(5, False) + half(n, n > 1)

    assert sum_of_halves(3) == 2.0 + 2.5 + 1.0
    assert len(half.overloads) == 1


def test_kernels_that_count_no_references_return_no_array() -> None:
    @jit_uncounted
    def same(values):
        return values

    @jit_uncounted
    def total(values):
        return values[0] + values[1]

    values = np.array([1.0, 2.0])
    counted = sys.getrefcount(values)
    assert [total(values) for _ in range(9)] == [3.0] * 9
    assert sys.getrefcount(values) == counted
    with pytest.raises(UnsupportedError, match="returns an array"):
        same(values)


def test_kernels_of_one_name_in_functions_stay_apart() -> None:
    def make(step: int) -> Kernel:
        @jit
        def inner(x: int) -> int:
            return x + step

        return inner  # type: ignore[no-any-return]

    one, two = make(1), make(2)

    @jit
    def both(x: int) -> int:
        return 10 * one(x) + two(x)

    assert both(0) == 12
    assert (one(0), two(0)) == (1, 2)


def test_types_and_options_tell_parts_apart_and_the_process_does_not() -> None:
    whole, real = types_of(1), types_of(1.0)
    tags = {hashed_uniform._tag(whole), hashed_uniform._tag(real), pose_at._tag(whole)}
    assert len(tags) == 3
    code = (
        "from surffollow.shm.kernel import types_of; "
        "from surffollow.hw.simulation.counter_noise import hashed_uniform as k; print(k._tag(types_of(1)))"
    )
    run = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert run.stdout.split() == [hashed_uniform._tag(whole)]


def test_a_mistake_in_a_called_kernel_is_told_each_time() -> None:
    from numba.core.errors import TypingError

    @jit
    def wrong(x: int) -> int:
        return x + "one"  # type: ignore[operator]

    @jit
    def caller(x: int) -> int:
        return wrong(x)

    for _ in range(2):
        with pytest.raises(TypingError, match="add"):
            caller(1)


def test_another_process_finds_every_kernel_of_the_service() -> None:
    code = (
        "import sys; import surffollow.service.daemon; from surffollow.shm.kernel import Kernel\n"
        "mine = [m for n, m in list(sys.modules.items()) if n.startswith('surffollow.')]\n"
        "kernels = {k for m in mine for k in vars(m).values() if isinstance(k, Kernel)}\n"
        "print(len(kernels), *sorted(k.name for k in kernels if not k.is_kept()))"
    )
    run = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    count, *lost = run.stdout.split()
    assert int(count) > 100
    assert lost == [], "their callers are compiled in every process"


def test_a_second_process_compiles_no_kernel_of_the_service() -> None:
    own_cache = Path(cache_directory()).parent
    compiled_by("compile_share()", own_cache)
    assert compiled_by("compile_share()", own_cache) == []
