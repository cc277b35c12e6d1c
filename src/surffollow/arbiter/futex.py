"""Futexes for kernels: sleep until one of several words changes, wake who sleeps on a word.

Shared words of 32 bits: the low halves of words of 64. Linux 5.16 knows futex_waitv; on an older
kernel the caller must pace itself.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

_I64 = ir.IntType(64)
_SYS_FUTEX = {"x86_64": 202, "aarch64": 98}
_SYS_FUTEX_WAITV = 449
_WAKE, _ALL = 1, 0x7FFFFFFF
FUTEX_32 = 2


def _machine() -> str:
    import platform

    return platform.machine()


_FUTEX = _SYS_FUTEX.get(_machine(), 202)


def _syscall(builder: Any, number: int, *arguments: Any) -> Any:
    kind = ir.FunctionType(_I64, [_I64], var_arg=True)
    module = builder.module
    function = module.globals.get("syscall") or ir.Function(module, kind, "syscall")
    return builder.call(function, [_I64(number), *arguments])


def _wake(typingctx: Any, address: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _syscall(builder, _FUTEX, args[0], _I64(_WAKE), _I64(_ALL))

    return types.int64(types.int64), codegen


def _wait_any(typingctx: Any, waiters: Any, count: Any, until_ns: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        with builder.goto_entry_block():
            slot = builder.alloca(ir.ArrayType(_I64, 2))
        pointer = builder.bitcast(slot, _I64.as_pointer())
        billion = _I64(1_000_000_000)
        builder.store(builder.sdiv(args[2], billion), pointer)
        builder.store(builder.srem(args[2], billion), builder.gep(pointer, [_I64(1)]))
        timeout = builder.ptrtoint(pointer, _I64)
        monotonic = _I64(1)
        return _syscall(builder, _SYS_FUTEX_WAITV, args[0], args[1], _I64(0), timeout, monotonic)

    return types.int64(types.int64, types.int64, types.int64), codegen


# (address) → how many were woken
futex_wake: Any = intrinsic(_wake)
# (address of value, address and flags of each word, number of words, time) → number of the word that woke, or
# -1: the time is over, a word had changed already, a signal came, or the kernel knows no such call
futex_wait_any: Any = intrinsic(_wait_any)
