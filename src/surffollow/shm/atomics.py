"""Atomic loads, stores and fences for jitted kernels: the only interface to shared memory.

NumPy indexing in a jitted loop may be hoisted or torn; these intrinsics may not.
Addresses are plain integers (`array.ctypes.data + offset`), naturally aligned.
`relaxed` operations order nothing by themselves; a latch adds the fences
(docs/reference/protocol.md, steps W1-W3 and R1-R4).
All 64-bit words are int64 here: numba turns a mix of int64 and uint64 into float64.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

_I64 = ir.IntType(64)


def _pointer(builder: Any, address: Any) -> Any:
    return builder.inttoptr(address, _I64.as_pointer())


def _make_load(ordering: str, result: Any, floating: bool = False) -> Any:
    def load(typingctx: Any, address: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            value = builder.load_atomic(_pointer(builder, args[0]), ordering, 8)
            return builder.bitcast(value, ir.DoubleType()) if floating else value

        return result(types.int64), codegen

    return intrinsic(load)


def _make_store(ordering: str, value_type: Any, floating: bool = False) -> Any:
    def store(typingctx: Any, address: Any, value: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            value = builder.bitcast(args[1], _I64) if floating else args[1]
            builder.store_atomic(value, _pointer(builder, args[0]), ordering, 8)
            return context.get_dummy_value()

        return types.void(types.int64, value_type), codegen

    return intrinsic(store)


def _make_narrow_load(bits: int, signed: bool) -> Any:
    def load(typingctx: Any, address: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            pointer = builder.inttoptr(args[0], ir.IntType(bits).as_pointer())
            value = builder.load_atomic(pointer, "monotonic", bits // 8)
            return builder.sext(value, _I64) if signed else builder.zext(value, _I64)

        return types.int64(types.int64), codegen

    return intrinsic(load)


load_acquire_i64 = _make_load("acquire", types.int64)
load_relaxed_i64 = _make_load("monotonic", types.int64)
load_relaxed_f64 = _make_load("monotonic", types.float64, floating=True)
load_relaxed_i16 = _make_narrow_load(16, signed=True)  # heights of the map
load_relaxed_u8 = _make_narrow_load(8, signed=False)  # and their counts
store_release_i64 = _make_store("release", types.int64)
store_relaxed_i64 = _make_store("monotonic", types.int64)
store_relaxed_f64 = _make_store("monotonic", types.float64, floating=True)


def _make_fence(ordering: str) -> Any:
    def fence(typingctx: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            builder.fence(ordering)
            return context.get_dummy_value()

        return types.void(), codegen

    return intrinsic(fence)


# acquire: no later access moves above it; release: no earlier access moves below it
fence_acquire: Any = _make_fence("acquire")
fence_release: Any = _make_fence("release")
# and no later load above an earlier store, which neither of the others says
fence_full: Any = _make_fence("seq_cst")
