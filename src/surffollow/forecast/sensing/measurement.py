"""Measurement update: the newest sample from range to estimate.

range → pose at the range's timestamp → footprint → latency, health, plane fit → innovation gate, bank
"""

import math

from surffollow.forecast.attitude.beam_detection import any_beam_changed, observe_beams
from surffollow.forecast.attitude.plane_fit import plane_height
from surffollow.forecast.attitude.rotation_response import mean_range, observe_rotation
from surffollow.forecast.estimation.adaptation import update_deadband
from surffollow.forecast.estimation.estimate import discard_estimate, reverse_estimate, update_estimate
from surffollow.forecast.estimation.innovation_gate import is_slow
from surffollow.forecast.fold_back import watch_fold_back
from surffollow.forecast.pose import footprint, rotate
from surffollow.forecast.sensing.clock import MAX_GAP_NS
from surffollow.forecast.sensing.health import (
    count_close,
    dropout_tolerance_s,
    is_stuck,
    is_stuck_permanently,
    repeats_range,
    update_stuck,
)
from surffollow.forecast.sensing.kinematics import MIN_DIRECTION_SPEED_MPS, distance_along, predict_pose
from surffollow.forecast.sensing.latency_identification import USUAL_VALUE_RATE, observe_height, update_delay
from surffollow.forecast.sensing.range_prediction import update_prediction
from surffollow.forecast.sensing.response import is_unresponsive, observe_response
from surffollow.forecast.sensing.sample_hold import new_sample, observe_timestamp, record_sample
from surffollow.forecast.terrain.lookahead_sensor import compare_lookahead
from surffollow.forecast.terrain.preview import compare_map, monitor_error, withdraw_preview
from surffollow.forecast.terrain.terrain_buffer import MIN_LEAD_M
from surffollow.shm.jit import jit
from surffollow.shm.layout_follow import POSES, RUN_FREEZE, RUN_NORMAL


@jit
def axis_ground_point(params, pose):
    """Point of the tool's axis that should touch the ground, from the tool, in world axes [m].

    The axis is that of the tool's frame which is nearest to channel 0's beam.
    """
    m = params.tool_from_sensor
    x, y, z = rotate(m[3], m[4], m[5], m[6], 0.0, 0.0, -params.offset_m)
    along_z = abs(z) >= abs(x) and abs(z) >= abs(y)
    along_x = not along_z and abs(x) >= abs(y)
    x = m[0] + x if along_x else 0.0
    y = 0.0 if along_x or along_z else m[1] + y
    z = m[2] + z if along_z else 0.0
    return rotate(pose[3], pose[4], pose[5], pose[6], x, y, z)


@jit
def standoff_height(params, plane, sense, orients, pose):
    """Desired height of the tool above the ground point on its axis [m].

    Parameters
    ----------
    params, plane, sense : records of `Params`, `Plane`, `SenseState`
    orients : bool       three or more sensors, and the tool is rotated to the surface normal
    pose : (7,) float64  scratch; holds the newest report afterwards
    """
    newest = 7 * ((sense.pose_count - 1) & (POSES - 1))
    for i in range(7):
        pose[i] = sense.pose[newest + i]
    if not orients:
        _, _, tip_z = axis_ground_point(params, pose)
        return -tip_z
    tx, ty, tz = rotate(pose[3], pose[4], pose[5], pose[6], 0.0, 0.0, 1.0)
    along = tz - plane.slope_x * tx - plane.slope_y * ty  # (tool axis · normal) over the normal's z
    return (params.offset_m - params.tool_from_sensor[2]) * along


@jit
def process_sample(params, adaptive, sense, fold, inputs, output, orients, pose):
    """Process a new sample, if there is one; a sample that does not enter the estimate is not mapped.

    Parameters
    ----------
    params, adaptive, sense, fold, inputs, output : dimensionless records (`reference_scales`)
    orients : bool           three or more sensors and the tool is rotated to the surface normal
    pose : (7,) float64      scratch: the pose at the sample's time
    """
    kinematics, hold, latency, sample, health = (
        adaptive.kinematics,
        adaptive.hold,
        adaptive.latency,
        adaptive.sample,
        adaptive.health,
    )
    estimate, beams = adaptive.estimate, adaptive.beams
    channel = 0
    if orients:
        if inputs.n_ranges > 0 and sense.fresh[beams.reference] != 0:
            observe_timestamp(adaptive, sense.range_t_ns[beams.reference])
        channel = observe_beams(params, adaptive, sense, pose)
    else:
        output.fresh &= ~1
    if channel < 0:
        return
    is_new, range_m, t = new_sample(params, adaptive, sense, inputs.n_ranges, channel, orients)
    if not is_new:
        return
    update_prediction(adaptive.prediction, t, range_m)
    repeated = repeats_range(health, range_m)
    if orients and any_beam_changed(beams, params.n_channels, hold.t_ns):
        repeated = False
    record_sample(hold, t, range_m)
    if not orients:  # beams have timestamps of their own, without correction
        t -= int(latency.correction_s * 1e9)
    update_delay(latency, (adaptive.clock.now_ns - t) * 1e-9)
    predict_pose(kinematics, sense, t, pose)
    was_stuck = is_stuck_permanently(adaptive) or is_unresponsive(adaptive.response)
    update_stuck(adaptive, repeated, range_m, pose[2])
    gap_s = dropout_tolerance_s(adaptive.prediction) + MAX_GAP_NS * 1e-9
    mean_m = mean_range(beams, params.n_channels, t, range_m) if orients else range_m
    observe_response(params, adaptive, t, mean_m, pose[2], gap_s)
    now_stuck = is_stuck(health) or is_unresponsive(adaptive.response)
    if was_stuck and not now_stuck:
        discard_estimate(estimate)
    if t <= estimate.sample_ns or now_stuck:
        return
    adapt = params.adapt != 0 and params.run != RUN_FREEZE
    x, y, z, sensor_z = footprint(pose, params.tool_from_sensor, channel, range_m)
    at_rest = kinematics.speed_mps < MIN_DIRECTION_SPEED_MPS
    if not orients and (at_rest or latency.count > 0):
        observe_height(adaptive, sense, t, z, at_rest, adapt, pose)
        predict_pose(kinematics, sense, t, pose)
    close = count_close(health, range_m < params.too_close_m)
    if close or fold.close != 0:
        watch_fold_back(fold, range_m, sensor_z, params.too_close_m, params.too_close_exit_m)
    tool_x, tool_y, tool_z = pose[0], pose[1], pose[2]
    if orients:
        accepted, z = plane_height(params, adaptive, t, tool_x, tool_y)
        if accepted == 0:
            return
        observe_rotation(params, adaptive, t, pose)
        x, y = tool_x, tool_y
        for c in range(params.n_channels):
            if beams.accepted[c] == 0:
                output.fresh &= ~(1 << c)
    sample.tip_x_m = sample.tip_y_m = 0.0
    if not orients:
        sample.tip_x_m, sample.tip_y_m, _ = axis_ground_point(params, pose)
    if kinematics.speed_mps >= MIN_DIRECTION_SPEED_MPS:
        lead = distance_along(kinematics, x - tool_x - sample.tip_x_m, y - tool_y - sample.tip_y_m)
        sample.lead_m += (lead - sample.lead_m) * (USUAL_VALUE_RATE if estimate.samples > 0 else 1.0)
    travel = kinematics.speed_mps * (t - estimate.sample_ns) * 1e-9 if estimate.samples > 0 else 0.0
    if estimate.samples > 0 and is_slow(adaptive):  # the tool may have turned since the sample before
        travel = math.hypot(x - sample.x_m, y - sample.y_m)
    follow_heading(adaptive, x, y)
    standoff = standoff_height(params, adaptive.plane, sense, orients, pose)
    sample.spacing_m += USUAL_VALUE_RATE * (travel - sample.spacing_m)
    sample.x_m, sample.y_m, sample.arc_length_m = x, y, estimate.arc_length_m + travel
    if compare_lookahead(adaptive, sample.arc_length_m, z):
        withdraw_preview(adaptive.preview)
    if not update_estimate(params, adaptive, t, travel, z, standoff, adapt):
        return
    if adapt or adaptive.adaptation.permitted_variance_m == 0.0:
        update_deadband(params, adaptive)
    if abs(sample.lead_m) < MIN_LEAD_M and params.run == RUN_NORMAL:
        monitor_error(adaptive, tool_z - standoff - z)
    if inputs.n_preview > 0 and kinematics.speed_mps >= MIN_DIRECTION_SPEED_MPS:
        ahead = distance_along(kinematics, x - pose[0] - sample.tip_x_m, y - pose[1] - sample.tip_y_m)
        compare_map(adaptive, inputs, ahead, z)
    if not orients:
        output.fresh |= 1
        output.target_m[0], output.target_m[1], output.target_m[2] = x, y, z


@jit
def has_turned_back(adaptive):
    """Whether the tool goes back, against the heading of the newest sample."""
    kinematics, sample = adaptive.kinematics, adaptive.sample
    along = kinematics.velocity_x_mps * sample.heading_x + kinematics.velocity_y_mps * sample.heading_y
    return along < -MIN_DIRECTION_SPEED_MPS


@jit
def follow_heading(adaptive, x_m, y_m):
    """Take the heading of the tool as that of the sample; reverse the bank where the footprints go back.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (updated)
    x_m, y_m : float64  the footprint; `sample` has the one before
    """
    kinematics, sample = adaptive.kinematics, adaptive.sample
    if kinematics.speed_mps < MIN_DIRECTION_SPEED_MPS:
        return
    if has_turned_back(adaptive):
        if (x_m - sample.x_m) * sample.heading_x + (y_m - sample.y_m) * sample.heading_y >= 0.0:
            return  # the footprint is still ahead of the one before
        reverse_estimate(adaptive)
        sample.lead_m = -sample.lead_m
    sample.heading_x = kinematics.velocity_x_mps / kinematics.speed_mps
    sample.heading_y = kinematics.velocity_y_mps / kinematics.speed_mps
