"""Whether the coming cycle uses a preview, and of which piece of the path.

`follow_step` uses a preview when a controller period is due (preview control) and when a sample arrives
(comparison of map and sensor). In all other cycles nothing is read and nothing is logged.
"""

from surffollow.forecast.plant.axis_model import PERIOD_S
from surffollow.forecast.plant.controller_clock import period_is_due
from surffollow.forecast.reference_scales import dimensionless_time, is_unscaled
from surffollow.forecast.sensing.kinematics import MIN_DIRECTION_SPEED_MPS
from surffollow.forecast.sensing.sample_hold import HOLD_TOLERANCE_COUNTS
from surffollow.forecast.terrain.terrain_buffer import MIN_LEAD_M
from surffollow.shm.conversion import (
    FLAG_INVALID,
    conversion_channel,
    conversion_counts,
    conversion_dt_ns,
    conversion_flags,
)
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import HORIZON
from surffollow.shm.layout_follow import MODE_ADAPTIVE, POSES

FOR_SAMPLE, FOR_PERIOD = 1, 2  # bits: uses of a preview
MAX_SPEED_MPS = 10.0  # faster poses are jumps
TIMESTAMP_TOLERANCE_S = 0.008  # deviation of a sample's delay from the usual one
WINDOW_MARGIN_M = 1.5e-3  # for interpolation, and for noise of the reports


@jit
def newest_conversion(inputs):
    """Index of the cycle's last conversion of channel 0; -1: none, or it is invalid."""
    for j in range(inputs.n_conversions):
        k = inputs.n_conversions - 1 - j
        word = inputs.conversion[k]
        if conversion_channel(word) == 0:
            return -1 if (conversion_flags(word) & FLAG_INVALID) != 0 else k
    return -1


@jit
def preview_uses(params, adaptive, scaled, inputs, now_ns):
    """Uses of a preview in the coming cycle: FOR_SAMPLE, FOR_PERIOD, both or 0.

    Parameters
    ----------
    params, adaptive, scaled : records of `Params` (dimensionless), `AdaptiveState`, `ScaledState`
    inputs : record of `Inputs` before `follow_step`
    now_ns : int64           latest time that the cycle will be told [ns]

    Notes
    -----
    Three sensors or more with `orient` give the height of a plane, not of the ground under the tool. A
    sensor that leads measures newer ground than the map. Neither uses a preview of the map.
    """
    hold = adaptive.hold
    if params.mode != MODE_ADAPTIVE or params.preview == 0 or adaptive.estimate.samples == 0:
        return 0
    if params.orient != 0 and params.n_channels >= 3:
        return 0
    if (
        not MIN_DIRECTION_SPEED_MPS <= adaptive.kinematics.speed_mps < MAX_SPEED_MPS
        or adaptive.sample.lead_m > MIN_LEAD_M
    ):
        return 0
    due = FOR_PERIOD if period_is_due(adaptive.controller, inputs.n_ranges, now_ns) else 0
    k = newest_conversion(inputs)
    if k >= 0:
        range_m = params.zero_m[0] + params.scale_m[0] * conversion_counts(inputs.conversion[k])
        t_ns = dimensionless_time(scaled, inputs.t_ns + conversion_dt_ns(inputs.conversion[k]))
        t_ns -= params.sensor_latency_ns
        changed = abs(range_m - hold.range_m) > HOLD_TOLERANCE_COUNTS * abs(params.scale_m[0])
        if hold.t_ns == 0 or changed or t_ns - hold.t_ns >= params.hold_ns:
            due |= FOR_SAMPLE
    return due


@jit
def preview_window(params, state, inputs):
    """Uses of a preview in the coming cycle, and the piece of the path that it must cover.

    Parameters
    ----------
    params, state, inputs : (1,) records of `Params`, `FollowState`, `Inputs`, before `follow_step`

    Returns
    -------
    due, x_m, y_m, direction_x, direction_y, first_m, last_m
        FOR_ bits (with 0 the rest is undefined); point under the tool at the newest pose of the coming cycle;
        unit vector of travel; piece of the path ahead of that point [m]
    """
    d, adaptive, sense, i = state[0].scaled, state[0].adaptive, state[0].sense, inputs[0]
    kinematics, sample = adaptive.kinematics, adaptive.sample
    if i.n_poses > 0:
        pose_t_ns, x, y = i.pose_t_ns[i.n_poses - 1], i.pose[7 * i.n_poses - 7], i.pose[7 * i.n_poses - 6]
    elif sense.pose_count > 0:
        newest = (sense.pose_count - 1) & (POSES - 1)
        pose_t_ns, x, y = sense.pose_t_ns[newest], sense.pose[7 * newest], sense.pose[7 * newest + 1]
    else:
        return 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    p = params[0] if is_unscaled(d) else d.params
    t_ns, pose_t_ns = dimensionless_time(d, i.t_ns), dimensionless_time(d, pose_t_ns)
    now_ns = max(adaptive.clock.now_ns, t_ns, pose_t_ns)
    due = preview_uses(p, adaptive, d, i, now_ns)
    if due == 0 or t_ns - pose_t_ns > p.pose_timeout_ns:
        return 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    v = kinematics.speed_mps
    first, last = 1e9, -1e9
    if due & FOR_PERIOD != 0:
        first = v * (now_ns - pose_t_ns) * 1e-9 - WINDOW_MARGIN_M
        last = first + v * PERIOD_S * (HORIZON + 1) + 2.0 * WINDOW_MARGIN_M
    if due & FOR_SAMPLE != 0:
        at = v * ((now_ns - pose_t_ns) * 1e-9 - adaptive.latency.delay_s) + sample.lead_m
        reach = v * TIMESTAMP_TOLERANCE_S + WINDOW_MARGIN_M
        first, last = min(first, at - reach), max(last, at + reach)
    x += sample.tip_x_m * d.length
    y += sample.tip_y_m * d.length
    return (
        due,
        x,
        y,
        kinematics.velocity_x_mps / v,
        kinematics.velocity_y_mps / v,
        first * d.length,
        last * d.length,
    )
