"""Spare numba what it does again for every statement of a kernel, with the same result.

- numba keeps its types in classes with an abstract metaclass, whose `isinstance` runs in Python, three
  million times in a cold start. No class is registered as a virtual subclass of one.
- numba looks in several tables for what implements an operation. For each table without an entry it writes an
  error message with all types, which is caught and dropped.
- For `a[0]` it looks for an implementation of constant indices first. Arrays have none, so it loads all its
  registries again. Here that is done once for each type.
- Whether an implementation takes a `loc` is read from its signature at each use.
- Before each statement a generator notes the context of a possible error.
- Python (from 3.11) takes frames from chunks of 16 KiB. A call that needs the next chunk maps memory, and its
  end unmaps it. Kernels that compile their callees recurse through many chunks.
"""

from __future__ import annotations

import contextlib
from abc import ABCMeta
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any

from numba.core import base, errors, lowering, typeinfer, types

from surffollow.shm.replaced_functions import Replacement, is_known, replaced

_Context: Any = base.BaseContext
_TypeClass: Any = type(types.Type)
_get_ordinarily: Any = _Context.get_function
_error_context: Any = getattr(errors, "new_error_context", None)
_missing: set[Any] = set()  # names of operations with types that have no implementation of their own
_FRAME_WORDS = 66_000  # more than half a chunk of 1 MiB: the other half is for the calls


def _get_function(context: Any, fn: Any, sig: Any, _firstcall: bool = True) -> Any:
    """As numba's `BaseContext.get_function`."""
    if not isinstance(fn, str):
        return _get_ordinarily(context, fn, sig, _firstcall)
    key = fn, sig.args
    if key in _missing:
        raise NotImplementedError(f"no definition of {fn}")
    try:
        return _get_ordinarily(context, fn, sig, _firstcall)
    except NotImplementedError:
        _missing.add(key)
        raise


def _find(selector: Any, sig: Any) -> Any:
    """As numba's `OverloadSelector._find`, whose callers catch the error."""
    candidates = selector._select_compatible(sig)
    if candidates:
        return candidates[selector._best_signature(candidates)]
    raise errors.NumbaNotImplementedError("no implementation")


class _ErrorContext:
    """As numba's `errors.new_error_context`, which is called where there is an error."""

    __slots__ = ("_about", "_args")

    def __init__(self, *args: Any, **about: Any) -> None:
        self._args, self._about = args, about

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if isinstance(error, errors.NumbaError):
            with _error_context(*self._args, **self._about):
                raise error


def _call(call: Callable[[], Any]) -> Any:
    return call()


def _with_room(call: Callable[[], Any]) -> Any:
    """Call from a frame whose chunk has room for half a megabyte of frames."""
    return call()


_with_room.__code__ = _with_room.__code__.replace(co_stacksize=_FRAME_WORDS)


def _replacements() -> Iterator[Replacement]:
    """Name what is replaced: functions that this version of numba has as they are known."""
    if is_known(_Context, "get_function", "self fn sig _firstcall"):
        yield _Context, "get_function", _get_function
    selector = getattr(base, "OverloadSelector", None)
    uses = "_select_compatible _best_signature errors NumbaNotImplementedError"
    if is_known(selector, "_find", "self sig", uses):
        yield selector, "_find", _find
    if is_known(base, "_has_loc", "fn"):
        yield base, "_has_loc", lru_cache(1 << 12)(getattr(base, "_has_loc"))  # noqa: B009
    if is_known(errors, "new_error_context", "fmt_ args kwargs"):
        for module in (lowering, typeinfer):
            if vars(module).get("new_error_context") is _error_context:
                yield module, "new_error_context", _ErrorContext
    if getattr(_TypeClass, "__instancecheck__", None) is ABCMeta.__instancecheck__:
        yield _TypeClass, "__instancecheck__", type.__instancecheck__


@contextlib.contextmanager
def shortcuts() -> Iterator[Callable[[Callable[[], Any]], Any]]:
    """Use the shortcuts while kernels compile; gives what calls with room. Under numba's lock."""
    with replaced(_replacements) as outermost:
        try:
            yield _with_room if outermost else _call
        finally:
            if outermost:
                _missing.clear()
