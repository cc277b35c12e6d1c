"""Weighted means of rows of heights for grids up to twice as coarse, in float32, eight columns at a stroke.

At most three old grids lie under a new one along each axis, so a mean has no more than nine terms and
float32 errs by 0.01 quanta at worst. Weights are rounded one by one: a sliver of a grid beside holes
keeps its relative accuracy, and with it the mean over what is known.

Where the processor permutes eight lanes by an index vector (AVX2), LLVM makes one such instruction of
`_permuted`; elsewhere a plain loop computes the same bits.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from surffollow.map.kernels.resample import span
from surffollow.shm import map_layout as ml
from surffollow.shm.jit import jit

_UNKNOWN = np.int16(ml.UNKNOWN)
_ZERO, _F32 = np.float32(0.0), np.float32
_U1, _U2 = np.uint32(1), np.uint32(2)
_LANES = 8
_PERMUTES = bool(llvm.get_host_cpu_features().get("avx2", False))
_I32, _I64, _FLOAT = ir.IntType(32), ir.IntType(64), ir.FloatType()


def _load(builder: Any, address: Any, lanes: int, kind: Any) -> Any:
    return builder.load(builder.inttoptr(address, ir.VectorType(kind, lanes).as_pointer()), align=4)


def _permuted(builder: Any, source: Any, index: Any, lanes: int) -> Any:
    """result[i] = source[index[i]], spelled so that LLVM knows it for a permutation."""
    result = ir.Constant(ir.VectorType(_FLOAT, lanes), ir.Undefined)
    for i in range(lanes):
        lane = ir.Constant(_I32, i)
        chosen = builder.extract_element(source, builder.extract_element(index, lane))
        result = builder.insert_element(result, chosen, lane)
    return result


def _make_means(lanes: int, taps: int) -> Any:
    """Means of `lanes` new columns: Σ weight_t · values[first + t], t < taps, summed from the left.

    All arguments are addresses, but for the bytes from one row of weights to the next. The first old
    columns must lie within eight; twelve values from the first one on are read.
    """

    def means(typingctx: Any, values: Any, first: Any, weights: Any, stride: Any, out: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            values, first, weights, stride, out = args
            index = _load(builder, first, lanes, _I32)
            start = builder.extract_element(index, ir.Constant(_I32, 0))
            starts = ir.Constant(index.type, ir.Undefined)
            starts = builder.insert_element(starts, start, ir.Constant(_I32, 0))
            spread = ir.Constant(ir.VectorType(_I32, lanes), [0] * lanes)
            starts = builder.shuffle_vector(starts, ir.Constant(index.type, ir.Undefined), spread)
            # within the vector for any table
            index = builder.and_(builder.sub(index, starts), ir.Constant(index.type, [_LANES - 1] * lanes))
            at = builder.add(values, builder.shl(builder.sext(start, _I64), ir.Constant(_I64, 2)))
            total = None
            for tap in range(taps):
                source = _load(builder, builder.add(at, ir.Constant(_I64, 4 * tap)), _LANES, _FLOAT)
                weight_at = builder.add(weights, builder.mul(stride, ir.Constant(_I64, tap)))
                weight = _load(builder, weight_at, lanes, _FLOAT)
                term = builder.fmul(weight, _permuted(builder, source, index, lanes))
                total = term if total is None else builder.fadd(total, term)
            target = builder.inttoptr(out, ir.VectorType(_FLOAT, lanes).as_pointer())
            builder.store(total, target, align=4)
            return context.get_dummy_value()

        return types.void(*[types.int64] * 5), codegen

    return intrinsic(means)


_means_of_two = _make_means(8, 2)
_means_of_three = _make_means(4, 3)


@jit
def fill_columns(first_old: Any, weights: Any, shift: Any, ratio: Any, overlap: Any) -> None:
    """First old column under each new column of the overlap, and the shares of it and the next two.

    Parameters
    ----------
    first_old : (w,) int32                    out, counted from the first old column of the overlap
    weights : (3, w) float32                  out; the third is 0 where ratio ≤ 1
    overlap : (a, b, c, d, n_old)             as from `axis_overlap`
    """
    a, b, c, _, n_old = overlap
    for i in range(b - a):
        first, last, low, high = span(shift, ratio, a + i, n_old)
        first_old[i] = first - c
        for tap in range(3):
            weights[tap, i] = overlap_share(first + tap, low, high) if first + tap <= last else 0.0


@jit
def overlap_share(k: Any, low: Any, high: Any) -> Any:
    """Share of [low, high] that grid k covers, float32."""
    return _F32((min(high, k + 1.0) - max(low, float(k))) / (high - low))


@jit
def to_floats(row: Any, total: Any) -> None:
    """Heights as float32, and two zeros behind them, on which weight 0 may fall."""
    n = row.shape[0]
    for i in range(n):
        total[i] = _F32(row[i])
    total[n], total[n + 1] = _ZERO, _ZERO


@jit
def to_floats_known(row: Any, total: Any, known: Any) -> None:
    """`to_floats` with 0 for unknown heights, and which are known as 1 and 0."""
    n = row.shape[0]
    for i in range(n):
        there = row[i] != _UNKNOWN
        total[i] = _F32(row[i]) if there else _ZERO
        known[i] = _F32(1.0) if there else _ZERO
    total[n], total[n + 1] = _ZERO, _ZERO
    known[n], known[n + 1] = _ZERO, _ZERO


@jit
def add_three(a: Any, b: Any, c: Any, weights: Any, total: Any) -> None:
    """Weighted sum of three rows of heights, and two zeros behind it.

    Parameters
    ----------
    a, b, c : (n,) int16        heights in quanta
    weights : 3 × float32
    total : (≥ n + 2,) float32  overwritten
    """
    n = a.shape[0]
    w0, w1, w2 = weights
    for i in range(n):
        total[i] = w0 * _F32(a[i]) + w1 * _F32(b[i]) + w2 * _F32(c[i])
    total[n], total[n + 1] = _ZERO, _ZERO


@jit
def add_three_known(a: Any, b: Any, c: Any, weights: Any, total: Any, known: Any) -> None:
    """`add_three` over known heights alone, and the sum of their weights.

    Parameters
    ----------
    a, b, c : (n,) int16  heights in quanta; UNKNOWN where unknown
    weights : 3 × float32
    total, known : (≥ n + 2,) float32  overwritten
    """
    n = a.shape[0]
    w0, w1, w2 = weights
    for i in range(n):
        u0 = w0 if a[i] != _UNKNOWN else _ZERO
        u1 = w1 if b[i] != _UNKNOWN else _ZERO
        u2 = w2 if c[i] != _UNKNOWN else _ZERO
        total[i] = u0 * _F32(a[i]) + u1 * _F32(b[i]) + u2 * _F32(c[i])
        known[i] = u0 + u1 + u2
    total[n], total[n + 1] = _ZERO, _ZERO
    known[n], known[n + 1] = _ZERO, _ZERO


@jit
def along_columns(values: Any, first_old: Any, weights: Any, ratio: Any, out: Any) -> None:
    """Weighted sums of old columns under each new one.

    Parameters
    ----------
    values : (m + 10,) float32                per old column, then two zeros, then anything
    first_old, weights : from `fill_columns`
    out : (n,) float32
    """
    n = out.shape[0]
    w0, w1, w2 = weights[0], weights[1], weights[2]
    stride = weights.strides[0]
    at, to = values.ctypes.data, out.ctypes.data
    index_at, weights_at = first_old.ctypes.data, weights.ctypes.data
    i = 0
    group = 8 if ratio <= 1.0 else 4
    if _PERMUTES:
        while i + group <= n and first_old[i + group - 1] - first_old[i] < _LANES:
            if ratio <= 1.0:
                _means_of_two(at, index_at + 4 * i, weights_at + 4 * i, stride, to + 4 * i)
            else:
                _means_of_three(at, index_at + 4 * i, weights_at + 4 * i, stride, to + 4 * i)
            i += group
    if ratio <= 1.0:
        for m in range(i, n):
            k = np.uint32(first_old[m])
            out[m] = w0[m] * values[k] + w1[m] * values[k + _U1]
    else:
        for m in range(i, n):
            k = np.uint32(first_old[m])
            out[m] = w0[m] * values[k] + w1[m] * values[k + _U1] + w2[m] * values[k + _U2]


@jit
def _quanta(value: Any) -> Any:
    return np.int16(np.rint(value))


@jit
def round_means(total: Any, out: Any) -> None:
    """Nearest quanta, halves to even."""
    for i in range(out.shape[0]):
        out[i] = _quanta(total[i])


@jit
def _known_mean(total: Any, known: Any, whole: Any) -> Any:
    """Mean over the known part of a grid, whose known weight is `whole` when it has no hole."""
    if known > _ZERO:
        return _quanta(total if known == whole else total / known)
    return _UNKNOWN


@jit
def round_known(total: Any, known: Any, weights: Any, height: Any, out: Any) -> None:
    """`round_means` over what is known, UNKNOWN where nothing is.

    Parameters
    ----------
    total, known : (n,) float32  sums, and known weights in them
    weights : (3, n) float32     from `fill_columns`
    height : float32             sum of the weights along y, as `add_three_known` has it where all is known
    out : (n,) int16             overwritten with heights in quanta
    """
    w0, w1, w2 = weights[0], weights[1], weights[2]
    for i in range(out.shape[0]):
        whole = w0[i] * height + w1[i] * height + w2[i] * height
        out[i] = _known_mean(total[i], known[i], whole)


@jit
def blend_means(one: Any, other: Any, weight: Any, rest: Any, out: Any) -> None:
    """Nearest quanta of weight·one + rest·other.

    Parameters
    ----------
    one, other : (n,) float32
    weight, rest : float32
    out : (n,) int16  overwritten with heights in quanta
    """
    for i in range(out.shape[0]):
        out[i] = _quanta(weight * one[i] + rest * other[i])


@jit
def blend_known(one: Any, other: Any, weight: Any, rest: Any, weights: Any, out: Any) -> None:
    """`blend_means` over what is known.

    Parameters
    ----------
    one, other : 2 × (n,) float32  sums, and known weights in them
    weight, rest : float32
    weights : (≥ 2, n) float32     from `fill_columns`
    out : (n,) int16               overwritten with heights in quanta; UNKNOWN where nothing is known
    """
    w0, w1 = weights[0], weights[1]
    for i in range(out.shape[0]):
        whole = w0[i] + w1[i]
        out[i] = _known_mean(
            weight * one[0][i] + rest * other[0][i],
            weight * one[1][i] + rest * other[1][i],
            weight * whole + rest * whole,
        )


@jit
def all_known(weights: Any, known: Any) -> None:
    """The known weights of a row without holes."""
    for i in range(known.shape[0]):
        known[i] = weights[0, i] + weights[1, i]
