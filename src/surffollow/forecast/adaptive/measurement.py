"""Measurement update: the newest sample from range to estimate.

range → pose at the range's timestamp → footprint → latency, health, plane fit → innovation gate, bank
"""

from __future__ import annotations

from typing import Any

from surffollow.forecast.adaptive.adaptation import update_deadband
from surffollow.forecast.adaptive.beam_detection import any_beam_changed, observe_beams
from surffollow.forecast.adaptive.estimate import update_estimate
from surffollow.forecast.adaptive.health import CLOSE_CONFIRMATION_SAMPLES, is_stuck, update_stuck
from surffollow.forecast.adaptive.kinematics import MIN_DIRECTION_SPEED_MPS, predict_pose
from surffollow.forecast.adaptive.latency_identification import observe_height
from surffollow.forecast.adaptive.lookahead_sensor import compare_lookahead
from surffollow.forecast.adaptive.plane_fit import plane_height
from surffollow.forecast.adaptive.preview import compare_map, map_height, monitor_error
from surffollow.forecast.adaptive.range_prediction import update_prediction
from surffollow.forecast.adaptive.sample_hold import new_sample
from surffollow.forecast.adaptive.terrain_buffer import MIN_LEAD_M
from surffollow.forecast.pose import footprint, rotate
from surffollow.forecast.safety import watch_fold_back
from surffollow.shm.jit import jit
from surffollow.shm.layout_follow import POSES, RUN_FREEZE, RUN_NORMAL

DELAY_RATE = 0.05
LEAD_RATE = 0.05
SPACING_RATE = 0.05


@jit
def axis_ground_point(params: Any, pose: Any) -> Any:
    """Find the point on the tool's axis that should touch the ground, from the tool, in the world's axes [m].

    The axis is that of the tool's frame which channel 0's beam lies nearest to.
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
def standoff_height(params: Any, a: Any, sense: Any, plane: Any, pose: Any) -> Any:
    """How much higher than the ground that it points at the tool should be [m].

    `pose` (7,) is scratch and holds the newest report afterwards.
    """
    newest = 7 * ((sense.pose_count - 1) & (POSES - 1))
    for i in range(7):
        pose[i] = sense.pose[newest + i]
    if plane == 0:
        _, _, tip_z = axis_ground_point(params, pose)
        return -tip_z
    tx, ty, tz = rotate(pose[3], pose[4], pose[5], pose[6], 0.0, 0.0, 1.0)
    along = tz - a.slope_x * tx - a.slope_y * ty  # (tool axis · normal) over the normal's z
    return (params.offset_m - params.tool_from_sensor[2]) * along


@jit
def process_sample(
    params: Any, a: Any, sense: Any, fold: Any, inputs: Any, output: Any, plane: Any, pose: Any
) -> None:
    """Take a new sample, if there is one; what does not enter the estimate is not mapped."""
    channel = 0
    if plane != 0:
        channel = observe_beams(params, a, sense, pose)
    else:
        output.fresh &= ~1
    if channel < 0:
        return
    news, range_m, t = new_sample(params, a, sense, inputs.n_ranges, channel)
    if news == 0:
        return
    update_prediction(a, t, range_m)
    repeated = 1 if a.held_ns != 0 and range_m == a.held_m else 0
    if plane != 0 and any_beam_changed(a, params.n_channels, a.held_ns) != 0:
        repeated = 0
    a.held_ns, a.held_m = t, range_m
    if plane == 0:  # beams are stamped one by one
        t -= int(a.older_s * 1e9)
    a.late_s += DELAY_RATE * ((a.now_ns - t) * 1e-9 - a.late_s)
    predict_pose(a, sense, t, pose)
    update_stuck(a, repeated, pose[2])
    if t <= a.sample_ns or is_stuck(a) != 0:
        return
    adapt = 0 if params.adapt == 0 or params.run == RUN_FREEZE else 1
    x, y, z, sensor_z = footprint(pose, params.tool_from_sensor, channel, range_m)
    still = 1 if a.speed_mps < MIN_DIRECTION_SPEED_MPS else 0
    if plane == 0 and (still != 0 or a.rest_n > 0):
        observe_height(a, sense, t, z, still, adapt, pose)
        predict_pose(a, sense, t, pose)
    a.close_run = a.close_run + 1 if range_m < params.too_close_m else 0
    if a.close_run >= CLOSE_CONFIRMATION_SAMPLES or fold.close != 0:
        watch_fold_back(fold, range_m, sensor_z, params.too_close_m, params.too_close_exit_m)
    tool_x, tool_y, tool_z = pose[0], pose[1], pose[2]
    if plane != 0:
        good, z = plane_height(params, a, t, tool_x, tool_y)
        if good == 0:
            return
        x, y = tool_x, tool_y
        for c in range(params.n_channels):
            if a.beam_good[c] == 0:
                output.fresh &= ~(1 << c)
    a.tip_x_m = a.tip_y_m = 0.0
    if plane == 0:
        a.tip_x_m, a.tip_y_m, _ = axis_ground_point(params, pose)
    if a.speed_mps >= MIN_DIRECTION_SPEED_MPS:
        lead_x, lead_y = x - tool_x - a.tip_x_m, y - tool_y - a.tip_y_m
        lead = (lead_x * a.speed_x_mps + lead_y * a.speed_y_mps) / a.speed_mps
        a.lead_m += (lead - a.lead_m) * (LEAD_RATE if a.samples > 0 else 1.0)
    way = a.speed_mps * (t - a.sample_ns) * 1e-9 if a.samples > 0 else 0.0
    drop = standoff_height(params, a, sense, plane, pose)
    a.sample_way_m += SPACING_RATE * (way - a.sample_way_m)
    a.foot_x_m, a.foot_y_m, a.foot_s_m = x, y, a.path_m + way
    compare_lookahead(a, a.foot_s_m, z)
    taken = update_estimate(params, a, t, way, z, drop, adapt)
    if taken == 0:
        return
    if adapt != 0 or a.permitted_m == 0.0:
        update_deadband(params, a)
    if abs(a.lead_m) < MIN_LEAD_M and params.run == RUN_NORMAL:
        monitor_error(a, tool_z - drop - z)
    if inputs.n_preview > 0 and a.speed_mps >= MIN_DIRECTION_SPEED_MPS:
        beside_x, beside_y = x - pose[0] - a.tip_x_m, y - pose[1] - a.tip_y_m
        beside = beside_x * a.speed_x_mps + beside_y * a.speed_y_mps
        compare_map(a, map_height(inputs, beside / a.speed_mps), z)
    if plane == 0:
        output.fresh |= 1
        output.target_m[0], output.target_m[1], output.target_m[2] = x, y, z
