"""Elementary functions: near those of a mathematical library, and no call of one is left in a cycle."""

from __future__ import annotations

import ast
import math
import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numpy as np
import pytest
from numba.core.compiler_lock import global_compiler_lock

from surffollow import Follower
from surffollow.forecast import elementary, step
from surffollow.forecast.attitude.plane_regression import principal_axis
from surffollow.shm.jit import jit

FORECAST = Path(elementary.__file__).parent
# exact, or defined by IEEE 754
EXACT = {"inf", "nan", "pi", "sqrt", "copysign", "isfinite", "isnan", "floor", "ceil", "frexp", "ldexp"}
LIBRARY = {
    "exp",
    "log",
    "pow",
    "sin",
    "cos",
    "sincos",
    "tan",
    "atan",
    "atan2",
    "asin",
    "acos",
    "hypot",
    "cbrt",
}


@jit
def _exps(x: Any, y: Any) -> None:
    for i in range(len(x)):
        y[i] = elementary.exp(x[i])


@jit
def _logs(x: Any, y: Any) -> None:
    for i in range(len(x)):
        y[i] = elementary.log(x[i])


@jit
def _sines(x: Any, y: Any) -> None:
    for i in range(len(x)):
        y[i], _ = elementary.sin_cos(x[i])


@jit
def _cosines(x: Any, y: Any) -> None:
    for i in range(len(x)):
        _, y[i] = elementary.sin_cos(x[i])


@jit
def _angles(x: Any, y: Any) -> None:
    for i in range(len(x)):
        y[i] = elementary.angle(abs(math.sin(x[i])) * x[i], math.cos(x[i]) * x[i])


def values(kernel: Any, x: Any) -> Any:
    x = np.array(x, np.float64)
    y = np.empty_like(x)
    kernel(x, y)
    # a vectorised loop has the bits of a single value
    single = np.empty(1)
    for k in range(0, len(x), max(1, len(x) // 50)):
        kernel(x[k : k + 1].copy(), single)
        assert np.array_equal(single, y[k : k + 1], equal_nan=True)
    return y


def spread(low: float, high: float) -> Any:
    return np.random.default_rng(7).uniform(low, high, 20_001)


@pytest.mark.parametrize(
    ("kernel", "true", "x"),
    [
        (_exps, np.exp, np.concatenate([spread(-700.0, 700.0), spread(-1.0, 1.0), spread(-1e-9, 1e-9)])),
        (
            _logs,
            np.log,
            np.exp(np.concatenate([spread(-700.0, 700.0), spread(-0.1, 0.1), spread(-1e-9, 1e-9)])),
        ),
        (_angles, np.abs, spread(1e-9, math.pi)),
    ],
    ids=["exp", "log", "angle"],
)
def test_the_relative_error_is_of_some_last_bits(kernel: Any, true: Callable[[Any], Any], x: Any) -> None:
    error = np.abs(values(kernel, x) / true(x) - 1.0)
    assert error.max() < 2e-15


@pytest.mark.parametrize(("kernel", "true"), [(_sines, np.sin), (_cosines, np.cos)], ids=["sin", "cos"])
@pytest.mark.parametrize("high", [1e-3, 1.0, 100.0, 1e6])
def test_the_error_of_a_sine_is_small(kernel: Any, true: Callable[[Any], Any], high: float) -> None:
    x = spread(-high, high)
    assert np.abs(values(kernel, x) - true(x)).max() < 1e-15


def test_what_is_no_number_stays_none() -> None:
    for kernel in (_exps, _logs, _sines, _cosines):
        assert np.isnan(values(kernel, [math.nan] * 5)).all()
    assert np.isnan(values(_logs, [-1.0, 0.0, math.inf])).all()
    smallest, greatest = values(_exps, [-math.inf, math.inf])
    assert smallest == 0.0
    assert greatest > 1e300


def test_the_principal_axis_is_that_of_the_greatest_moment() -> None:
    rng = np.random.default_rng(3)
    for _ in range(200):
        points = rng.standard_normal((5, 2)) @ rng.standard_normal((2, 2))
        (xx, xy), (_, yy) = points.T @ points
        _, axes = np.linalg.eigh([[xx, xy], [xy, yy]])
        assert abs(np.dot(principal_axis(xx, xy, yy), axes[:, 1])) == pytest.approx(1.0, abs=1e-9)
    assert principal_axis(0.0, 0.0, 0.0) == (1.0, 0.0)
    assert principal_axis(0.0, 0.0, 1.0) == (0.0, 1.0)


def called(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "math":
            yield node.attr


@pytest.mark.parametrize("path", sorted(FORECAST.rglob("*.py")), ids=lambda p: p.stem)
def test_kernels_use_no_inexact_function_of_math(path: Path) -> None:
    assert not set(called(path)) - EXACT


def undefined(code: bytes) -> set[str]:
    """Names that machine code takes from other libraries (ELF, 64 bits)."""
    sections = {s.name() or b"": s.data() for s in llvm.ObjectFileRef.from_data(code).sections()}
    names, entries = sections[b".strtab"], sections[b".symtab"]
    found = set()
    for at in range(0, len(entries), 24):
        name, _, _, section, _, _ = struct.unpack_from("<IBBHQQ", entries, at)
        if section == 0:
            found.add(names[name : names.index(b"\0", name)].decode())
    return found


def test_the_machine_code_of_a_cycle_is_exact() -> None:
    """GIVEN the compiled cycle THEN it calls no mathematical library, and fuses or estimates no operation."""
    Follower({"sensors": [{"near_m": 0.2, "far_m": 2.0}]}, offset_m=0.5).step(0, [0.5])
    kernel = step.follow_step
    assert kernel._wholes
    with global_compiler_lock:
        for args in kernel._wholes:
            library = kernel._compile_whole(kernel.part(args)).library
            assert not re.search(r"\tv?(fn?m(add|sub)|frecp|frsqr|rcp[ps]|rsqrt)", library.get_asm_str())
            names = undefined(library._get_compiled_object())
            assert names
            assert not names & LIBRARY
