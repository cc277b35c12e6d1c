"""Poses in kernels: rotate by a quaternion, look up the pose of a moment, find footprints.

A pose is seven numbers, x y z [m] and a unit quaternion qx qy qz qw.
"""

import math

from surffollow.forecast import elementary
from surffollow.forecast.quantities import CONFIRMATION_SAMPLES, LONG_GAP_NS, MAX_GAP_NS
from surffollow.forecast.sensing.clock import scale_duration
from surffollow.shm.jit import jit, jit_inlined
from surffollow.shm.layout_follow import CLOCK_SET, POSES, REFUSED, TAKEN


@jit_inlined
def rotate(qx, qy, qz, qw, x, y, z):
    """The vector (x, y, z) turned by the unit quaternion: v + 2 q × (q × v + w v).

    Parameters
    ----------
    qx, qy, qz, qw : float64  unit quaternion
    x, y, z : float64         vector, in any unit

    Returns
    -------
    3 × float64
    """
    tx = qy * z - qz * y + qw * x
    ty = qz * x - qx * z + qw * y
    tz = qx * y - qy * x + qw * z
    return x + 2.0 * (qy * tz - qz * ty), y + 2.0 * (qz * tx - qx * tz), z + 2.0 * (qx * ty - qy * tx)


@jit_inlined
def to_world(pose, at, x, y, z):
    """The vector (x, y, z) in the frame of the pose at `pose[at:at+7]`, in world axes."""
    return rotate(pose[at + 3], pose[at + 4], pose[at + 5], pose[at + 6], x, y, z)


@jit
def rotation_between(u, v):
    """Rotation vector that turns unit vector u into v by the smaller angle, and that angle.

    For opposite vectors the axis is undefined; the rotation is then zero.

    Parameters
    ----------
    u, v : (3,) float64, or three of them  unit vectors

    Returns
    -------
    3 × float64, float64 [rad]
    """
    x, y, z = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
    sine = math.sqrt(x * x + y * y + z * z)
    if not sine > 1e-12:
        return (0.0, 0.0, 0.0), 0.0
    angle = elementary.angle(sine, u[0] * v[0] + u[1] * v[1] + u[2] * v[2])
    return (x * angle / sine, y * angle / sine, z * angle / sine), angle


@jit_inlined
def newest_until(times_ns, count, t_ns):
    """Number of the newest of `count` entries of a ring up to a time; the oldest one kept if none is.

    `times_ns` holds the times of the last entries; its length is a power of two.
    """
    k, oldest = count - 1, max(0, count - len(times_ns))
    while k > oldest and times_ns[k & (len(times_ns) - 1)] > t_ns:
        k -= 1
    return k


@jit_inlined
def newest_pose(sense):
    """Slot of the newest pose report in its rings."""
    return (sense.pose_count - 1) & (POSES - 1)


@jit_inlined
def push_pose(sense, t_ns, pose, at):
    """Append the pose at `pose[at:at+7]` to the history; 0 when it is not newer than the last (refused).

    Parameters
    ----------
    sense : record of `SenseState`  updated
    t_ns : int64                    timestamp
    pose : (≥ at + 7,) float64      x y z [m], qx qy qz qw
    at : int                        index of the first number
    """
    n = sense.pose_count
    if n > 0 and t_ns <= sense.pose_t_ns[newest_pose(sense)]:
        sense.poses_refused += 1
        return 0
    slot = n & (POSES - 1)
    sense.pose_t_ns[slot] = t_ns
    for i in range(7):
        sense.pose[slot * 7 + i] = pose[at + i]
    sense.pose_count = n + 1
    return 1


@jit
def is_set_back(sense, t_ns, gap_ns):
    """Whether a refused report is one of several in a row from a clock that was set back.

    Their timestamps rise among themselves, for longer than a gap, and have that far to go at least. Reports
    that were overtaken do not.

    Parameters
    ----------
    sense : record of `SenseState`  updated
    t_ns : int64                    timestamp of the report, not newer than the newest one
    gap_ns : int64                  longest gap that is no drop-out [ns]
    """
    if sense.back_count == 0 or t_ns < sense.back_newest_ns:  # a report may be given twice
        sense.back_count, sense.back_first_ns = 0, t_ns
    sense.back_newest_ns = t_ns
    sense.back_count += 1
    lasts = sense.back_count >= CONFIRMATION_SAMPLES and t_ns - sense.back_first_ns > gap_ns
    return lasts and sense.pose_t_ns[newest_pose(sense)] - t_ns > gap_ns


@jit
def report_pose(state, step_ns, t_ns, pose):
    """Append a pose report to the history.

    Parameters
    ----------
    state : (1,) records of `FollowState`
    step_ns, t_ns : int64     time of the latest step; when the pose was true
    pose : (7,) float64       x y z [m], unit quaternion qx qy qz qw

    Returns
    -------
    int64
        REFUSED: it is not newer than the last; TAKEN; CLOCK_SET: taken, and it begins the history anew,
        because the clock was set back, or the newest report had a wrong timestamp
    """
    sense, to_inputs, begun = state[0].sense, -state[0].scaled.shift, False
    if sense.pose_count > 0 and t_ns <= sense.pose_t_ns[newest_pose(sense)]:
        newest = sense.pose_t_ns[newest_pose(sense)]
        jump_ns = scale_duration(LONG_GAP_NS, to_inputs)
        # a step in between that is as new says that this route of poses is late
        begun = is_set_back(sense, t_ns, scale_duration(MAX_GAP_NS, to_inputs)) and step_ns < newest
        begun = begun or (t_ns <= newest - jump_ns and newest > max(t_ns, step_ns) + jump_ns)
        if begun:
            sense.pose_count = 0
    if push_pose(sense, t_ns, pose, 0) == 0:
        return REFUSED
    sense.back_count = 0
    return CLOCK_SET if begun else TAKEN


@jit_inlined
def pose_at(sense, t_ns, out):
    """The tool's pose at `t_ns` into `out`, interpolated between its neighbours.

    Outside the history the nearest end is taken: nothing is extrapolated. Needs one pose at least.

    Parameters
    ----------
    sense : record of `SenseState`
    t_ns : int64        time of the pose
    out : (7,) float64  receives x y z [m], qx qy qz qw
    """
    k = newest_until(sense.pose_t_ns, sense.pose_count, t_ns)
    a = k & (POSES - 1)
    if a == newest_pose(sense) or sense.pose_t_ns[a] > t_ns:
        for i in range(7):
            out[i] = sense.pose[a * 7 + i]
        return
    b = (k + 1) & (POSES - 1)
    w = (t_ns - sense.pose_t_ns[a]) / (sense.pose_t_ns[b] - sense.pose_t_ns[a])
    dot = 0.0
    for i in range(3):
        out[i] = sense.pose[a * 7 + i] * (1.0 - w) + sense.pose[b * 7 + i] * w
    for i in range(3, 7):
        dot += sense.pose[a * 7 + i] * sense.pose[b * 7 + i]
    sign = 1.0 if dot >= 0.0 else -1.0
    norm2 = 0.0
    for i in range(3, 7):
        out[i] = sense.pose[a * 7 + i] * (1.0 - w) + sign * sense.pose[b * 7 + i] * w
        norm2 += out[i] * out[i]
    scale = 1.0 / math.sqrt(norm2)
    for i in range(3, 7):
        out[i] *= scale


@jit_inlined
def footprint(tool, mounts, channel, range_m):
    """World coordinates where the beam of a channel ends, and the sensor's height.

    Parameters
    ----------
    tool : (7,) float64            world from tool
    mounts : (56,) float64         tool from sensor, 7 per channel
    channel : int
    range_m : float64              distance along the sensor's -z

    Returns
    -------
    x_m, y_m, z_m, sensor_z_m : float64
    """
    m = channel * 7
    bx, by, bz = to_world(mounts, m, 0.0, 0.0, -range_m)
    sx, sy, sz = to_world(tool, 0, mounts[m], mounts[m + 1], mounts[m + 2])
    wx, wy, wz = to_world(tool, 0, bx, by, bz)
    sensor_z = tool[2] + sz
    return tool[0] + sx + wx, tool[1] + sy + wy, sensor_z + wz, sensor_z
