"""One cycle of the default follower: the block diagram, stage by stage.

clock → kinematics → plant → measurement (sensing, estimation, terrain) → health → setpoint → demand
"""

import math

from surffollow.forecast.attitude.attitude import demand_rotation, publish_normal, release_attitude
from surffollow.forecast.estimation.adaptation import publish_adaptation
from surffollow.forecast.fold_back import PROBE_M, limit
from surffollow.forecast.plant.axis_model import PERIOD_S
from surffollow.forecast.plant.controller_clock import (
    latch_time,
    mean_wait_s,
    observe_report,
    open_period,
    period_is_due,
)
from surffollow.forecast.plant.plant_identification import (
    model_error,
    predict_axis,
    record_own_setpoint,
    update_plant,
)
from surffollow.forecast.sensing.clock import update_clock
from surffollow.forecast.sensing.health import forget, is_lost, latch_fault, update_health
from surffollow.forecast.sensing.kinematics import (
    MIN_DIRECTION_SPEED_MPS,
    distance_along,
    has_jumped,
    update_kinematics,
)
from surffollow.forecast.sensing.measurement import process_sample
from surffollow.forecast.sensing.response import is_unresponsive
from surffollow.forecast.sensing.standoff import standoff_height
from surffollow.forecast.setpoint.preview_control import plan_setpoint
from surffollow.forecast.setpoint.setpoint_blend import blend_setpoints, filter_setpoint, permitted_setpoint
from surffollow.forecast.setpoint.setpoint_limits import limit_setpoint, mark_dryrun, release_setpoint
from surffollow.forecast.setpoint.tested_setpoint import setpoint_shift_m
from surffollow.forecast.terrain.known_ground import lowest_plan, reset_known_ground
from surffollow.forecast.terrain.lookahead_sensor import observe_lookahead
from surffollow.forecast.terrain.preview import (
    MIN_KNOWN_PERIODS,
    collect_preview,
    extrapolate_ground,
    plan_call_s,
    update_share,
    withdraw_preview,
)
from surffollow.shm.jit import jit, jit_inlined
from surffollow.shm.layout_adaptive import (
    DROPOUT,
    FAULT_CLOCK,
    FAULT_CLOSE,
    FAULT_LOST,
    FAULT_NOT_FINITE,
    FAULT_STUCK,
    OUT_OF_RANGE,
    STUCK,
)
from surffollow.shm.layout_follow import (
    LIMITED,
    NO_SENSOR,
    POSES,
    RUN_DRYRUN,
    RUN_FREEZE,
    RUN_NORMAL,
    SENSOR_LOST,
    TOO_CLOSE,
    VALID,
)


@jit
def distance_ahead(params, adaptive, sense):
    """Distance from the newest footprint to the point under the tool when the demand acts [m].

    Parameters
    ----------
    params, adaptive, sense : records of `Params`, `AdaptiveState`, `SenseState`
    """
    kinematics, sample, newest = adaptive.kinematics, adaptive.sample, (sense.pose_count - 1) & (POSES - 1)
    if kinematics.speed_mps < MIN_DIRECTION_SPEED_MPS:
        return 0.0
    gap_x = sense.pose[7 * newest] + sample.tip_x_m - sample.x_m
    gap_y = sense.pose[7 * newest + 1] + sample.tip_y_m - sample.y_m
    age_ns = adaptive.clock.now_ns - sense.pose_t_ns[newest]
    delay_s = age_ns * 1e-9 + mean_wait_s(params, adaptive.controller)
    return distance_along(kinematics, gap_x, gap_y) + kinematics.speed_mps * delay_s


@jit_inlined
def target_of_blend(params, adaptive, inputs, pose_t_ns, ahead_m, standoff_m):
    """Blended setpoint [m], and whether a controller period begins.

    The models are blended when a sample, a pose or a controller period is new. In between the blend
    continues at the rate that the models predict.

    Parameters
    ----------
    params, adaptive, inputs : records of `Params`, `AdaptiveState` (updated), `Inputs`
    pose_t_ns : int64     timestamp of the newest pose
    ahead_m : float64     distance from `distance_ahead` [m]
    standoff_m : float64  desired height of the tool above the ground [m]

    Returns
    -------
    float64 [m], bool
    """
    clock, blend = adaptive.clock, adaptive.blend
    due = period_is_due(adaptive.controller, plan_call_s(adaptive), inputs.n_ranges, clock.now_ns)
    if due or adaptive.estimate.sample_ns != blend.sample_ns or pose_t_ns != blend.pose_ns:
        target = blend_setpoints(params, adaptive, pose_t_ns, ahead_m, standoff_m, due)
    else:
        target = blend.setpoint_m + blend.rate_mps * (clock.now_ns - blend.t_ns) * 1e-9
    return target, due


@jit
def plan_period(params, adaptive, inputs, pose_t_ns, ahead_m, standoff_m):
    """Preview control of the controller period that begins.

    Parameters
    ----------
    params, adaptive, inputs : records of `Params`, `AdaptiveState` (updated), `Inputs`
    pose_t_ns : int64     timestamp of the newest pose
    ahead_m : float64     distance from `distance_ahead` [m]
    standoff_m : float64  desired height of the tool above the ground [m]
    """
    clock, kinematics, controller = adaptive.clock, adaptive.kinematics, adaptive.controller
    open_period(controller, inputs.n_ranges, clock.now_ns)
    latch_ns = latch_time(controller, inputs.n_ranges, clock.now_ns)
    since_pose_m = kinematics.speed_mps * (latch_ns - pose_t_ns) * 1e-9
    wait_s = mean_wait_s(params, controller)
    ahead_m += kinematics.speed_mps * ((latch_ns - clock.now_ns) * 1e-9 - wait_s)
    known = collect_preview(adaptive, inputs, adaptive.estimate.arc_length_m + ahead_m, since_pose_m)
    update_share(adaptive, known, model_error(adaptive.plant))
    if known >= MIN_KNOWN_PERIODS:
        z, v = predict_axis(params, adaptive, latch_ns)
        extrapolate_ground(adaptive, known, ahead_m)
        plan_setpoint(params, adaptive, known, z, v, standoff_m + setpoint_shift_m(adaptive.response))


@jit_inlined
def target_of_preview(params, adaptive, target_m, standoff_m):
    """Setpoint before the limits: the filtered blend and its shift, and the plan by its share [m].

    A sensor that leads measures no ground under the tool: its buffered heights replace the blend.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (updated)
    target_m : float64    blended setpoint [m]
    standoff_m : float64  desired height of the tool above the ground [m]
    """
    preview = adaptive.preview
    if preview.sensed_periods >= 2:
        fastest = params.plant_v_max_mps  # an edge of the ground is no rate that an axis can follow
        rate = min(max((preview.ground_m[1] - preview.ground_m[0]) / PERIOD_S, -fastest), fastest)
        lead_s = adaptive.plant.tau_s + mean_wait_s(params, adaptive.controller)
        target_m = preview.ground_m[0] + rate * lead_s + standoff_m
    target_m = filter_setpoint(params, adaptive, target_m) + setpoint_shift_m(adaptive.response)
    planned = adaptive.plan.setpoint_m
    if preview.sensed_periods == 0:  # ground that the sensor under the tool has not confirmed
        planned = max(planned, lowest_plan(adaptive.known, target_m))
    target_m += preview.share * (planned - target_m)
    return target_m


@jit_inlined
def compute_demand(params, adaptive, sense, fold, inputs, output, pose):
    """Demand of the adaptive mode into `output`; returns status bits.

    Parameters
    ----------
    params, adaptive, sense, fold, inputs, output : records of `Params`, `AdaptiveState`, `SenseState`,
        `FoldBackState`, `Inputs`, `Output`, all dimensionless (`reference_scales`)
    pose : (7,) float64 scratch

    Notes
    -----
    Needs a pose. The demand adds to the newest pose reported, `output.pose_t_ns`.
    """
    clock, kinematics, health = adaptive.clock, adaptive.kinematics, adaptive.health
    estimate, controller, setpoint = adaptive.estimate, adaptive.controller, adaptive.setpoint
    newest = (sense.pose_count - 1) & (POSES - 1)
    pose_t_ns, tool_z = sense.pose_t_ns[newest], sense.pose[7 * newest + 2]
    orients = params.orient != 0 and params.n_channels >= 3
    if update_clock(clock, inputs.t_ns, pose_t_ns):
        return forget(health, FAULT_CLOCK)
    if update_kinematics(params, kinematics, sense):
        release_setpoint(setpoint)  # it is in the frame before the jump
    update_plant(params, adaptive, sense, params.adapt != 0 and params.run == RUN_NORMAL)
    process_sample(params, adaptive, sense, fold, inputs, output, orients, pose)
    if not orients and params.n_channels > 1:
        observe_lookahead(params, adaptive, sense, pose)
    stuck = is_unresponsive(adaptive.response)
    update_health(params, adaptive, sense)
    if has_jumped(kinematics, clock.now_ns):
        withdraw_preview(adaptive.preview)
        reset_known_ground(adaptive.known)
    if stuck:
        latch_fault(health, FAULT_STUCK)
        withdraw_preview(adaptive.preview)
    if is_lost(params, adaptive):
        if estimate.samples > 0 and not stuck:
            latch_fault(health, FAULT_LOST)
        release_setpoint(setpoint)
        withdraw_preview(adaptive.preview)
        return NO_SENSOR | SENSOR_LOST
    if setpoint.in_dryrun != 0 and params.run != RUN_DRYRUN:  # setpoints of DRYRUN were not applied
        mark_dryrun(setpoint, 0)
        release_setpoint(setpoint)
        release_attitude(adaptive.attitude)
    standoff = standoff_height(params, adaptive.plane, sense, orients)
    ahead = distance_ahead(params, adaptive, sense)
    observe_report(controller, sense.pose_count, clock.now_ns)
    target, due = target_of_blend(params, adaptive, inputs, pose_t_ns, ahead, standoff)
    if due:
        plan_period(params, adaptive, inputs, pose_t_ns, ahead, standoff)
    target = target_of_preview(params, adaptive, target, standoff)
    age = (clock.now_ns - pose_t_ns) * 1e-9 + mean_wait_s(params, controller)
    target = permitted_setpoint(params, adaptive, target, tool_z, standoff, age, stuck)
    limit_setpoint(params, adaptive, clock.now_ns, target, tool_z)
    demand = setpoint.position_m - tool_z
    if not math.isfinite(demand + estimate.height_m + estimate.slope + estimate.sigma_m):
        return forget(health, FAULT_NOT_FINITE)
    status = VALID
    if health.state in (DROPOUT, OUT_OF_RANGE, STUCK):
        status |= NO_SENSOR
    limited = limit(demand, params.max_demand_m)
    if limited != demand:
        status |= LIMITED
    if fold.close != 0:
        latch_fault(health, FAULT_CLOSE)
        status |= TOO_CLOSE
        limited = max(limited, min(PROBE_M, params.max_demand_m))
        release_attitude(adaptive.attitude)  # away from the surface first, then rotate
    output.demand[2] = limited
    if fold.close == 0 and not stuck and orients and adaptive.plane.count > 0:
        demand_rotation(params, adaptive, sense, output)
    record_own_setpoint(adaptive, tool_z + (limited if params.run == RUN_NORMAL else 0.0))
    if params.run == RUN_DRYRUN:
        mark_dryrun(setpoint, 1)
    elif params.run == RUN_FREEZE:
        release_setpoint(setpoint)  # no demand is applied
    output.delta_h_m = estimate.slope * max(ahead, 0.0)
    output.error_m = params.offset_m - adaptive.hold.range_m
    return status


@jit_inlined
def publish_estimate(params, adaptive, output):
    """Publish estimate, health and adapted parameters."""
    kinematics, health, estimate = adaptive.kinematics, adaptive.health, adaptive.estimate
    noise_m, scale_m = adaptive.noise.sigma_m, adaptive.gate.scale_m
    publish_adaptation(params, adaptive, output)
    output.height_m, output.speed_mps = estimate.height_m, kinematics.speed_mps
    # a slope along the path needs a direction of travel
    output.slope = estimate.slope if kinematics.speed_mps >= MIN_DIRECTION_SPEED_MPS else 0.0
    output.intervals = estimate.samples
    publish_normal(adaptive, output)
    output.health, output.reason, output.faults = health.state, health.reason, health.faults
    output.tau_s = adaptive.plant.tau_s
    output.sigma_m, output.noise_m, output.late_s = estimate.sigma_m, noise_m, adaptive.latency.delay_s
    output.roughness_m = math.sqrt(max(scale_m * scale_m - noise_m * noise_m, 0.0))
