"""The map of the surface: grids, their update, the ways to lay them anew, and their files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surffollow.map.height_map import HeightMap

__all__ = ["HeightMap"]


def __dir__() -> list[str]:
    """Names that can be used here."""
    return sorted({*(n for n in globals() if n.startswith("__")), *__all__})


def __getattr__(name: str) -> Any:
    # lazily, since it loads numba, and the client library reads this package's files without
    if name == "HeightMap":
        from surffollow.extras import attribute_of

        return attribute_of("surffollow.map.height_map", name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
