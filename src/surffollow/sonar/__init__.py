"""Wall poses from beam-spread sonars (docs/explanation/wall-pose.md, docs/reference/sonar.md)."""

from __future__ import annotations

from typing import Any

# name → module
_HOME = {
    "WallPose": "wall",
    "fused_pose": "fused_poses",
    "optimal_pair": "pair_poses",
    "wall_pose": "pair_poses",
    "walls": "fused_poses",
}

__all__ = sorted(_HOME)


def __dir__() -> list[str]:
    """Names that can be used here."""
    return sorted({*(n for n in globals() if n.startswith("__")), *__all__})


def __getattr__(name: str) -> Any:
    """Load a name on its first use: all of them load numba."""
    if name in _HOME:
        from surffollow.extras import attribute_of

        return attribute_of(f"surffollow.sonar.{_HOME[name]}", name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
