"""surffollow: follow and map surfaces with a stand-off sensor; see `surffollow.client` and `Follower`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surffollow.follower import Follower

__all__ = ["Follower"]


def __getattr__(name: str) -> Any:
    """Load the follower's kernels only when somebody asks for them."""
    if name == "Follower":
        from surffollow.follower import Follower

        return Follower
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
