"""The true poses of the last moments, for a sensor that shows what was measured a while ago."""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit
from surffollow.shm.schema import F64, I64, Schema

POSES = 1024  # at the driver thread's 2 kHz: 0.5 s, more than the largest latency
EXTRAPOLATE_NS = 20_000_000
REPORT_GAPS = 1.5  # how long a report is carried on by its velocity, as a multiple of the last two's distance
STALE_NS = 100_000_000


class PoseHistory(Schema):
    """A ring of poses, timestamps ascending."""

    count = I64(doc="poses ever added")
    carry_ns = I64(unit="ns", doc="how long the newest pose is carried on by its velocity; at least 20 ms")
    t_ns = I64(POSES, unit="ns")
    pose = F64(POSES * 7, unit="m, 1", doc="x y z qx qy qz qw, world from tool")
    velocity = F64(POSES * 6, unit="m/s, rad/s", doc="linear, angular; world axes")


@jit
def add_pose(history: Any, t_ns: Any, pose: Any, velocity: Any) -> Any:
    """Append a pose that is newer than all before.

    Parameters
    ----------
    history : (1,) `PoseHistory`, updated in place
    t_ns : int64 [ns]
    pose : (7,) float64
    velocity : (6,) float64

    Returns
    -------
    int64  1: added; 0: not newer
    """
    h = history[0]
    count = h.count
    if count > 0 and t_ns <= h.t_ns[(count - 1) % POSES]:
        return 0
    i = count % POSES
    h.t_ns[i] = t_ns
    for k in range(7):
        h.pose[7 * i + k] = pose[k]
    for k in range(6):
        h.velocity[6 * i + k] = velocity[k]
    history[0].count = count + 1
    return 1


@jit
def add_report(history: Any, t_ns: Any, pose: Any, velocity: Any) -> Any:
    """Append a pose that came without a velocity: the difference to the report before gives it.

    Parameters
    ----------
    history : (1,) `PoseHistory`, updated in place
    t_ns, pose : see `add_pose`
    velocity : (6,) float64, scratch

    Returns
    -------
    int64  1: added; 0: not newer
    """
    h = history[0]
    count = h.count
    for k in range(6):
        velocity[k] = 0.0
    carry_ns = 0
    if count > 0:
        last = (count - 1) % POSES
        gap = t_ns - h.t_ns[last]
        if 0 < gap <= STALE_NS:
            carry_ns = min(int(REPORT_GAPS * gap), STALE_NS)
            rate = 1e9 / gap
            for k in range(3):
                velocity[k] = (pose[k] - h.pose[7 * last + k]) * rate
            # twice the vector part of (new attitude ∘ inverse of the last): the angle, where it is small
            ax, ay, az, aw = pose[3], pose[4], pose[5], pose[6]
            i = 7 * last
            bx, by, bz, bw = -h.pose[i + 3], -h.pose[i + 4], -h.pose[i + 5], h.pose[i + 6]
            sign = 2.0 * rate if aw * bw - ax * bx - ay * by - az * bz >= 0.0 else -2.0 * rate
            velocity[3] = sign * (aw * bx + ax * bw + ay * bz - az * by)
            velocity[4] = sign * (aw * by - ax * bz + ay * bw + az * bx)
            velocity[5] = sign * (aw * bz + ax * by - ay * bx + az * bw)
    if add_pose(history, t_ns, pose, velocity) == 0:
        return 0
    history[0].carry_ns = carry_ns
    return 1


@jit
def pose_at(history: Any, t_ns: Any, out: Any) -> Any:
    """Pose at a time: interpolated, or extrapolated by the velocity for at most `carry_ns` and then held.

    Parameters
    ----------
    history : (1,) `PoseHistory`
    t_ns : int64 [ns]
    out : (7,) float64, written when known

    Returns
    -------
    int64  1: known; 0: before the history, 100 ms after it, or in a gap of more than 100 ms
    """
    h = history[0]
    count = h.count
    if count == 0:
        return 0
    last = (count - 1) % POSES
    if t_ns >= h.t_ns[last]:
        age = t_ns - h.t_ns[last]
        if age > STALE_NS:
            return 0
        dt = min(age, max(EXTRAPOLATE_NS, h.carry_ns)) * 1e-9
        for k in range(3):
            out[k] = h.pose[7 * last + k] + dt * h.velocity[6 * last + k]
        qx, qy, qz, qw = (
            h.pose[7 * last + 3],
            h.pose[7 * last + 4],
            h.pose[7 * last + 5],
            h.pose[7 * last + 6],
        )
        wx, wy, wz = (
            0.5 * dt * h.velocity[6 * last + 3],
            0.5 * dt * h.velocity[6 * last + 4],
            0.5 * dt * h.velocity[6 * last + 5],
        )
        out[3] = qx + wx * qw + wy * qz - wz * qy
        out[4] = qy + wy * qw + wz * qx - wx * qz
        out[5] = qz + wz * qw + wx * qy - wy * qx
        out[6] = qw - wx * qx - wy * qy - wz * qz
        _normalise(out)
        return 1
    oldest = max(0, count - POSES)
    j = count - 1
    while j > oldest and h.t_ns[(j - 1) % POSES] > t_ns:
        j -= 1
    if j == oldest:
        return 0
    after, before = j % POSES, (j - 1) % POSES
    gap = h.t_ns[after] - h.t_ns[before]
    if gap > STALE_NS:
        return 0
    w = (t_ns - h.t_ns[before]) / gap
    dot = 0.0
    for k in range(3, 7):
        dot += h.pose[7 * before + k] * h.pose[7 * after + k]
    sign = 1.0 if dot >= 0.0 else -1.0
    for k in range(7):
        s = sign if k >= 3 else 1.0
        out[k] = (1.0 - w) * h.pose[7 * before + k] + w * s * h.pose[7 * after + k]
    _normalise(out)
    return 1


@jit
def _normalise(pose: Any) -> None:
    norm = math.sqrt(pose[3] ** 2 + pose[4] ** 2 + pose[5] ** 2 + pose[6] ** 2)
    for k in range(3, 7):
        pose[k] /= norm
