"""The default follower's cycle: take what is new, forecast where the tool should be, limit, report.

sample → footprint (pose at the sample's own time) → bank of models (`adaptive_take`, `adaptive_bank`)
now → way ahead of the last footprint → blended set point → limits (`adaptive_motion`) → demand
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from surffollow.forecast.adaptive_bank import N, look_ahead
from surffollow.forecast.adaptive_health import (
    CLOSE_SAMPLES,
    FAULT_CLOCK,
    FAULT_CLOSE,
    FAULT_LOST,
    FAULT_NOT_FINITE,
    FAULT_STUCK,
    is_stuck,
    watch_health,
    watch_stuck,
)
from surffollow.forecast.adaptive_judge import note_targets
from surffollow.forecast.adaptive_motion import measure_motion, move_set_point, pose_when
from surffollow.forecast.adaptive_plan import invert_axis, plan_axis
from surffollow.forecast.adaptive_plane import demand_turn, plane_height, surface_normal, take_beams
from surffollow.forecast.adaptive_plant import learn_plant, own_axis, plant_error
from surffollow.forecast.adaptive_preview import (
    COVERED,
    LEADING_M,
    STEP_S,
    check_told,
    gather_preview,
    move_share,
    told_height,
    watch_error,
)
from surffollow.forecast.adaptive_take import is_news, take_sample
from surffollow.forecast.adaptive_trend import take_range
from surffollow.forecast.pose import footprint, rotate
from surffollow.forecast.safety import PROBE_M, limit, watch_fold_back
from surffollow.shm.layout_adaptive import DROPOUT, OUT_OF_RANGE, STUCK, TICKS
from surffollow.shm.layout_follow import (
    LIMITED,
    NO_SENSOR,
    POSES,
    RUN_FREEZE,
    RUN_NORMAL,
    SENSOR_LOST,
    TOO_CLOSE,
    VALID,
)

TICK_NS = 9_999_000  # controller ticks at 100 Hz; a microsecond less, stamps may be rounded
CLOCK_BACK_NS = 1_000_000_000  # a clock that jumps back farther than late samples may is followed
LATE_RATE = 0.05
LEAD_RATE = 0.05
GRACE_S = 0.025  # a lone lost sample is no drop-out
KNOWN_DIRECTION_MPS = 0.005  # slower, the direction of travel is not known well enough to look ahead


@njit(cache=True, nogil=True)
def watch_clock(a: Any, t_ns: Any, pose_t_ns: Any) -> None:
    """The latest time heard of is now; late samples do not turn it back, a new clock does."""
    t = max(t_ns, pose_t_ns)
    if t < a.now_ns - CLOCK_BACK_NS:
        a.faults |= FAULT_CLOCK
        a.samples = 0
        a.held_ns = a.set_ns = a.tick_ns = 0
        a.now_ns = t
    a.now_ns = max(a.now_ns, t)


@njit(cache=True, nogil=True)
def tool_above(params: Any, a: Any, sense: Any, plane: Any, pose: Any) -> Any:
    """How much higher than the ground under it (the beam's footprint) the tool should be [m].

    `pose` (7,) is scratch and holds the newest report afterwards.
    """
    newest = 7 * ((sense.pose_count - 1) & (POSES - 1))
    for i in range(7):
        pose[i] = sense.pose[newest + i]
    if plane == 0:
        _, _, ground_z, _ = footprint(pose, params.tool_from_sensor, 0, params.offset_m)
        return pose[2] - ground_z
    tx, ty, tz = rotate(pose[3], pose[4], pose[5], pose[6], 0.0, 0.0, 1.0)
    along = tz - a.slope_x * tx - a.slope_y * ty  # (tool axis · normal) over the normal's z
    return (params.offset_m - params.tool_from_sensor[2]) * along


@njit(cache=True, nogil=True)
def take_news(params: Any, state: Any, inputs: Any, output: Any, plane: Any, pose: Any) -> None:
    """Take a new sample, if there is one; what does not enter the estimate is not mapped."""
    a, sense = state.adaptive, state.sense
    channel = 0
    if plane != 0:
        channel = take_beams(params, a, sense, pose)
    else:
        output.fresh &= ~1
    if channel < 0:
        return
    news, range_m, t = is_news(params, a, sense, inputs.n_ranges, channel)
    if news == 0:
        return
    take_range(a, t, range_m)
    pose_when(a, sense, t, pose)
    watch_stuck(a, 1 if a.held_ns != 0 and range_m == a.held_m else 0, pose[2])
    a.held_ns, a.held_m = t, range_m
    a.late_s += LATE_RATE * ((a.now_ns - t) * 1e-9 - a.late_s)
    if t <= a.sample_ns or is_stuck(a, pose[2]) != 0:
        return
    x, y, z, sensor_z = footprint(pose, params.tool_from_sensor, channel, range_m)
    a.close_run = a.close_run + 1 if range_m < params.too_close_m else 0
    if a.close_run >= CLOSE_SAMPLES or state.paper.close != 0:
        watch_fold_back(state.paper, range_m, sensor_z, params.too_close_m, params.too_close_exit_m)
    tool_x, tool_y, tool_z = pose[0], pose[1], pose[2]
    if plane != 0:
        good, z = plane_height(params, a, t, tool_x, tool_y)
        if good == 0:
            return
        x, y = tool_x, tool_y
        for c in range(params.n_channels):
            if a.beam_good[c] == 0:
                output.fresh &= ~(1 << c)
    if a.speed_mps >= KNOWN_DIRECTION_MPS:
        lead = ((x - tool_x) * a.speed_x_mps + (y - tool_y) * a.speed_y_mps) / a.speed_mps
        a.lead_m += (lead - a.lead_m) * (LEAD_RATE if a.samples > 0 else 1.0)
    way = a.speed_mps * (t - a.sample_ns) * 1e-9 if a.samples > 0 else 0.0
    adapt = 0 if params.adapt == 0 or params.run == RUN_FREEZE else 1
    drop = tool_above(params, a, sense, plane, pose)
    taken = take_sample(params, a, t, way, z, drop, adapt)
    a.foot_x_m, a.foot_y_m = x, y
    if taken == 0:
        return
    if abs(a.lead_m) < LEADING_M:
        watch_error(a, tool_z - drop - z)
    if inputs.n_preview > 0 and a.speed_mps >= KNOWN_DIRECTION_MPS:
        beside = (x - pose[0]) * a.speed_x_mps + (y - pose[1]) * a.speed_y_mps
        check_told(a, told_height(inputs, beside / a.speed_mps), z)
    if plane == 0:
        output.fresh |= 1
        output.target_m[0], output.target_m[1], output.target_m[2] = x, y, z


@njit(cache=True, nogil=True)
def way_ahead(params: Any, a: Any, pose: Any, pose_t_ns: Any) -> Any:
    """How far ahead of the last footprint the tool will be when the controller acts [m]."""
    if a.speed_mps < KNOWN_DIRECTION_MPS:
        return 0.0
    gap = (pose[0] - a.foot_x_m) * a.speed_x_mps + (pose[1] - a.foot_y_m) * a.speed_y_mps
    soon = (a.now_ns - pose_t_ns) * 1e-9 + params.tick_lead_s
    return gap / a.speed_mps + a.speed_mps * soon


@njit(cache=True, nogil=True)
def blend_set_points(params: Any, a: Any, ahead_m: Any, drop_m: Any, tick: Any) -> Any:
    """Blend the candidates' set points; on a tick remember each.

    The assumed axis lags by τ, so its set point is the height plus τ times the height's rate of change.
    In a drop-out the way ahead is drawn in: slopes are trusted over `dropout_way_m`, no farther.
    """
    lost_s = (a.now_ns - a.accepted_ns) * 1e-9 - a.late_s - GRACE_S
    lead = a.speed_mps * a.tau_s
    if lost_s > 0.0:
        lost_m = min(a.speed_mps * lost_s, ahead_m)
        fade = math.exp(-lost_m / params.dropout_way_m)
        ahead_m += params.dropout_way_m * (1.0 - fade) - lost_m
        lead *= fade
    slot = a.ticks & (TICKS - 1)
    z = 0.0
    for i in range(N):
        t = look_ahead(i, a.state, ahead_m, lead) + drop_m
        z += a.weight[i] * t
        if tick:
            a.target_m[i * TICKS + slot] = t
    if tick:
        note_targets(a, a.now_ns)
    return z


@njit(cache=True, nogil=True)
def hold_calm(params: Any, a: Any, wanted_m: Any) -> Any:
    """Carry the set point on along the slope while it stays near where it is wanted.

    The band is `calm_share` of `permitted_variance_m`: what the paper's hysteresis does in steps.
    """
    dt = (a.now_ns - a.calm_ns) * 1e-9
    band = params.calm_share * params.permitted_variance_m
    on = a.calm_m + (a.slope * a.speed_mps * dt if 0.0 < dt < 0.1 else 0.0)
    a.calm_ns = a.now_ns
    a.calm_m = min(max(on, wanted_m - band), wanted_m + band)
    return a.calm_m


@njit(cache=True, nogil=True)
def adaptive_demand(params: Any, state: Any, inputs: Any, output: Any, pose: Any) -> Any:
    """Demand of the adaptive mode into `output`; returns status bits.

    Parameters
    ----------
    params, state, inputs, output : records of `Params`, `FollowState`, `Inputs`, `Output`
    pose : (7,) float64 scratch

    Notes
    -----
    Needs a pose. The demand adds to the newest pose reported, `output.pose_t_ns`.
    """
    a, sense = state.adaptive, state.sense
    newest = (sense.pose_count - 1) & (POSES - 1)
    pose_t_ns = sense.pose_t_ns[newest]
    watch_clock(a, inputs.t_ns, pose_t_ns)
    measure_motion(a, sense)
    tool_z = sense.pose[7 * newest + 2]
    plane = 1 if params.orient != 0 and params.n_channels >= 3 else 0
    learn_plant(params, a, sense, 0 if params.adapt == 0 or params.run != RUN_NORMAL else 1)
    take_news(params, state, inputs, output, plane, pose)
    stuck = is_stuck(a, tool_z)
    watch_health(params, a, stuck)
    status = VALID
    if a.health == DROPOUT or a.health == OUT_OF_RANGE or a.health == STUCK:
        status |= NO_SENSOR
    if stuck != 0:
        a.faults |= FAULT_STUCK
    if a.samples == 0 or a.now_ns - a.accepted_ns > params.loss_timeout_ns:
        if a.samples > 0:
            a.faults |= FAULT_LOST
        a.set_ns = 0
        return (status & ~VALID) | NO_SENSOR | SENSOR_LOST
    drop = tool_above(params, a, sense, plane, pose)
    ahead = way_ahead(params, a, pose, pose_t_ns)
    tick = 1 if a.now_ns - a.tick_ns >= TICK_NS else 0
    wanted = blend_set_points(params, a, max(ahead, 0.0), drop, tick)
    if tick != 0:
        leading = 1 if a.lead_m > LEADING_M else 0
        since = a.speed_mps * (a.now_ns - pose_t_ns) * 1e-9
        known = gather_preview(a, inputs, leading, ahead - a.speed_mps * params.tick_lead_s, since)
        move_share(a, known, leading, plant_error(a))
        a.seen_known = known if leading != 0 else 0
        if known >= COVERED:
            z, v = own_axis(params, a, a.now_ns)
            speed = plan_axis(params, a, known, z, v, drop)
            a.plan_set_m = invert_axis(params, a.tau_s, z, v, speed)
    if a.seen_known >= 2:
        # what a leading sensor sees is not under the tool: without a plan, follow what it saw there
        rise = (a.plan_g_m[1] - a.plan_g_m[0]) / STEP_S
        wanted = a.plan_g_m[0] + rise * (a.tau_s + params.tick_lead_s) + drop
    wanted = hold_calm(params, a, wanted)
    wanted += a.preview_share * (a.plan_set_m - wanted)
    move_set_point(params, a, a.now_ns, wanted, tool_z)
    demand = a.set_point_m - tool_z
    if not math.isfinite(demand):
        a.faults |= FAULT_NOT_FINITE
        a.samples = 0
        a.set_ns = 0
        a.noise_m = a.returned = 0.0
        return (status & ~VALID) | NO_SENSOR | SENSOR_LOST
    cut = limit(demand, params.max_demand_m)
    if cut != demand:
        status |= LIMITED
    if state.paper.close != 0:
        a.faults |= FAULT_CLOSE
        status |= TOO_CLOSE
        cut = max(cut, min(PROBE_M, params.max_demand_m))
    output.demand[2] = cut
    if plane != 0 and a.planes > 0:
        demand_turn(params, a, sense, output)
    if a.tick_ns == a.now_ns:
        a.own_m[(a.ticks - 1) & (TICKS - 1)] = tool_z + cut
    output.delta_h_m = a.slope * max(ahead, 0.0)
    output.error_m = params.offset_m - a.held_m
    return status


@njit(cache=True, nogil=True)
def forget_surface(a: Any) -> None:
    """SFReset: start anew with the next sample; noise, scores and what steps do here are kept."""
    a.samples = 0
    a.quarantined = 0
    a.set_ns = 0
    a.faults = 0


@njit(cache=True, nogil=True)
def report_adaptive(a: Any, output: Any) -> None:
    """Publish what the follower believes."""
    output.height_m, output.slope, output.speed_mps = a.height_m, a.slope, a.speed_mps
    output.intervals = a.samples
    surface_normal(a, output)
    output.health, output.faults = a.health, a.faults
    output.tau_s = a.tau_s
    output.sigma_m, output.noise_m, output.late_s = a.sigma_m, a.noise_m, a.late_s
    output.roughness_m = math.sqrt(max(a.scale_m * a.scale_m - a.noise_m * a.noise_m, 0.0))
