"""Replace functions of numba for a while, each only where it is the function that is known.

They are private: another version may lack one, or do something else in it. Then that one stays as it is, and
kernels compile more slowly, with the same result.
"""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable, Iterable, Iterator
from typing import Any

Replacement = tuple[Any, str, Any]  # a class, module or object; a name in it; what is there for a while
_NOTHING = object()
_in_force: set[Any] = set()


def is_known(owner: Any, name: str, parameters: str, uses: str | None = None) -> bool:
    """Whether a class or module has a function as it is known.

    Parameters
    ----------
    owner, name : of the function
    parameters : their names in order, with spaces between
    uses : names of all globals and attributes in its code; None where its replacement calls it
    """
    function = getattr(owner, name, None)
    try:
        known = list(inspect.signature(function).parameters) == parameters.split()  # type: ignore[arg-type]
    except (TypeError, ValueError):  # no function
        return False
    return known and (uses is None or set(uses.split()) == set(function.__code__.co_names))  # type: ignore[union-attr]


@contextlib.contextmanager
def replaced(find: Callable[..., Iterable[Replacement]], *given: Any) -> Iterator[bool]:
    """Put what `find` names in its places, and afterwards what was there before; under numba's lock.

    Gives False, and replaces nothing, where the same is replaced already: for a kernel that a kernel calls.
    """
    if find in _in_force:
        yield False
        return
    with contextlib.ExitStack() as restore:
        _in_force.add(find)
        restore.callback(_in_force.discard, find)
        for owner, name, new in find(*given):
            before = vars(owner).get(name, _NOTHING)
            if before is _NOTHING:  # inherited
                setattr(owner, name, new)
                restore.callback(delattr, owner, name)
            else:
                setattr(owner, name, new)
                restore.callback(setattr, owner, name, before)
        yield True
