"""What a pose must be before it is posted; the service checks its copy once more."""

from __future__ import annotations

import math
from collections.abc import Sequence

from surffollow.errors import PoseError

FUTURE_NS = 1_000_000
NORM_TOLERANCE = 1e-3
MAX_POSITION_M = 1e9


def checked_pose(pose: Sequence[float]) -> tuple[float, ...]:
    """The seven numbers as floats, the quaternion normalised.

    Raises
    ------
    PoseError  not finite, farther than 1e9 m from the origin, or the norm is off by more than 1e-3
    """
    values = [float(v) for v in pose]
    if not all(math.isfinite(v) for v in values):
        raise PoseError(f"a pose must be finite, not {values}")
    if any(abs(v) >= MAX_POSITION_M for v in values[:3]):
        raise PoseError(f"a position must be within {MAX_POSITION_M:g} m of the origin, not {values[:3]}")
    norm = math.sqrt(sum(v * v for v in values[3:]))
    if abs(norm - 1.0) > NORM_TOLERANCE:
        raise PoseError(f"the quaternion's norm is {norm:.6g}; it must be 1 within {NORM_TOLERANCE:g}")
    return (*values[:3], *(v / norm for v in values[3:]))
