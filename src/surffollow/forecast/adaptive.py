"""The default follower's cycle: take what is new, forecast where the tool should be, limit, report.

sample → footprint (pose at the sample's own time) → bank of models (`adaptive_news`)
now → way ahead of the last footprint → blended set point → limits (`adaptive_limits`) → demand
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.adaptive_adapt import report_adapted
from surffollow.forecast.adaptive_bank import C
from surffollow.forecast.adaptive_beyond import forget_beyond, guess_beyond
from surffollow.forecast.adaptive_blend import blend_set_points, hold_calm, lost_for_s
from surffollow.forecast.adaptive_health import has_been_stuck, is_stuck, is_unsure, watch_health
from surffollow.forecast.adaptive_latency import forget_rest
from surffollow.forecast.adaptive_limits import move_set_point
from surffollow.forecast.adaptive_motion import measure_motion
from surffollow.forecast.adaptive_news import KNOWN_DIRECTION_MPS, take_news, tool_above, watch_clock
from surffollow.forecast.adaptive_plan import invert_axis, plan_axis
from surffollow.forecast.adaptive_plane import demand_turn, surface_normal
from surffollow.forecast.adaptive_plant import learn_plant, own_axis, plant_error
from surffollow.forecast.adaptive_preview import (
    COVERED,
    LEADING_M,
    STEP_S,
    gather_preview,
    move_share,
)
from surffollow.forecast.adaptive_scout import take_scouts
from surffollow.forecast.adaptive_take import START_SAMPLES
from surffollow.forecast.adaptive_tick import note_arrival, open_tick, taken_at, tick_is_due
from surffollow.forecast.safety import PROBE_M, limit
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import (
    DROPOUT,
    FAULT_CLOSE,
    FAULT_LOST,
    FAULT_NOT_FINITE,
    FAULT_STUCK,
    HORIZON,
    OUT_OF_RANGE,
    PLANTS,
    STUCK,
    TICKS,
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

SURE_SAMPLES = 25  # fewer, and then none: not enough to go down for


@jit
def way_ahead(params: Any, a: Any, pose: Any, pose_t_ns: Any) -> Any:
    """How far ahead of the last footprint what the tool points at will be when the controller acts [m]."""
    if a.speed_mps < KNOWN_DIRECTION_MPS:
        return 0.0
    gap_x, gap_y = pose[0] + a.tip_x_m - a.foot_x_m, pose[1] + a.tip_y_m - a.foot_y_m
    gap = gap_x * a.speed_x_mps + gap_y * a.speed_y_mps
    soon = (a.now_ns - pose_t_ns) * 1e-9 + params.tick_lead_s
    return gap / a.speed_mps + a.speed_mps * soon


@jit
def adaptive_demand(params: Any, a: Any, sense: Any, fold: Any, inputs: Any, output: Any, pose: Any) -> Any:
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
    watch_clock(a, inputs.t_ns, pose_t_ns)
    measure_motion(a, sense)
    tool_z = sense.pose[7 * newest + 2]
    plane = 1 if params.orient != 0 and params.n_channels >= 3 else 0
    learn_plant(params, a, sense, 0 if params.adapt == 0 or params.run != RUN_NORMAL else 1)
    take_news(params, a, sense, fold, inputs, output, plane, pose)
    if plane == 0 and params.n_channels > 1:
        take_scouts(params, a, sense, 1 if a.speed_mps >= KNOWN_DIRECTION_MPS else 0, pose)
    stuck = is_stuck(a)
    watch_health(params, a, stuck)
    status = VALID
    if a.health == DROPOUT or a.health == OUT_OF_RANGE or a.health == STUCK:
        status |= NO_SENSOR
    if stuck != 0:
        a.faults |= FAULT_STUCK
        if has_been_stuck(a) != 0:
            a.samples = 0
    if stuck != 0 or is_unsure(params, a) != 0:
        if a.samples > 0 and stuck == 0:
            a.faults |= FAULT_LOST
        a.set_ns = a.seen_known = 0
        a.preview_share = 0.0
        return (status & ~VALID) | NO_SENSOR | SENSOR_LOST
    if a.shown != 0 and params.run != RUN_DRYRUN:
        a.shown = a.set_ns = a.turn_ns = 0  # nobody took those set points: begin at the tool
    drop = tool_above(params, a, sense, plane, pose)
    ahead = way_ahead(params, a, pose, pose_t_ns)
    note_arrival(a, sense.pose_count, a.now_ns)
    tick = tick_is_due(a, inputs.n_ranges, a.now_ns)
    if tick != 0 or a.sample_ns != a.wanted_sample_ns or pose_t_ns != a.wanted_pose_ns:
        wanted = blend_set_points(params, a, max(ahead, 0.0), drop, tick)
        a.wanted_pose_ns = pose_t_ns
    else:
        wanted = a.wanted_m + a.wanted_mps * (a.now_ns - a.wanted_ns) * 1e-9
    if tick != 0:
        leading = 1 if a.lead_m > LEADING_M else 0
        scouted = 1 if a.scout_lead_m > LEADING_M else 0
        open_tick(a, inputs.n_ranges, a.now_ns)
        taken_ns = taken_at(a, inputs.n_ranges, a.now_ns)
        since = a.speed_mps * (taken_ns - pose_t_ns) * 1e-9
        then = ahead + a.speed_mps * ((taken_ns - a.now_ns) * 1e-9 - params.tick_lead_s)
        bias = a.scout_bias_m if scouted != 0 and leading == 0 else 0.0
        known = gather_preview(a, inputs, max(leading, scouted), then, since, bias)
        move_share(a, known, leading, plant_error(a))
        a.seen_known = known if leading != 0 else 0
        if known >= COVERED:
            z, v = own_axis(params, a, taken_ns)
            guess_beyond(a, known, a.path_m + then, bias)
            speed = plan_axis(params, a, known, z, v, drop)
            a.plan_set_m = invert_axis(params, a.tau_s, z, v, speed)
    if a.seen_known >= 2:
        # what a leading sensor sees is not under the tool: without a plan, follow what it saw there
        rise = (a.plan_g_m[1] - a.plan_g_m[0]) / STEP_S
        wanted = a.plan_g_m[0] + rise * (a.tau_s + params.tick_lead_s) + drop
    wanted = hold_calm(params, a, wanted)
    wanted += a.preview_share * (a.plan_set_m - wanted)
    if a.samples < START_SAMPLES or (a.samples < SURE_SAMPLES and lost_for_s(a) > 0.0):
        wanted = max(wanted, tool_z)  # toward the surface only when it is known
    move_set_point(params, a, a.now_ns, wanted, tool_z)
    demand = a.set_point_m - tool_z
    if not math.isfinite(demand + a.height_m + a.slope + a.sigma_m):
        forget_all(params, a)
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
        demand_turn(params, a, sense, output)
    if a.tick_ns == a.now_ns or a.tick_open != 0:
        a.own_m[(a.ticks - 1) & (TICKS - 1)] = tool_z + (cut if params.run == RUN_NORMAL else 0.0)
    if params.run == RUN_DRYRUN:
        a.shown = 1
    elif params.run == RUN_FREEZE:
        a.set_ns = 0  # nobody moves: afterwards it starts at the tool
    output.delta_h_m = a.slope * max(ahead, 0.0)
    output.error_m = params.offset_m - a.held_m
    return status


@jit
def forget_all(params: Any, a: Any) -> None:
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
    for k in range(PLANTS):
        a.plant_m2[k] = 0.0
    for i in range(C):
        a.weight[i] = 0.0  # new ones would follow from these
    for k in range(HORIZON):
        a.plan_u[k] = a.plan_y[k] = 0.0
    forget_rest(a)
    forget_beyond(a)


@jit
def forget_surface(a: Any) -> None:
    """SFReset: start anew with the next sample; what was learnt of noise, models and ground is kept."""
    a.samples = 0
    a.sure_ns = 0
    a.quarantined = 0
    a.set_ns = a.seen_known = 0
    a.preview_share = 0.0  # its plan was made over other ground
    a.faults = 0


@jit
def report_adaptive(params: Any, a: Any, output: Any) -> None:
    """Publish what the follower believes."""
    report_adapted(params, a, output)
    output.height_m, output.speed_mps = a.height_m, a.speed_mps
    # at rest there is no direction to have a slope along
    output.slope = a.slope if a.speed_mps >= KNOWN_DIRECTION_MPS else 0.0
    output.intervals = a.samples
    surface_normal(a, output)
    output.health, output.reason, output.faults = a.health, a.reason, a.faults
    output.tau_s = a.tau_s
    output.sigma_m, output.noise_m, output.late_s = a.sigma_m, a.noise_m, a.late_s
    output.roughness_m = math.sqrt(max(a.scale_m * a.scale_m - a.noise_m * a.noise_m, 0.0))
