"""Atomic loads, stores and fences for jitted kernels: the only door to shared memory.

NumPy indexing in a jitted loop may be hoisted or torn; these intrinsics may not.
Addresses are plain integers (`array.ctypes.data + offset`), naturally aligned.
`relaxed` operations order nothing by themselves; a latch adds the fences
(docs/protocol.md, steps W1-W3 and R1-R4).
All 64-bit words are int64 here: numba turns a mix of int64 and uint64 into float64.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

_I64 = ir.IntType(64)


def _pointer(builder: Any, address: Any, bits: int, floating: bool = False) -> Any:
    kind: Any = ir.DoubleType() if floating else ir.IntType(bits)
    return builder.inttoptr(address, kind.as_pointer())


def _make_load(bits: int, ordering: str, result: Any, floating: bool = False) -> Any:
    def load(typingctx: Any, address: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            pointer = _pointer(builder, args[0], bits)
            value = builder.load_atomic(pointer, ordering, bits // 8)
            return builder.bitcast(value, ir.DoubleType()) if floating else value

        return result(types.int64), codegen

    return intrinsic(load)


def _make_store(bits: int, ordering: str, value_type: Any, floating: bool = False) -> Any:
    def store(typingctx: Any, address: Any, value: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            value = builder.bitcast(args[1], _I64) if floating else args[1]
            builder.store_atomic(value, _pointer(builder, args[0], bits), ordering, bits // 8)
            return context.get_dummy_value()

        return types.void(types.int64, value_type), codegen

    return intrinsic(store)


load_acquire_i64 = _make_load(64, "acquire", types.int64)
load_relaxed_i64 = _make_load(64, "monotonic", types.int64)
load_relaxed_f64 = _make_load(64, "monotonic", types.float64, floating=True)
load_acquire_u32 = _make_load(32, "acquire", types.uint32)
load_relaxed_u32 = _make_load(32, "monotonic", types.uint32)
store_release_i64 = _make_store(64, "release", types.int64)
store_relaxed_i64 = _make_store(64, "monotonic", types.int64)
store_relaxed_f64 = _make_store(64, "monotonic", types.float64, floating=True)
store_release_u32 = _make_store(32, "release", types.uint32)
store_relaxed_u32 = _make_store(32, "monotonic", types.uint32)


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


def _compare_exchange(typingctx: Any, address: Any, expected: Any, desired: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = _pointer(builder, args[0], 64)
        pair = builder.cmpxchg(pointer, args[1], args[2], "acq_rel", "acquire")
        return builder.extract_value(pair, 1)

    return types.boolean(types.int64, types.int64, types.int64), codegen


# (address, expected, desired) → stored?; never on a read-only mapping: it kills the process
compare_exchange_i64: Any = intrinsic(_compare_exchange)
