"""Whether the coming cycle uses a preview, and of which piece of the path.

`follow_step` uses a preview when a controller period is due (preview control) and when a sample arrives
(comparison with known ground). In all other cycles nothing is read and nothing is logged.
"""

from surffollow.forecast.modes import orients
from surffollow.forecast.plant import axis_model, controller_clock
from surffollow.forecast.pose import newest_pose
from surffollow.forecast.reference_scales import dimensionless_time, is_unscaled
from surffollow.forecast.sensing import kinematics, sample_hold
from surffollow.forecast.terrain import known_ground, terrain_buffer
from surffollow.shm.conversion import FLAG_INVALID, conversion_channel, conversion_counts, conversion_flags
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import HORIZON
from surffollow.shm.layout_follow import MODE_ADAPTIVE


@jit
def has_reading(params, adaptive, inputs):
    """Whether the coming cycle has a range, or a valid conversion of channel 0 with a new value."""
    if inputs.n_ranges > 0:
        return True
    for k in range(inputs.n_conversions - 1, -1, -1):
        word = inputs.conversion[k]
        if conversion_channel(word) == 0:
            change_m = params.zero_m[0] + params.scale_m[0] * conversion_counts(word) - adaptive.hold.range_m
            held = abs(change_m) <= sample_hold.HOLD_TOLERANCE_COUNTS * abs(params.scale_m[0])
            return not held and conversion_flags(word) & FLAG_INVALID == 0
    return False


@jit
def preview_uses(params, adaptive, inputs, now_ns):
    """Whether the coming cycle uses a preview for a sample, and for a controller period.

    Parameters
    ----------
    params, adaptive : records of `Params` (dimensionless), `AdaptiveState`
    inputs : record of `Inputs` before `follow_step`
    now_ns : int64           latest time that the cycle will be told [ns]

    Notes
    -----
    Three sensors or more with `orient` give the height of a plane, not of the ground under the tool. A
    sensor that leads measures newer ground than the map. Neither uses a preview of the map.
    """
    if params.mode != MODE_ADAPTIVE or params.preview == 0 or adaptive.estimate.samples == 0:
        return False, False
    leads = known_ground.known_source(adaptive) == 0
    if orients(params) or leads or kinematics.is_at_rest(adaptive.kinematics):
        return False, False
    return has_reading(params, adaptive, inputs), controller_clock.period_is_due(adaptive, inputs, now_ns)


@jit
def preview_window(params, state, inputs):
    """Whether the coming cycle uses a preview, and the piece of the path that it must cover.

    Parameters
    ----------
    params, state, inputs : (1,) records of `Params`, `FollowState`, `Inputs`, before `follow_step`

    Returns
    -------
    due, x_m, y_m, direction_x, direction_y, first_m, last_m
        whether it uses one (else the rest is undefined); point under the tool at the newest pose of the
        coming cycle; unit vector of travel; piece of the path ahead of that point [m]
    """
    d, adaptive, sense, i = state[0].scaled, state[0].adaptive, state[0].sense, inputs[0]
    motion, sample = adaptive.kinematics, adaptive.sample
    k = newest_pose(sense)
    pose_t_ns, x, y = sense.pose_t_ns[k], sense.pose[7 * k], sense.pose[7 * k + 1]
    if i.n_poses > 0:
        k = i.n_poses - 1
        pose_t_ns, x, y = i.pose_t_ns[k], i.pose[7 * k], i.pose[7 * k + 1]
    p = params[0] if is_unscaled(d) else d.params
    t_ns, pose_t_ns = dimensionless_time(d, i.t_ns), dimensionless_time(d, pose_t_ns)
    now_ns = max(adaptive.clock.now_ns, t_ns, pose_t_ns)
    for_sample, for_period = preview_uses(p, adaptive, i, now_ns)
    if not (for_sample or for_period) or t_ns - pose_t_ns > p.pose_timeout_ns:
        return False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    v = motion.speed_mps
    # an earlier pass has a sample on either side, as far away as two of this one are from each other
    margin = v * axis_model.PERIOD_S + known_ground.REGISTRATION_M + terrain_buffer.usual_travel_m(adaptive)
    here = v * (now_ns - pose_t_ns) * 1e-9
    at = here - v * adaptive.latency.delay_s + sample.lead_m  # the sample
    first, last = here, here + v * axis_model.PERIOD_S * HORIZON
    if not for_period:
        first = last = at
    elif for_sample:
        first = min(first, at)
    x, y = x + sample.tip_x_m * d.length, y + sample.tip_y_m * d.length
    ux, uy = motion.velocity_x_mps / v, motion.velocity_y_mps / v
    return True, x, y, ux, uy, (first - margin) * d.length, (last + margin) * d.length
