"""Remember how numba types its own functions and operators while kernels compile.

For each `a + b` numba tries some ten rules, most of which fail with an exception: once when it finds types,
and once more when it makes LLVM's code. A kernel repeats few combinations of operator and types.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import partial
from typing import Any

from numba.core import targetconfig, types
from numba.core.typing import Context

from surffollow.shm.replaced_functions import Replacement, is_known, replaced

_known: dict[Any, tuple[Any, Any]] = {}  # function, arguments, options → signature, key of the implementation
_resolve_ordinarily: Any = Context.resolve_function_type
_call_ordinarily: Any = types.Function.get_call_type


def _recall(find: Any, function: Any, args: Any) -> Any:
    """The signature of a function for arguments as it is known, or as `find` finds it; or None."""
    try:
        options = targetconfig.ConfigStack.top_or_none()
        key = function, args, repr(options and options._values)
        implementations = function._impl_keys
    except AttributeError:  # in another version of numba
        return find()
    if key in _known:
        signature, implementation = _known[key]
        implementations[signature.args] = implementation
        return signature
    signature = find()
    if signature is not None and signature.args in implementations:
        _known[key] = signature, implementations[signature.args]
    return signature


def _resolve(context: Any, function: Any, args: Any, kws: Any) -> Any:
    """As numba's `Context.resolve_function_type`."""
    find = partial(_resolve_ordinarily, context, function, args, kws)
    found = function if isinstance(function, types.Type) else context._lookup_global(function)
    return find() if kws or not isinstance(found, types.Function) else _recall(find, found, args)


def _call_type(function: Any, context: Any, args: Any, kws: Any) -> Any:
    """As numba's `Function.get_call_type`."""
    find = partial(_call_ordinarily, function, context, args, kws)
    return find() if kws else _recall(find, function, args)


def _replacements(context: Any) -> Iterator[Replacement]:
    """Name what is replaced: functions that this version of numba has as they are known."""
    finds = is_known(Context, "resolve_function_type", "self func args kws")
    if finds and is_known(Context, "_lookup_global", "self gv"):
        yield context, "resolve_function_type", partial(_resolve, context)
    if is_known(types.Function, "get_call_type", "self context args kws"):
        yield types.Function, "get_call_type", _call_type


@contextlib.contextmanager
def remembered(context: Any) -> Iterator[None]:
    """Remember, and use what is remembered, in numba's typing context; under numba's lock."""
    with replaced(_replacements, context):
        yield
