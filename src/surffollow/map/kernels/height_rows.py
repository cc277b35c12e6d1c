"""Move heights between six-byte pairs and dense int16 rows, and clear grids, several at a stroke.

Sixteen grids are one vector of 24 words of 16 bits; LLVM makes of its shuffle what the processor has.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from surffollow.shm import map_layout as ml
from surffollow.shm.jit import jit

_UNKNOWN = np.int16(ml.UNKNOWN)
# four unknown pairs are 24 bytes: three 64-bit words
_CLEAR = np.frombuffer(np.array([ml.UNKNOWN, ml.UNKNOWN, 0] * 4, "<i2").tobytes(), "<i8")
_CLEAR0, _CLEAR1, _CLEAR2 = (int(v) for v in _CLEAR)


def _make_shuffle(words_in: int, words_out: int, mask: list[int]) -> Any:
    """Copy `words_in` 16-bit words to `words_out` others; those from `words_in` on in the mask are zeros."""

    def shuffle(typingctx: Any, source: Any, target: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            def vector(address: Any, n: int) -> Any:
                return builder.inttoptr(address, ir.VectorType(ir.IntType(16), n).as_pointer())

            words = builder.load(vector(args[0], words_in), align=2)
            chosen = ir.Constant(ir.VectorType(ir.IntType(32), words_out), mask)
            zeros = ir.Constant(words.type, None)
            moved = builder.shuffle_vector(words, zeros, chosen)
            builder.store(moved, vector(args[1], words_out), align=2)
            return context.get_dummy_value()

        return types.void(types.int64, types.int64), codegen

    return intrinsic(shuffle)


def _make_store(bits: int, value_type: Any) -> Any:
    def store(typingctx: Any, address: Any, value: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            builder.store(args[1], builder.inttoptr(args[0], ir.IntType(bits).as_pointer()), align=2)
            return context.get_dummy_value()

        return types.void(types.int64, value_type), codegen

    return intrinsic(store)


_store_i64 = _make_store(64, types.int64)
# sixteen grids: eight pairs of (height, height, counts)
_unpack_16 = _make_shuffle(24, 16, [w for m in range(8) for w in (3 * m, 3 * m + 1)])
_pack_16 = _make_shuffle(16, 24, [w for m in range(8) for w in (2 * m, 2 * m + 1, 16)])


def _unowned(typingctx: Any, array: Any) -> Any:
    """The same array without its owner: slices of it cost no reference counting (a locked add each).

    For kernels that cut many slices of an array that their caller keeps.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        view = context.make_array(signature.return_type)(context, builder, args[0])
        view.meminfo = ir.Constant(view.meminfo.type, None)
        view.parent = ir.Constant(view.parent.type, None)
        return view._getvalue()

    return array(array), codegen


unowned: Any = intrinsic(_unowned)


@jit
def copy_row(source: Any, target: Any) -> None:
    """Copy a dense row; numba's own slice assignment is five times slower."""
    for i in range(target.shape[0]):
        target[i] = source[i]


@jit
def unpack_row(pairs: Any, start: Any, out: Any) -> None:
    """Heights of grids start … start+len(out)−1, as a dense int16 row."""
    n = out.shape[0]
    k = 0
    if start & 1 and n > 0:
        out[0] = pairs[start >> 1].h[1]
        k = 1
    source = pairs.ctypes.data + 6 * ((start + k) >> 1)
    target = out.ctypes.data + 2 * k
    groups = (n - k) >> 4
    for m in range(groups):
        _unpack_16(source + 48 * m, target + 32 * m)
    k += 16 * groups
    for m in range(k, n - 1, 2):
        out[m] = pairs[(start + m) >> 1].h[0]
        out[m + 1] = pairs[(start + m) >> 1].h[1]
    if (n - k) & 1:
        out[n - 1] = pairs[(start + n - 1) >> 1].h[0]


@jit
def pack_row(row: Any, pairs: Any, start: Any) -> None:
    """Store a dense int16 row at grids start …, count 0 (a prior, or unknown)."""
    n = row.shape[0]
    k = 0
    if start & 1 and n > 0:
        pairs[start >> 1].h[1] = row[0]
        pairs[start >> 1].c[1] = 0
        k = 1
    source = row.ctypes.data + 2 * k
    target = pairs.ctypes.data + 6 * ((start + k) >> 1)
    groups = (n - k) >> 4
    for m in range(groups):
        _pack_16(source + 32 * m, target + 48 * m)
    k += 16 * groups
    for m in range(k, n - 1, 2):
        pair = pairs[(start + m) >> 1]
        pair.h[0] = row[m]
        pair.h[1] = row[m + 1]
        pair.c[0] = 0
        pair.c[1] = 0
    if (n - k) & 1:
        pairs[(start + n - 1) >> 1].h[0] = row[n - 1]
        pairs[(start + n - 1) >> 1].c[0] = 0


@jit
def clear_grids(pairs: Any, start: Any, stop: Any) -> None:
    """Make grids start … stop−1 unknown, count 0.

    Parameters
    ----------
    pairs : (n,) structured `GridPair`
    start, stop : int64                       grid indices, 0 ≤ start ≤ stop ≤ 2 n
    """
    if start < stop and start & 1:
        pairs[start >> 1].h[1] = _UNKNOWN
        pairs[start >> 1].c[1] = 0
        start += 1
    if start < stop and stop & 1:
        pairs[stop >> 1].h[0] = _UNKNOWN
        pairs[stop >> 1].c[0] = 0
        stop -= 1
    first, n = start >> 1, (stop - start) >> 1
    address = pairs.ctypes.data + 6 * first
    for k in range(n >> 2):
        _store_i64(address + 24 * k, _CLEAR0)
        _store_i64(address + 24 * k + 8, _CLEAR1)
        _store_i64(address + 24 * k + 16, _CLEAR2)
    for i in range(first + (n & ~3), first + n):
        pair = pairs[i]
        pair.h[0] = _UNKNOWN
        pair.h[1] = _UNKNOWN
        pair.c[0] = 0
        pair.c[1] = 0


@jit
def place_row(row: Any, pairs: Any, row_start: Any, nx: Any, first: Any) -> None:
    """Write a whole map row of nx grids: unknown, the dense row from column `first` on, unknown.

    Parameters
    ----------
    row : (m,) int16   heights in quanta, first + m ≤ nx
    pairs : (n,) structured `GridPair`  updated
    row_start : int64  grid index of the map row's first grid
    nx : int64         grids in a map row
    first : int64      column of the dense row's first height
    """
    pack_row(row, pairs, row_start + first)
    clear_grids(pairs, row_start, row_start + first)
    clear_grids(pairs, row_start + first + row.shape[0], row_start + nx)


@jit
def has_unknown(row: Any) -> Any:
    """Whether a dense row has an unknown grid."""
    lowest = np.int16(0)
    for i in range(row.shape[0]):
        lowest = min(lowest, row[i])
    return lowest == _UNKNOWN
