"""Mounts and poses that give no surface below: named in the status's note.

Three or more sensors whose mounts give no surface normal; a beam that points upward, as with a world whose z
axis is down.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from surffollow.hw.driver import IDENTITY, DriverInfo, Mount
from surffollow.shm.layout_follow import MODE_ADAPTIVE, POSES, Params
from surffollow.shm.python_atomics import load_acquire

LEAST_SENSORS = 3  # of a plane
MIN_SPREAD = 0.1  # least width of the footprints over their length, as in `plane_regression`
LEVEL_RAD = 1e-3  # a level beam is no upward one
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


def beam_tilt(pose: Sequence[float], mount: Mount) -> float:
    """Angle between a sensor's beam and straight down [rad]: 0 is down, π is up.

    Parameters
    ----------
    pose : world from tool, x y z [m] and a unit quaternion
    mount : tool from sensor, the same
    """
    x, y, z, w = pose[3:7]
    mx, my, mz, mw = mount[3:7]
    qx = w * mx + x * mw + y * mz - z * my
    qy = w * my - x * mz + y * mw + z * mx
    cosine = 1.0 - 2.0 * (qx * qx + qy * qy)  # of the sensor's z axis to the world's
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def beam_note(pose: Sequence[float], mount: Mount) -> str:
    """Text about a pose in which the beam of channel 0 points upward; empty otherwise."""
    tilt = beam_tilt(pose, mount)
    if not tilt > 0.5 * np.pi + LEVEL_RAD:
        return ""
    return (
        f"the beam of channel 0 points upward in the newest pose ({np.degrees(tilt):.0f} deg from down): "
        "stop the robot; z of the world is up, and a beam leaves along -z of its sensor "
        "(docs/explanation/frames.md)"
    )


class MountWatch:
    """The notes: of the normal while rotations are asked for, of the beam while a client sends poses.

    Parameters
    ----------
    params : (1,) record of `Params`       those in force, which the cycle thread changes
    info : DriverInfo                      with the mounts
    state : (1,) record of `FollowState`   with the reported poses, of the cycle thread
    """

    def __init__(self, params: Any, info: DriverInfo, state: Any) -> None:
        self._params, self._sense, self._mount = params, state[0]["sense"], info.mounts[0]
        self._note = mount_note(info.mounts[: info.n_channels], float(params[0]["offset_m"]))

    def notes(self) -> list[str]:
        """A line where `orient` asks for rotations that the mounts cannot give (main thread)."""
        at = self._params.ctypes.data
        mode, orient = (int(load_acquire(at + Params.offset(name))) for name in ("mode", "orient"))
        return [self._note] if self._note and mode == MODE_ADAPTIVE and orient else []

    def beam_notes(self) -> list[str]:
        """A line where the beam of channel 0 points upward in the newest pose (main thread)."""
        count = int(self._sense["pose_count"])
        if count == 0:
            return []
        at = 7 * ((count - 1) % POSES)
        note = beam_note(self._sense["pose"][at : at + 7].tolist(), self._mount)
        return [note] if note else []
