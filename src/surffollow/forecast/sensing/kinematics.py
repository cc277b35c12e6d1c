"""Position and velocity of the tool from the pose history, in plain numbers."""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.pose import rotate
from surffollow.forecast.scales import plain_time
from surffollow.shm.jit import jit
from surffollow.shm.layout_follow import POSES

SPAN_TAUS = 4.0  # history of the velocity fit, in time constants of the axis …
LEAST_POSES, MOST_POSES = 4, 64  # … and in reports
SIGNIFICANT = 6.0  # travel over the fit's residual from which the direction of travel counts as known
INTERVAL_RATE = 0.1


@jit
def observe_motion(params: Any, m: Any, sense: Any, t_ns: Any) -> None:
    """Bring position, velocity and the interval of reports up to date.

    Velocity is the slope of a least-squares line through the reports of the last 4 τ. While the travel within
    them is less than six residual standard deviations the lateral speed counts as 0.
    """
    k, r = m.kinematics, m.reference
    n = sense.pose_count
    last = (n - 1) & (POSES - 1)
    k.now = max(k.now, plain_time(r, max(t_ns, sense.pose_t_ns[last])))
    if n == k.poses:
        return
    t = plain_time(r, sense.pose_t_ns[last])
    if k.poses > 0 and n > k.poses and t > k.pose_t:
        dt = (t - k.pose_t) / (n - k.poses)
        k.interval = dt if k.interval == 0.0 else k.interval + INTERVAL_RATE * (dt - k.interval)
    k.poses, k.pose_t = n, t
    k.x, k.y = sense.pose[7 * last] / r.length_m, sense.pose[7 * last + 1] / r.length_m
    k.z = sense.pose[7 * last + 2] / r.length_m
    _point_at_ground(params, m, sense.pose, 7 * last)
    st = sx = sy = sz = stt = stx = sty = stz = sxx = 0.0
    count = 0
    for j in range(min(n, MOST_POSES, POSES)):
        i = (n - 1 - j) & (POSES - 1)
        dt = plain_time(r, sense.pose_t_ns[i]) - t
        if count >= LEAST_POSES and -dt > SPAN_TAUS * r.tau:
            break
        x, y = sense.pose[7 * i] / r.length_m - k.x, sense.pose[7 * i + 1] / r.length_m - k.y
        z = sense.pose[7 * i + 2] / r.length_m - k.z
        st, stt, count = st + dt, stt + dt * dt, count + 1
        sx, sy, sz = sx + x, sy + y, sz + z
        stx, sty, stz, sxx = stx + dt * x, sty + dt * y, stz + dt * z, sxx + x * x + y * y
    spread = stt - st * st / count
    if count < 2 or not spread > 0.0:
        k.vx = k.vy = k.climb = k.speed = 0.0
        return
    k.vx, k.vy = (stx - st * sx / count) / spread, (sty - st * sy / count) / spread
    k.climb = (stz - st * sz / count) / spread
    v2 = k.vx * k.vx + k.vy * k.vy
    residual = sxx - (sx * sx + sy * sy) / count - v2 * spread
    # the sum of squares that the line explains, against that which it leaves
    known = v2 * spread * (count - 1) > SIGNIFICANT * max(residual, 0.0)
    k.speed = math.sqrt(v2) if known else 0.0


@jit
def _point_at_ground(params: Any, m: Any, poses: Any, at: Any) -> None:
    """Find the ground point on the tool's axis at the stand-off.

    The axis is that of the tool's frame which channel 0's beam lies nearest to.
    """
    k, r, mount = m.kinematics, m.reference, params.tool_from_sensor
    x, y, z = rotate(mount[3], mount[4], mount[5], mount[6], 0.0, 0.0, -r.standoff)
    along_z = abs(z) >= abs(x) and abs(z) >= abs(y)
    along_x = not along_z and abs(x) >= abs(y)
    x = mount[0] / r.length_m + x if along_x else 0.0
    y = 0.0 if along_x or along_z else mount[1] / r.length_m + y
    z = mount[2] / r.length_m + z if along_z else 0.0
    k.tip_x, k.tip_y, tip_z = rotate(poses[at + 3], poses[at + 4], poses[at + 5], poses[at + 6], x, y, z)
    k.drop = -tip_z


@jit
def reset_motion(m: Any) -> None:
    """Forget positions and times in other reference scales."""
    m.kinematics.poses = 0
    m.kinematics.now = m.kinematics.interval = 0.0
