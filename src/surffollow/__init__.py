"""surffollow: follow and map surfaces with a stand-off sensor; see `surffollow.client` and `Follower`."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any

# read by numba when it is imported: keep kernels where they are found again, see shm/kernel_cache.py
_LOCATORS = (
    "surffollow.shm.kernel_cache.KernelCacheLocator,UserProvidedCacheLocator,InTreeCacheLocator,"
    "UserWideCacheLocator,IPythonCacheLocator"
)
os.environ.setdefault("NUMBA_CACHE_LOCATOR_CLASSES", _LOCATORS)
if "numba.core.config" in sys.modules:  # numba came first and has read its environment already
    sys.modules["numba.core.config"].CACHE_LOCATOR_CLASSES = _LOCATORS  # type: ignore[attr-defined]

if TYPE_CHECKING:
    from surffollow.follower import Follower

__all__ = ["Follower"]


def __getattr__(name: str) -> Any:
    """Load the follower's kernels only when somebody asks for them."""
    if name == "Follower":
        from surffollow.errors import missing_library

        try:
            from surffollow.follower import Follower
        except ModuleNotFoundError as e:
            raise ModuleNotFoundError(missing_library(e) or str(e), name=e.name) from e

        return Follower
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
