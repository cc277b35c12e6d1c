"""Wall poses from beam-spread sonars (docs/explanation/wall-pose.md, docs/reference/sonar.md)."""

from __future__ import annotations

from typing import Any

__all__ = ["WallPose", "fused_pose", "optimal_pair", "wall_pose", "walls"]


def __getattr__(name: str) -> Any:
    # lazily, since they load numba
    if name in __all__:
        from surffollow.sonar import poses as module

        return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
