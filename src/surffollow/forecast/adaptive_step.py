"""One cycle of the default follower: the block diagram, stage by stage.

clock → kinematics → plant → measurement (sensing, estimation, terrain) → health → setpoint → demand
"""

import math

from surffollow.forecast import fold_back
from surffollow.forecast.attitude import attitude
from surffollow.forecast.estimation.noise import assumed_noise_m
from surffollow.forecast.modes import orients
from surffollow.forecast.plant import (
    axis_model,
    controller_clock,
    observed_axis,
    own_setpoints,
    plant_identification,
    shadow_axes,
)
from surffollow.forecast.pose import newest_pose
from surffollow.forecast.sensing import clock, health, kinematics, measurement, standoff
from surffollow.forecast.setpoint import preview_control, setpoint_blend, setpoint_limits, tested_setpoint
from surffollow.forecast.terrain import known_ground, lookahead_sensor, preview, terrain_buffer
from surffollow.shm import layout_adaptive
from surffollow.shm import layout_follow as layout
from surffollow.shm.jit import jit, jit_inlined


@jit
def distance_ahead(adaptive, sense, age_s):
    """Distance from the newest footprint to the point under the tool when the demand acts [m].

    Parameters
    ----------
    adaptive, sense : records of `AdaptiveState`, `SenseState`
    age_s : float64  of the newest pose at that time [s]
    """
    motion = adaptive.kinematics
    if kinematics.is_at_rest(motion):
        return -adaptive.sample.lead_m if terrain_buffer.sensor_leads(adaptive) else 0.0
    lead_m = measurement.footprint_lead(adaptive, sense.pose, 7 * newest_pose(sense))
    return motion.speed_mps * age_s - lead_m


@jit
def plan_period(params, adaptive, inputs, pose_t_ns, ahead_m, standoff_m):
    """Begin a controller period: record the setpoints of the models, plan with the ground ahead.

    Parameters
    ----------
    params, adaptive, inputs : records of `Params`, `AdaptiveState` (updated), `Inputs`
    pose_t_ns : int64     timestamp of the newest pose
    ahead_m : float64     distance from `distance_ahead` [m]
    standoff_m : float64  desired height of the tool above the ground [m]
    """
    shadow_axes.record_setpoints(adaptive)
    motion, latch_ns = adaptive.kinematics, controller_clock.begin_period(adaptive, inputs)
    since_pose_m = motion.speed_mps * (latch_ns - pose_t_ns) * 1e-9
    wait_s = controller_clock.mean_wait_s(params, adaptive.controller)
    ahead_m += motion.speed_mps * ((latch_ns - adaptive.clock.now_ns) * 1e-9 - wait_s)
    under_tool_m = adaptive.estimate.arc_length_m + ahead_m
    known_periods = preview.collect_preview(adaptive, inputs, under_tool_m, since_pose_m)
    if preview.update_share(adaptive, known_periods):
        z, v = observed_axis.predict_axis(params, adaptive, latch_ns)
        preview.extrapolate_ground(adaptive, known_periods, ahead_m)
        standoff_m += tested_setpoint.setpoint_shift_m(adaptive.response)
        preview_control.plan_setpoint(params, adaptive, known_periods, z, v, standoff_m)


@jit_inlined
def target_before_limits(params, adaptive, target_m, standoff_m):
    """Setpoint before the limits: the filtered blend and its shift, and the plan by its share [m].

    A sensor that leads measures no ground under the tool: its buffered heights replace the blend.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (updated)
    target_m : float64    blended setpoint [m]
    standoff_m : float64  desired height of the tool above the ground [m]
    """
    ground_m, sensed_periods = adaptive.preview.ground_m, adaptive.preview.sensed_periods
    if sensed_periods >= 2:
        fastest = params.plant_v_max_mps  # an edge of the ground is no rate that an axis can follow
        rate = min(max((ground_m[1] - ground_m[0]) / axis_model.PERIOD_S, -fastest), fastest)
        late_s = adaptive.plant.tau_s + controller_clock.mean_wait_s(params, adaptive.controller)
        target_m = ground_m[0] + rate * late_s + standoff_m
    # an axis that is pushed at the velocity d stays τ d beside its setpoint
    target_m -= adaptive.plant.tau_s * adaptive.plant.disturbance_mps
    target_m = setpoint_blend.filter_setpoint(params, adaptive, target_m)
    target_m += tested_setpoint.setpoint_shift_m(adaptive.response)
    planned = adaptive.plan.setpoint_m
    if sensed_periods == 0:  # ground that the sensor under the tool has not confirmed
        planned = max(planned, known_ground.lowest_plan(adaptive, target_m))
    return target_m + adaptive.preview.share * (planned - target_m)


@jit_inlined
def compute_demand(params, adaptive, sense, fold, inputs, output, pose, applies):
    """Demand of the adaptive mode into `output`; returns status bits.

    Parameters
    ----------
    params, adaptive, sense, fold, inputs, output : records of `Params`, `AdaptiveState`, `SenseState`,
        `FoldBackState`, `Inputs`, `Output`, all dimensionless (`reference_scales`)
    pose : (7,) float64 scratch
    applies : bool  demands can be applied: neither FREEZE nor a latched stop

    Notes
    -----
    Needs a pose. The demand adds to the newest pose reported, `output.pose_t_ns`.
    """
    estimate, controller, setpoint = adaptive.estimate, adaptive.controller, adaptive.setpoint
    newest = newest_pose(sense)
    pose_t_ns, tool_z = sense.pose_t_ns[newest], sense.pose[7 * newest + 2]
    sample_ns, before_ns = estimate.sample_ns, adaptive.plant.t_ns  # of the cycle before
    if clock.update_clock(adaptive.clock, inputs.t_ns, pose_t_ns, before_ns):
        return health.restart(adaptive.health, layout_adaptive.FAULT_CLOCK)
    controller_clock.observe_ask(adaptive, inputs)
    reported = pose_t_ns != before_ns
    if reported:
        if kinematics.update_kinematics(params, adaptive.kinematics, sense):
            setpoint_limits.release_setpoint(setpoint)  # it is in the frame before the jump
        plant_identification.update_plant(params, adaptive, sense, inputs)
    measurement.process_sample(params, adaptive, sense, fold, inputs, output, pose)
    lookahead_sensor.observe_lookahead(params, adaptive, sense, pose)
    close = layout.TOO_CLOSE if fold.close != 0 else 0
    stuck, lost = health.update_health(params, adaptive, sense, close != 0)
    jumped = kinematics.has_jumped(adaptive)
    if jumped:
        known_ground.reset_known_ground(adaptive.known)
    if jumped or stuck or lost:
        preview.withdraw_preview(adaptive.preview)
    if lost:
        setpoint_limits.release_setpoint(setpoint)
        return layout.NO_SENSOR | layout.SENSOR_LOST | close
    if setpoint.in_dryrun != 0 and params.run != layout.RUN_DRYRUN:  # setpoints of DRYRUN were not applied
        setpoint_limits.release_setpoint(setpoint)
        attitude.release_attitude(adaptive.attitude)
    standoff_m = standoff.standoff_height(params, adaptive.plane, sense)
    answered = controller_clock.observe_latch(adaptive, inputs, reported)
    age_s = (adaptive.clock.now_ns - pose_t_ns) * 1e-9 + controller_clock.mean_wait_s(params, controller)
    ahead = distance_ahead(adaptive, sense, age_s)
    due = controller_clock.period_is_due(adaptive, inputs, adaptive.clock.now_ns)
    renew = due or reported or estimate.sample_ns != sample_ns
    target = setpoint_blend.blend_setpoints(params, adaptive, ahead, standoff_m, renew)
    if due:
        plan_period(params, adaptive, inputs, pose_t_ns, ahead, standoff_m)
    target = target_before_limits(params, adaptive, target, standoff_m)
    target = setpoint_blend.permitted_setpoint(params, adaptive, target, tool_z, standoff_m, age_s, stuck)
    setpoint_limits.limit_setpoint(params, adaptive, adaptive.clock.now_ns, target, tool_z)
    demand = setpoint.position_m - tool_z
    if not math.isfinite(demand + estimate.height_m + estimate.slope + estimate.sigma_m):
        return health.restart(adaptive.health, layout_adaptive.FAULT_NOT_FINITE)
    status, state = layout.VALID | close, adaptive.health.state
    if state in (layout_adaptive.DROPOUT, layout_adaptive.OUT_OF_RANGE, layout_adaptive.STUCK):
        status |= layout.NO_SENSOR
    limited = fold_back.limit(demand, params.max_demand_m)
    if limited != demand:
        status |= layout.LIMITED
    if close != 0:
        limited = fold_back.demand_away(params, limited)
    output.demand[2] = limited
    if close != 0 or stuck or not applies:  # away from the surface first, then rotate
        attitude.release_attitude(adaptive.attitude)
    elif orients(params) and adaptive.plane.count > 0:
        attitude.demand_rotation(params, adaptive, sense, output)
    applied_m = limited if applies and params.run == layout.RUN_NORMAL else 0.0
    own_setpoints.record_own_setpoint(adaptive.own, answered, adaptive.clock.now_ns, tool_z + applied_m)
    if not applies:  # the next setpoints begin at the tool
        setpoint_limits.release_setpoint(setpoint)
    output.delta_h_m = estimate.slope * max(ahead, 0.0)
    output.error_m = params.offset_m - adaptive.hold.range_m
    return status


@jit_inlined
def publish_estimate(params, adaptive, output):
    """Publish estimate, health and the adapted parameters.

    Nothing follows by Interval_Size and Range_Size: paper mode would be as smooth with them as the estimate
    is. A mean over n samples has the variance of a filter with gain 2 / (n + 1).
    """
    motion, found, estimate = adaptive.kinematics, adaptive.health, adaptive.estimate
    noise_m, scale_m = adaptive.noise.sigma_m, adaptive.gate.scale_m
    output.latency_s = params.sensor_latency_ns * 1e-9 + adaptive.latency.correction_s
    output.permitted_variance_m = setpoint_blend.permitted_variance_m(params, adaptive)
    output.interval_size_m, output.range_size = params.interval_size_m, params.range_size
    if estimate.samples > 0:
        spacing_m = motion.speed_mps * adaptive.hold.interval_s
        gain = (estimate.sigma_m / assumed_noise_m(adaptive.noise)) ** 2  # just after an update
        travel_m = (2.0 / min(max(gain, 1e-4), 1.0) - 1.0) * spacing_m  # of the mean, bounded
        interval_m = max(min(params.interval_size_m, travel_m), spacing_m, 1e-6)
        output.interval_size_m = interval_m
        output.range_size = min(max(int(travel_m / interval_m + 0.5), 1), layout.INTERVALS // 2)
    output.height_m, output.speed_mps = estimate.height_m, motion.speed_mps
    # a slope along the path needs a direction of travel
    output.slope = 0.0 if kinematics.is_at_rest(motion) else estimate.slope
    output.intervals = estimate.samples
    attitude.publish_normal(adaptive, output)
    output.health, output.reason, output.faults = found.state, found.reason, found.faults
    output.tau_s = adaptive.plant.tau_s
    output.sigma_m, output.noise_m, output.late_s = estimate.sigma_m, noise_m, adaptive.latency.delay_s
    output.roughness_m = math.sqrt(max(scale_m * scale_m - noise_m * noise_m, 0.0))
