"""Poses and ranges of an embedder, checked and written as the kernels take them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.config.pose_limits import MAX_POSITION_M, NORM_TOLERANCE
from surffollow.errors import PoseError, UsageError


def _real(value: object) -> float:
    """A real number as float; text and truth values are no numbers."""
    if isinstance(value, (str, bytes, bool, np.bool_, complex)):
        raise TypeError(value)
    return float(value)  # type: ignore[arg-type]


def _reading(value: object) -> float:
    """A range as float; None, as NaN, is no reading."""
    return math.nan if value is None else _real(value)


def _is_vector(values: object) -> bool:
    """Whether NumPy copies the numbers as they are."""
    return isinstance(values, np.ndarray) and values.dtype.kind in "fiu" and values.ndim == 1


def write_pose(p: NDArray[np.float64], pose: Sequence[float] | NDArray[Any]) -> None:
    """Write a pose, its quaternion normalised.

    Parameters
    ----------
    p : (7,) float64
        receives x y z [m], qx qy qz qw
    pose : 7 numbers
        as given

    Raises
    ------
    PoseError
        not seven finite numbers, a quaternion whose norm is off by more than 1e-3, or a place too far away
    """
    try:
        if len(pose) != 7 or isinstance(pose, (str, bytes)):
            raise TypeError
        p[:] = pose if _is_vector(pose) else [_real(v) for v in pose]
    except (TypeError, ValueError, OverflowError):
        raise PoseError(f"a pose is seven numbers x y z qx qy qz qw, not {pose!r}") from None
    x, y, z, qx, qy, qz, qw = p.tolist()
    norm = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    if not (math.isfinite(x + y + z) and abs(norm - 1.0) <= NORM_TOLERANCE):
        raise PoseError(f"pose {p.tolist()} is not finite or its quaternion's norm is not 1")
    if max(abs(x), abs(y), abs(z)) > MAX_POSITION_M:
        raise PoseError(f"pose {p.tolist()} lies beyond {MAX_POSITION_M:g} m")
    p[3:] /= norm


def write_ranges(
    given_m: NDArray[np.float64], ranges_m: Sequence[float | None] | NDArray[Any], channels: int
) -> int:
    """Write the ranges of a step.

    Parameters
    ----------
    given_m : (≥ channels,) float64 [m]
        receives them; NaN: no reading
    ranges_m : numbers or None
        as given: one per channel, or a single NaN or None
    channels : int
        sensors of the configuration

    Returns
    -------
    int
        ranges given

    Raises
    ------
    UsageError
        not a number for each sensor
    """
    try:
        n = len(ranges_m)
        if n not in (channels, 1):
            raise _wrong_count(channels, n)
        given_m[:n] = ranges_m if _is_vector(ranges_m) else [_reading(v) for v in ranges_m]
    except UsageError:
        raise
    except (TypeError, ValueError, OverflowError):
        raise UsageError(
            f"step takes a list of ranges in m, not {ranges_m!r}; NaN or None: no reading"
        ) from None
    if n != channels and given_m[0] == given_m[0]:
        raise _wrong_count(channels, n)
    return n


def _wrong_count(channels: int, count: int) -> UsageError:
    return UsageError(
        f"step takes {channels} ranges, one per sensor of the configuration, not {count}; NaN: no reading"
    )
