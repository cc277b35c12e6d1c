"""Remember how numba types its own functions and operators while kernels compile.

For each `a + b` numba tries some ten rules, most of which fail with an exception. A kernel repeats few
combinations of operator and types.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import partial
from typing import Any

from numba.core import types
from numba.core.targetconfig import ConfigStack
from numba.core.typing import Context

_known: dict[Any, tuple[Any, Any]] = {}  # function, arguments, options → signature, key of the implementation


def _resolve(context: Any, function: Any, args: Any, kws: Any) -> Any:
    """As numba's `Context.resolve_function_type`: a signature, or None."""
    ordinary: Any = Context.resolve_function_type
    found = function if isinstance(function, types.Type) else context._lookup_global(function)
    if kws or not isinstance(found, types.Function):
        return ordinary(context, function, args, kws)
    options = ConfigStack.top_or_none()
    key = found, args, repr(options and options._values)
    if key in _known:
        signature, implementation = _known[key]
        found._impl_keys[signature.args] = implementation
        return signature
    signature = ordinary(context, function, args, kws)
    if signature is not None and signature.args in found._impl_keys:
        _known[key] = signature, found._impl_keys[signature.args]
    return signature


@contextlib.contextmanager
def remembered(context: Any) -> Iterator[None]:
    """Remember, and use what is remembered, in numba's typing context; under numba's lock."""
    if "resolve_function_type" in vars(context):  # a kernel that a kernel calls
        yield
        return
    context.resolve_function_type = partial(_resolve, context)
    try:
        yield
    finally:
        del context.resolve_function_type
