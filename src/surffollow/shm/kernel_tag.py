"""Names of kernels' parts: each tells one part apart from all others, in every process.

numba's text of a type leaves out the fields of a named tuple, and its text of some types holds an address.

The source stamp covers files, which can differ from the modules in memory: Python trusts a `.pyc` of the
same size and second, and a file can change before it is imported. So a tag also covers the bytecode and
constants that a kernel is compiled from.
"""

from __future__ import annotations

import enum
import hashlib
import marshal
import sys
from functools import cache
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
from numba.core import types

HERE = "here"  # begins tags that mean something in this process alone
_EXACT = (types.Number, types.Boolean, types.Record, types.Array, types.NoneType, types.UnicodeType)
_PLAIN = (bool, int, float, complex, str, bytes, type(None), np.generic, np.dtype, enum.Enum)


def tag_of(name: str, args: tuple[Any, ...], options: Any, py_func: Any, kept: bool) -> str:
    """A name of the part of a kernel for arguments of these types.

    Parameters
    ----------
    name : of the kernel, with its module
    args : numba's types
    options : of the kernel's compilation
    py_func : the function
    kept : whether other processes find the kernel by its name
    """
    here = [] if kept else [id(py_func)]
    text = repr((name, [_type_text(a, here) for a in args], sorted(map(str, options.items())), here))
    total = hashlib.blake2b(text.encode(), digest_size=12)
    reached, waiting = {py_func: None}, [py_func]
    while waiting:
        digest, referred = _content(waiting.pop())
        total.update(digest)
        fresh = dict.fromkeys(f for f in referred if f not in reached)
        reached |= fresh
        waiting += fresh
    return (HERE if here else "") + total.hexdigest()


def _type_text(kind: Any, here: list[int]) -> str:
    """Text of a type; `here` gets what only this process tells apart."""
    if isinstance(kind, types.BaseTuple):
        inner = ", ".join(_type_text(k, here) for k in kind)  # type: ignore[attr-defined]
        if isinstance(kind, types.BaseNamedTuple):
            its: Any = kind.instance_class  # type: ignore[attr-defined]
            if not _is_found(its):
                here.append(id(its))
            inner += f" of {its.__module__}.{its.__qualname__}{its._fields}"
        return f"({inner})"
    if not isinstance(kind, _EXACT) and not isinstance(getattr(kind, "value", kind), _PLAIN):  # an Omitted's
        here.append(id(kind))
    return str(kind)


def _is_found(its: Any) -> bool:
    """Whether a class is found by its name in another process; not in one that runs another script."""
    found = getattr(sys.modules.get(its.__module__), its.__qualname__, None)
    return found is its and its.__module__ != "__main__"


@cache
def _content(py_func: Any) -> tuple[bytes, list[Any]]:
    """Hash over the bytecode and the plain values that it refers to; the functions that it refers to."""
    functions: list[Any] = []
    names: list[str] = []
    code = marshal.dumps(_bare(py_func.__code__, names), 2)  # version 2: the same bytes for equal code
    values = [py_func.__defaults__, *(c.cell_contents for c in py_func.__closure__ or ())]
    for name in names:
        value = py_func.__globals__.get(name)
        values.append(value)
        if isinstance(value, ModuleType) and value.__name__.startswith("surffollow"):
            values += [getattr(value, n, None) for n in names]
    text = repr([_value_text(v, functions) for v in values])
    return hashlib.blake2b(code + text.encode(), digest_size=12).digest(), functions


def _bare(code: CodeType, names: list[str]) -> CodeType:
    """Code without its place in a file; `names` gets the names in it."""
    names += code.co_names
    constants = tuple(_bare(c, names) if isinstance(c, CodeType) else c for c in code.co_consts)
    return code.replace(co_filename="", co_firstlineno=1, co_linetable=b"", co_consts=constants)


def _value_text(value: Any, functions: list[Any]) -> str:
    """Text of a plain value; of others their kind, and `functions` gets functions."""
    function = getattr(value, "py_func", value)
    if isinstance(function, FunctionType):
        functions.append(function)
    elif isinstance(value, (tuple, list)):
        return f"{getattr(value, '_fields', '')}({', '.join(_value_text(v, functions) for v in value)})"
    elif isinstance(value, np.ndarray):
        return f"{value.dtype!r} {value.shape} {hashlib.blake2b(value.tobytes()).hexdigest()}"
    elif isinstance(value, enum.EnumMeta):
        return repr(list(value.__members__.items()))
    elif isinstance(value, _PLAIN):
        return repr(value)
    return f"{type(value).__name__} {getattr(value, '__name__', '')} {getattr(value, '_fields', '')}"
