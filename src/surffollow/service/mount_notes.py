"""Mounts of three or more sensors from which no surface normal follows: named in the status's note."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from surffollow.hw.driver import IDENTITY, DriverInfo, Mount
from surffollow.shm.layout_follow import MODE_ADAPTIVE, Params
from surffollow.shm.python_atomics import load_acquire

LEAST_SENSORS = 3  # of a plane
MIN_SPREAD = 0.1  # least width of the footprints over their length, as in `plane_regression`
MIN_SPREAD_M = 1e-3  # 20 standard deviations of a reading: 20 · 50 µm


def footprint_spread(mounts: Sequence[Mount], range_m: float) -> tuple[float, float]:
    """How far the footprints of sensors lie apart, in the tool's frame.

    Parameters
    ----------
    mounts : tool from sensor, x y z [m] and a unit quaternion, one per sensor
    range_m : distance along each beam [m]

    Returns
    -------
    float, float
        root of the sum of squares along the principal axes [m], the larger one first
    """
    x, y, _, qx, qy, qz, qw = np.array(mounts, np.float64).T
    beams_x, beams_y = -2.0 * (qx * qz + qy * qw), -2.0 * (qy * qz - qx * qw)  # of the sensors' -z
    places = np.stack([x + range_m * beams_x, y + range_m * beams_y])
    apart = np.linalg.svd(places - places.mean(axis=1, keepdims=True), compute_uv=False)
    return float(apart[0]), float(apart[1])


def mount_note(mounts: Sequence[Mount], range_m: float) -> str:
    """Why mounts give no surface normal; empty where they give one, and of fewer than three sensors.

    Parameters
    ----------
    mounts : one per channel in use
    range_m : stand-off [m]
    """
    if len(mounts) < LEAST_SENSORS:
        return ""
    along_m, across_m = footprint_spread(mounts, range_m)
    if across_m > max(MIN_SPREAD_M, MIN_SPREAD * along_m):
        return ""
    found = "the beams end nearly on one line"
    if all(m == IDENTITY for m in mounts):
        found = "no mounts are given"
    elif along_m <= MIN_SPREAD_M:
        found = f"the beams end within {1e3 * along_m:.2g} mm"
    return (
        f"{len(mounts)} channels and orient = on, but {found}: there is no surface normal, and the tool is "
        "not rotated to it; give mounts around the tool ([driver] mounts), or set orient = off"
    )


class MountWatch:
    """The note, while rotations are asked for.

    Parameters
    ----------
    params : (1,) record of `Params`  those in force, which the cycle thread changes
    info : DriverInfo                 with the mounts
    """

    def __init__(self, params: Any, info: DriverInfo) -> None:
        self._params = params
        self._note = mount_note(info.mounts[: info.n_channels], float(params[0]["offset_m"]))

    def notes(self) -> list[str]:
        """A line where `orient` asks for rotations that the mounts cannot give (main thread)."""
        at = self._params.ctypes.data
        mode, orient = (int(load_acquire(at + Params.offset(name))) for name in ("mode", "orient"))
        return [self._note] if self._note and mode == MODE_ADAPTIVE and orient else []
