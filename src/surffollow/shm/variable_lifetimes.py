"""Find which variables of a kernel are alive where only for the steps that use it.

numba finds it after each of its steps, eight times per kernel. Two of them use it, which write down where a
variable ends. Else only generators, `with` blocks and object mode do, which kernels have not.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import cache
from typing import Any

from numba.core import ir, postproc, transforms

from surffollow.shm.replaced_functions import Replacement, is_known, replaced

_Processor: Any = postproc.PostProcessor
_Part: Any = ir.Inst
_run_ordinarily: Any = _Processor.run


def _run(processor: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
    """As numba's `PostProcessor.run`; without ends of variables it puts the blocks in order only."""
    function = processor.func_ir
    if emit_dels or function.is_generator:
        _run_ordinarily(processor, emit_dels, extend_lifetimes)
        return
    function.blocks = transforms.canonicalize_cfg(function.blocks)
    function.variable_lifetime = postproc.VariableLifetime(function.blocks)  # finds what it is asked for
    function.generator_info = None


@cache
def _kind(of: Any) -> Any:
    """The kind that `_list` takes values of a class for; `isinstance` of such classes runs in Python."""
    return next((kind for kind in (ir.Var, ir.Inst, dict, list, tuple) if issubclass(of, kind)), None)


def _list(part: Any, value: Any) -> Any:
    """As numba's `Inst._rec_list_vars`, which asks of each value what it is, places in files included."""
    found, waiting = [], [value]
    while waiting:
        value = waiting.pop()
        of: Any = type(value)
        kind = _kind(of)
        if kind is ir.Var:
            found.append(value)
        elif kind is ir.Inst:
            found += value.list_vars()
        elif kind is dict:
            waiting += reversed(value.values())
        elif kind is not None:
            waiting += reversed(value)
    return found


def _replacements() -> Iterator[Replacement]:
    """Name what is replaced: functions that this version of numba has as they are known."""
    uses = """func_ir blocks transforms canonicalize_cfg VariableLifetime variable_lifetime analysis items
        compute_live_variables cfg usedefs defmap deadmaps combined block_entry_vars is_generator
        GeneratorInfo generator_info _compute_generator_info _insert_var_dels"""
    if is_known(_Processor, "run", "self emit_dels extend_lifetimes", uses):
        yield _Processor, "run", _run
    uses = "isinstance Var Inst list_vars list tuple extend _rec_list_vars dict values"
    if is_known(_Part, "_rec_list_vars", "self val", uses):
        yield _Part, "_rec_list_vars", _list


@contextlib.contextmanager
def lifetimes_when_used() -> Iterator[None]:
    """Spare numba what nothing uses while kernels compile; under numba's lock."""
    with replaced(_replacements):
        yield
