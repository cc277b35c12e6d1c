"""Checks of a pose before it is posted; the service checks its copy once more."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence

from surffollow.config.pose_limits import MAX_POSITION_M, NORM_TOLERANCE
from surffollow.errors import PoseError
from surffollow.units import format_ns

FUTURE_NS = 1_000_000
_FARTHEST_NS = 1 << 62


def checked_pose(pose: Sequence[float]) -> tuple[float, ...]:
    """The seven numbers as floats, the quaternion normalised.

    Raises
    ------
    PoseError  not finite, farther than 1e9 m from the origin, or the norm is off by more than 1e-3
    """
    try:
        values = [float(v) for v in pose]
    except (TypeError, ValueError, OverflowError):
        raise PoseError(f"a pose is seven finite numbers, not {pose!r}") from None
    if not all(math.isfinite(v) for v in values):
        raise PoseError(f"a pose must be finite, not {values}")
    if any(abs(v) >= MAX_POSITION_M for v in values[:3]):
        raise PoseError(f"a position must be within {MAX_POSITION_M:g} m of the origin, not {values[:3]}")
    norm = math.sqrt(sum(v * v for v in values[3:]))
    if abs(norm - 1.0) > NORM_TOLERANCE:
        raise PoseError(f"the quaternion's norm is {norm:.6g}; it must be 1 within {NORM_TOLERANCE:g}")
    return (*values[:3], *(v / norm for v in values[3:]))


def checked_stamp(t_ns: object, now_ns: int, oldest_ns: int) -> int:
    """A pose's time as a plain int.

    Raises
    ------
    PoseError  not a whole number, more than 1 ms ahead, or longer ago than `oldest_ns`
    """
    try:
        given = operator.index(t_ns)  # type: ignore[arg-type]
    except TypeError:
        raise PoseError(f"t_ns must be a whole number of ns of CLOCK_MONOTONIC, not {t_ns!r}") from None
    stamp = max(-_FARTHEST_NS, min(given, _FARTHEST_NS))  # a number of any size is refused by its distance
    if stamp > now_ns + FUTURE_NS:
        raise PoseError(f"the pose is stamped {format_ns(stamp - now_ns)} in the future; use CLOCK_MONOTONIC")
    if now_ns - stamp > oldest_ns:
        raise PoseError(
            f"the pose is {format_ns(now_ns - stamp)} old; the service takes none older than "
            f"{format_ns(oldest_ns)} (pose_timeout_ns)"
        )
    return stamp
