"""Wall poses from beam-spread sonars (docs/explanation/wall-pose.md, docs/reference/sonar.md)."""

from __future__ import annotations

from typing import Any

__all__ = ["WallPose", "fused_pose", "optimal_pair", "wall_pose", "walls"]


def __dir__() -> list[str]:
    """Names that can be used here."""
    return sorted({*(n for n in globals() if n.startswith("__")), *__all__})


def __getattr__(name: str) -> Any:
    """Load a name on its first use: all of them load numba."""
    if name in __all__:
        from surffollow.extras import attribute_of

        return attribute_of("surffollow.sonar.poses", name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
