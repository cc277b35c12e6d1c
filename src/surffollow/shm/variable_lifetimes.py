"""Find which variables of a kernel are alive where only for the steps that use it.

numba finds it after each of its steps, eight times per kernel. Two of them use it, which write down where a
variable ends. Else only generators, `with` blocks and object mode do, which kernels have not.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from numba.core import ir, postproc, transforms

_Processor: Any = postproc.PostProcessor
_Part: Any = ir.Inst
_run_ordinarily: Any = _Processor.run
_list_ordinarily: Any = _Part._rec_list_vars
_NO_VARIABLES = (ir.Loc, str, int, bool, type(None))


def _run(processor: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
    """As numba's `PostProcessor.run`; without ends of variables it puts the blocks in order only."""
    function = processor.func_ir
    if emit_dels or function.is_generator:
        _run_ordinarily(processor, emit_dels, extend_lifetimes)
        return
    function.blocks = transforms.canonicalize_cfg(function.blocks)
    function.variable_lifetime = postproc.VariableLifetime(function.blocks)  # finds what it is asked for
    function.generator_info = None


def _list(part: Any, value: Any) -> Any:
    """As numba's `Inst._rec_list_vars`, which asks of each value what it is, places in files included."""
    if isinstance(value, ir.Var):
        return [value]
    if isinstance(value, ir.Inst):
        return value.list_vars()
    if isinstance(value, dict):
        value = value.values()
    elif not isinstance(value, (list, tuple)):
        return []
    return [v for inner in value if type(inner) not in _NO_VARIABLES for v in _list(part, inner)]


@contextlib.contextmanager
def lifetimes_when_used() -> Iterator[None]:
    """Spare numba what nothing uses while kernels compile; under numba's lock."""
    if _Processor.run is _run:  # a kernel that a kernel calls
        yield
        return
    _Processor.run, _Part._rec_list_vars = _run, _list
    try:
        yield
    finally:
        _Processor.run, _Part._rec_list_vars = _run_ordinarily, _list_ordinarily
