"""One cycle of the default follower: the block diagram, stage by stage.

clock → kinematics → plant → measurement (sensing, estimation, terrain) → health → set point → demand
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.adaptive.adaptation import publish_adaptation
from surffollow.forecast.adaptive.attitude import demand_rotation, publish_normal
from surffollow.forecast.adaptive.axis_model import PERIOD_S, invert_axis
from surffollow.forecast.adaptive.clock import update_clock
from surffollow.forecast.adaptive.controller_clock import (
    latch_time,
    observe_report,
    open_period,
    period_is_due,
)
from surffollow.forecast.adaptive.estimate import INITIALISATION_SAMPLES
from surffollow.forecast.adaptive.health import is_lost, is_stuck, is_stuck_permanently, update_health
from surffollow.forecast.adaptive.kinematics import MIN_DIRECTION_SPEED_MPS, update_kinematics
from surffollow.forecast.adaptive.latency_identification import reset_window
from surffollow.forecast.adaptive.lookahead_sensor import observe_lookahead
from surffollow.forecast.adaptive.measurement import process_sample, standoff_height
from surffollow.forecast.adaptive.model_bank import N_CANDIDATES
from surffollow.forecast.adaptive.plant_identification import model_error, predict_axis, update_plant
from surffollow.forecast.adaptive.preview import (
    MIN_KNOWN_PERIODS,
    collect_preview,
    extrapolate_ground,
    update_share,
)
from surffollow.forecast.adaptive.preview_control import solve_plan
from surffollow.forecast.adaptive.setpoint_blend import blend_setpoints, dropout_s, filter_setpoint
from surffollow.forecast.adaptive.setpoint_limits import limit_setpoint
from surffollow.forecast.adaptive.terrain_buffer import MIN_LEAD_M
from surffollow.forecast.adaptive.terrain_regression import reset_regression
from surffollow.forecast.safety import PROBE_M, limit
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import (
    BEAMS,
    DROPOUT,
    FAULT_CLOCK,
    FAULT_CLOSE,
    FAULT_LOST,
    FAULT_NOT_FINITE,
    FAULT_STUCK,
    HORIZON,
    N_PERIODS,
    N_PLANTS,
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

CONFIRMED_SAMPLES = 25  # fewer, and then none: not enough to go down for


@jit
def distance_ahead(params: Any, a: Any, pose: Any, pose_t_ns: Any) -> Any:
    """How far ahead of the last footprint what the tool points at will be when the controller acts [m]."""
    if a.speed_mps < MIN_DIRECTION_SPEED_MPS:
        return 0.0
    gap_x, gap_y = pose[0] + a.tip_x_m - a.foot_x_m, pose[1] + a.tip_y_m - a.foot_y_m
    gap = gap_x * a.speed_x_mps + gap_y * a.speed_y_mps
    soon = (a.now_ns - pose_t_ns) * 1e-9 + params.tick_lead_s
    return gap / a.speed_mps + a.speed_mps * soon


@jit
def compute_demand(params: Any, a: Any, sense: Any, fold: Any, inputs: Any, output: Any, pose: Any) -> Any:
    """Demand of the adaptive mode into `output`; returns status bits.

    Parameters
    ----------
    params, a, sense, fold, inputs, output : records of `Params`, `AdaptiveState`, `SenseState`,
        `FoldBackState`, `Inputs`, `Output`, all in plain numbers (`adaptive_scales`)
    pose : (7,) float64 scratch

    Notes
    -----
    Needs a pose. The demand adds to the newest pose reported, `output.pose_t_ns`.
    """
    newest = (sense.pose_count - 1) & (POSES - 1)
    pose_t_ns = sense.pose_t_ns[newest]
    if update_clock(a, inputs.t_ns, pose_t_ns) != 0:
        a.faults |= FAULT_CLOCK
        a.samples = 0
        reset_timestamps(a)
        a.health_ns = a.now_ns
    update_kinematics(a, sense)
    tool_z = sense.pose[7 * newest + 2]
    plane = 1 if params.orient != 0 and params.n_channels >= 3 else 0
    update_plant(params, a, sense, 0 if params.adapt == 0 or params.run != RUN_NORMAL else 1)
    process_sample(params, a, sense, fold, inputs, output, plane, pose)
    if plane == 0 and params.n_channels > 1:
        observe_lookahead(params, a, sense, 1 if a.speed_mps >= MIN_DIRECTION_SPEED_MPS else 0, pose)
    stuck = is_stuck(a)
    update_health(params, a, stuck)
    status = VALID
    if a.health == DROPOUT or a.health == OUT_OF_RANGE or a.health == STUCK:
        status |= NO_SENSOR
    if stuck != 0:
        a.faults |= FAULT_STUCK
        if is_stuck_permanently(a) != 0:
            a.samples = 0
    if stuck != 0 or is_lost(params, a) != 0:
        if a.samples > 0 and stuck == 0:
            a.faults |= FAULT_LOST
        a.set_ns = a.seen_known = 0
        a.preview_share = 0.0
        return (status & ~VALID) | NO_SENSOR | SENSOR_LOST
    if a.shown != 0 and params.run != RUN_DRYRUN:
        a.shown = a.set_ns = a.turn_ns = 0  # nobody took those set points: begin at the tool
    drop = standoff_height(params, a, sense, plane, pose)
    ahead = distance_ahead(params, a, pose, pose_t_ns)
    observe_report(a, sense.pose_count, a.now_ns)
    tick = period_is_due(a, inputs.n_ranges, a.now_ns)
    if tick != 0 or a.sample_ns != a.wanted_sample_ns or pose_t_ns != a.wanted_pose_ns:
        wanted = blend_setpoints(params, a, max(ahead, 0.0), drop, tick)
        a.wanted_pose_ns = pose_t_ns
    else:
        wanted = a.wanted_m + a.wanted_mps * (a.now_ns - a.wanted_ns) * 1e-9
    if tick != 0:
        leading = 1 if a.lead_m > MIN_LEAD_M else 0
        scouted = 1 if a.scout_lead_m > MIN_LEAD_M else 0
        open_period(a, inputs.n_ranges, a.now_ns)
        taken_ns = latch_time(a, inputs.n_ranges, a.now_ns)
        since = a.speed_mps * (taken_ns - pose_t_ns) * 1e-9
        then = ahead + a.speed_mps * ((taken_ns - a.now_ns) * 1e-9 - params.tick_lead_s)
        bias = a.scout_bias_m if scouted != 0 and leading == 0 else 0.0
        known = collect_preview(a, inputs, max(leading, scouted), then, since, bias)
        update_share(a, known, leading, model_error(a))
        a.seen_known = known if leading != 0 else 0
        if known >= MIN_KNOWN_PERIODS:
            z, v = predict_axis(params, a, taken_ns)
            extrapolate_ground(a, known, a.path_m + then, bias)
            speed = solve_plan(params, a, known, z, v, drop)
            a.plan_set_m = invert_axis(params, a.tau_s, z, v, speed)
    if a.seen_known >= 2:
        # what a leading sensor sees is not under the tool: without a plan, follow what it saw there
        rise = (a.plan_g_m[1] - a.plan_g_m[0]) / PERIOD_S
        wanted = a.plan_g_m[0] + rise * (a.tau_s + params.tick_lead_s) + drop
    wanted = filter_setpoint(params, a, wanted)
    wanted += a.preview_share * (a.plan_set_m - wanted)
    if a.samples < INITIALISATION_SAMPLES or (a.samples < CONFIRMED_SAMPLES and dropout_s(a) > 0.0):
        wanted = max(wanted, tool_z)  # toward the surface only when it is known
    limit_setpoint(params, a, a.now_ns, wanted, tool_z)
    demand = a.set_point_m - tool_z
    if not math.isfinite(demand + a.height_m + a.slope + a.sigma_m):
        reset_all(params, a)
        return (status & ~VALID) | NO_SENSOR | SENSOR_LOST
    cut = limit(demand, params.max_demand_m)
    if cut != demand:
        status |= LIMITED
    if fold.close != 0:
        a.faults |= FAULT_CLOSE
        status |= TOO_CLOSE
        cut = max(cut, min(PROBE_M, params.max_demand_m))
    output.demand[2] = cut
    if fold.close != 0:
        a.turn_ns = 0  # first away from the surface, then turn
    elif plane != 0 and a.planes > 0:
        demand_rotation(params, a, sense, output)
    if a.tick_ns == a.now_ns or a.tick_open != 0:
        a.own_m[(a.ticks - 1) & (N_PERIODS - 1)] = tool_z + (cut if params.run == RUN_NORMAL else 0.0)
    if params.run == RUN_DRYRUN:
        a.shown = 1
    elif params.run == RUN_FREEZE:
        a.set_ns = 0  # nobody moves: afterwards it starts at the tool
    output.delta_h_m = a.slope * max(ahead, 0.0)
    output.error_m = params.offset_m - a.held_m
    return status


@jit
def reset_all(params: Any, a: Any) -> None:
    """Begin as if nothing had been seen: what is believed is not finite."""
    a.faults |= FAULT_NOT_FINITE
    a.samples = a.quarantined = a.set_ns = a.turn_ns = a.seen_known = 0
    a.noise_m = a.returned = 0.0  # scores, noise and scale begin anew with the next sample
    a.height_m = a.slope = a.sigma_m = a.scale_m = a.gain = a.path_m = a.sample_way_m = a.lead_m = 0.0
    a.tip_x_m = a.tip_y_m = a.slope_power = 0.0
    a.calm_m = a.wanted_m = a.wanted_mps = a.plan_set_m = 0.0
    a.preview_share = a.preview_bias_m = a.preview_off_m = a.error_m2 = a.plain_m2 = 0.0
    a.scout_lead_m = a.scout_bias_m = a.older_s = a.older_sigma_s = 0.0
    a.tau_s = a.tau_assumed_s = params.plant_tau_s
    for k in range(N_PLANTS):
        a.plant_m2[k] = 0.0
    for i in range(N_CANDIDATES):
        a.weight[i] = 0.0  # new ones would follow from these
    for k in range(HORIZON):
        a.plan_u[k] = a.plan_y[k] = 0.0
    reset_window(a)
    reset_regression(a)


@jit
def reset_surface(a: Any) -> None:
    """SFReset: start anew with the next sample; what was learnt of noise, models and ground is kept."""
    a.samples = 0
    a.sure_ns = 0
    a.quarantined = 0
    a.set_ns = a.seen_known = 0
    a.preview_share = 0.0  # its plan was made over other ground
    a.faults = 0


@jit
def publish_estimate(params: Any, a: Any, output: Any) -> None:
    """Publish what the follower believes."""
    publish_adaptation(params, a, output)
    output.height_m, output.speed_mps = a.height_m, a.speed_mps
    # at rest there is no direction to have a slope along
    output.slope = a.slope if a.speed_mps >= MIN_DIRECTION_SPEED_MPS else 0.0
    output.intervals = a.samples
    publish_normal(a, output)
    output.health, output.reason, output.faults = a.health, a.reason, a.faults
    output.tau_s = a.tau_s
    output.sigma_m, output.noise_m, output.late_s = a.sigma_m, a.noise_m, a.late_s
    output.roughness_m = math.sqrt(max(a.scale_m * a.scale_m - a.noise_m * a.noise_m, 0.0))


@jit
def reset_timestamps(a: Any) -> None:
    """Forget whatever is stamped by a clock that is no more: its times may lie ahead for long.

    Stamps that are compared for being the same, or that a restart sets, need no care.
    """
    a.held_ns = a.sample_ns = a.accepted_ns = a.sure_ns = a.trend_ns = 0
    a.set_ns = a.turn_ns = a.tick_ns = a.calm_ns = a.wanted_ns = 0
    a.ticks = a.tick_open = 0  # set points of future ticks would never be taken
    a.plant_ns = a.distrust_ns = a.arrival_ns = 0
    a.scouted_ns = a.beams_ns = a.plane_ns = 0
    a.scout_lead_m = 0.0
    for c in range(BEAMS):
        a.scout_ns[c] = a.beam_ns[c] = a.beam_changed_ns[c] = 0
