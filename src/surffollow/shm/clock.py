"""The one module that reads and waits for the clock inside kernels (CLOCK_MONOTONIC, int64 ns)."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from surffollow.shm.jit import jit

CLOCK_MONOTONIC = 1
TIMER_ABSTIME = 1
_I32, _I64 = ir.IntType(32), ir.IntType(64)


def _timespec(builder: Any) -> Any:
    # the slot lives in the entry block so that a loop around the call does not grow the stack
    with builder.goto_entry_block():
        return builder.alloca(ir.ArrayType(_I64, 2))


def _declare(builder: Any, name: str, *argument_types: Any) -> Any:
    kind = ir.FunctionType(_I32, argument_types)
    module = builder.module
    return module.globals.get(name) or ir.Function(module, kind, name)


def _now(typingctx: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        slot = _timespec(builder)
        pointer = builder.bitcast(slot, _I64.as_pointer())
        clock_gettime = _declare(builder, "clock_gettime", _I32, _I64.as_pointer())
        builder.call(clock_gettime, [_I32(CLOCK_MONOTONIC), pointer])
        seconds = builder.load(pointer)
        rest = builder.load(builder.gep(pointer, [_I64(1)]))
        return builder.add(builder.mul(seconds, _I64(1_000_000_000)), rest)

    return types.int64(), codegen


def _sleep_until(typingctx: Any, t_ns: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        slot = _timespec(builder)
        pointer = builder.bitcast(slot, _I64.as_pointer())
        billion = _I64(1_000_000_000)
        builder.store(builder.sdiv(args[0], billion), pointer)
        builder.store(builder.srem(args[0], billion), builder.gep(pointer, [_I64(1)]))
        nanosleep = _declare(builder, "clock_nanosleep", _I32, _I32, _I64.as_pointer(), _I64.as_pointer())
        null = ir.Constant(_I64.as_pointer(), None)
        return builder.call(nanosleep, [_I32(CLOCK_MONOTONIC), _I32(TIMER_ABSTIME), pointer, null])

    return types.int32(types.int64), codegen


# () → int64 [ns]
now_ns: Any = intrinsic(_now)
# (t_ns) → 0, or the errno of clock_nanosleep; returns early on a signal (EINTR)
sleep_until_ns: Any = intrinsic(_sleep_until)


@jit
def wait_until_ns(t_ns: Any, spin_ns: Any) -> Any:
    """Sleep to `spin_ns` before `t_ns`, then spin; returns the time at the end [ns].

    Ends early only when the sleep is interrupted by a signal; the caller looks at the time.
    """
    now = now_ns()
    if t_ns - now > spin_ns:
        sleep_until_ns(t_ns - spin_ns)
        now = now_ns()
    while now < t_ns:
        now = now_ns()
    return now
