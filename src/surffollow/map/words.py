"""Move heights between six-byte pairs and dense int16 rows, and clear grids, several at a stroke.

Two grids' heights are one 32-bit word at an even address; loading them as such beats any shuffle
that the compiler finds, and is what unaligned little-endian machines (x86-64, aarch64) allow.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from surffollow.shm import map_layout as ml

_UNKNOWN = np.int16(ml.UNKNOWN)
# four unknown pairs are 24 bytes: three 64-bit words
_CLEAR = np.frombuffer(np.array([ml.UNKNOWN, ml.UNKNOWN, 0] * 4, "<i2").tobytes(), "<i8")
_CLEAR0, _CLEAR1, _CLEAR2 = (int(v) for v in _CLEAR)


def _make_load(bits: int, result: Any) -> Any:
    def load(typingctx: Any, address: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.load(builder.inttoptr(args[0], ir.IntType(bits).as_pointer()), align=2)

        return result(types.int64), codegen

    return intrinsic(load)


def _make_store(bits: int, value_type: Any) -> Any:
    def store(typingctx: Any, address: Any, value: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            builder.store(args[1], builder.inttoptr(args[0], ir.IntType(bits).as_pointer()), align=2)
            return context.get_dummy_value()

        return types.void(types.int64, value_type), codegen

    return intrinsic(store)


_load_i32 = _make_load(32, types.int32)
_store_i32 = _make_store(32, types.int32)
_store_i64 = _make_store(64, types.int64)


@njit(cache=True, nogil=True)
def copy_row(source: Any, target: Any) -> None:
    """Copy a dense row; numba's own slice assignment is five times slower."""
    for i in range(target.shape[0]):
        target[i] = source[i]


@njit(cache=True, nogil=True)
def unpack_row(pairs: Any, start: Any, out: Any) -> None:
    """Heights of grids start … start+len(out)−1, as a dense int16 row."""
    n = out.shape[0]
    k = 0
    if start & 1 and n > 0:
        out[0] = pairs[start >> 1].h[1]
        k = 1
    source = pairs.ctypes.data + 6 * ((start + k) >> 1)
    target = out.ctypes.data + 2 * k
    for m in range((n - k) >> 1):
        _store_i32(target + 4 * m, _load_i32(source + 6 * m))
    if (n - k) & 1:
        out[n - 1] = pairs[(start + n - 1) >> 1].h[0]


@njit(cache=True, nogil=True)
def pack_row(row: Any, pairs: Any, start: Any) -> None:
    """Store a dense int16 row at grids start …, count 0 (a prior, or unknown)."""
    n = row.shape[0]
    k = 0
    if start & 1 and n > 0:
        pairs[start >> 1].h[1] = row[0]
        pairs[start >> 1].c[1] = 0
        k = 1
    m = (n - k) >> 1
    first = 3 * ((start + k) >> 1)
    words = pairs.view(np.int16)[first : first + 3 * m]
    dense = row[k : k + 2 * m]
    for i in range(m):
        words[3 * i] = dense[2 * i]
        words[3 * i + 1] = dense[2 * i + 1]
        words[3 * i + 2] = 0
    if (n - k) & 1:
        pairs[(start + n - 1) >> 1].h[0] = row[n - 1]
        pairs[(start + n - 1) >> 1].c[0] = 0


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def place_row(row: Any, pairs: Any, row_start: Any, nx: Any, first: Any) -> None:
    """Write a whole map row of nx grids: unknown, the dense row from column `first` on, unknown."""
    pack_row(row, pairs, row_start + first)
    clear_grids(pairs, row_start, row_start + first)
    clear_grids(pairs, row_start + first + row.shape[0], row_start + nx)


@njit(cache=True, nogil=True)
def has_unknown(row: Any) -> Any:
    """Whether a dense row has an unknown grid."""
    lowest = np.int16(0)
    for i in range(row.shape[0]):
        lowest = min(lowest, row[i])
    return lowest == _UNKNOWN
