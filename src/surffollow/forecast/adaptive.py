"""The default follower: a bank of models, each judged by what its demands would have done."""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from surffollow.forecast.adaptive_bank import (
    BANK,
    PRIOR,
    N,
    height_of,
    look_ahead,
    predict_model,
    start_model,
    update_model,
)
from surffollow.forecast.pose import footprint, pose_at
from surffollow.shm.layout_adaptive import TICKS
from surffollow.shm.layout_follow import POSES

TICK_NS = 10_000_000
SPEED_WINDOW_NS = 100_000_000
FLOOR_M2 = 0.02e-6


@njit(cache=True, nogil=True)
def lateral_velocity(a: Any, sense: Any) -> None:
    n = sense.pose_count
    last = (n - 1) & (POSES - 1)
    k = n - 1
    oldest = max(0, n - POSES + 1)
    t = sense.pose_t_ns[last]
    while k > oldest and t - sense.pose_t_ns[k & (POSES - 1)] < SPEED_WINDOW_NS:
        k -= 1
    first = k & (POSES - 1)
    if first == last:
        a.speed_x_mps, a.speed_y_mps, a.speed_mps = 0.0, 0.0, 0.0
        return
    dt = (t - sense.pose_t_ns[first]) * 1e-9
    a.speed_x_mps = (sense.pose[7 * last] - sense.pose[7 * first]) / dt
    a.speed_y_mps = (sense.pose[7 * last + 1] - sense.pose[7 * first + 1]) / dt
    a.speed_mps = math.sqrt(a.speed_x_mps**2 + a.speed_y_mps**2)


@njit(cache=True, nogil=True)
def axis_velocity(d: Any, tau: Any, a_max: Any) -> Any:
    lin = a_max * tau * tau
    if d > lin:
        return math.sqrt(2.0 * a_max * (d - 0.5 * lin))
    if d < -lin:
        return -math.sqrt(2.0 * a_max * (-d - 0.5 * lin))
    return d / tau


@njit(cache=True, nogil=True)
def advance_shadows(params: Any, a: Any, from_ns: Any, to_ns: Any) -> None:
    """Carry every shadow axis on from one time to another with the set points of its candidate."""
    span = to_ns - from_ns
    steps = min(max(int((span + 1_999_999) // 2_000_000), 1), 32)
    dt = span * 1e-9 / steps
    tau, v_max, dv = params.plant_tau_s, params.plant_v_max_mps, params.plant_a_max_mps2 * dt
    k = max(0, a.ticks - TICKS)
    for j in range(steps):
        t = from_ns + (span * j) // steps
        while k + 1 < a.ticks and a.tick_t_ns[(k + 1) & (TICKS - 1)] <= t:
            k += 1
        slot = k & (TICKS - 1)
        for i in range(N):
            d = a.target_m[i * TICKS + slot] - a.axis_z_m[i]
            w = axis_velocity(d, tau, params.plant_a_max_mps2)
            w = min(max(w, -v_max), v_max)
            w = min(max(w, -abs(d) / dt), abs(d) / dt)
            v = a.axis_v_mps[i]
            v += min(max(w - v, -dv), dv)
            a.axis_v_mps[i] = v
            a.axis_z_m[i] += v * dt


@njit(cache=True, nogil=True)
def weigh(params: Any, a: Any) -> None:
    """Turn scores into weights: powers of recent and longer cost, noise taken off."""
    best, best_long = 1e300, 1e300
    for i in range(N):
        best = min(best, a.score_m2[i])
        best_long = min(best_long, a.long_m2[i])
    off = params.noise_share * min(a.noise_m * a.noise_m, best)
    off_long = params.noise_share * min(a.noise_m * a.noise_m, best_long)
    floor = params.score_floor_m * params.score_floor_m
    mu = params.effort_m * params.effort_m
    best, best_long = 1e300, 1e300
    for i in range(N):
        a.cost_m2[i] = math.log(a.score_m2[i] - off + floor + mu * a.effort[i])
        a.weight[i] = math.log(a.long_m2[i] - off_long + floor + mu * a.effort[i])
        a.cost_m2[i] = params.score_power * a.cost_m2[i] + params.long_power * a.weight[i]
        a.cost_m2[i] += PRIOR[int(BANK[i, 0])]
        best = min(best, a.cost_m2[i])
    total = 0.0
    for i in range(N):
        w = math.exp(best - a.cost_m2[i])
        a.weight[i] = w
        total += w
    for i in range(N):
        a.weight[i] /= total


@njit(cache=True, nogil=True)
def watch_noise(a: Any, h_m: Any) -> None:
    """Reading noise from second differences of accepted heights: a running median, free of slopes."""
    if a.samples > 2:
        e = abs(h_m - 2.0 * a.recent_m[0] + a.recent_m[1])
        step = 0.02 * max(a.median_m, 1e-5)
        a.median_m += step if e > a.median_m else -step
        a.noise_m = 1.4826 / math.sqrt(6.0) * a.median_m
    a.recent_m[1] = a.recent_m[0]
    a.recent_m[0] = h_m


@njit(cache=True, nogil=True)
def blended_height(a: Any) -> Any:
    h = 0.0
    for i in range(N):
        h += a.weight[i] * height_of(i, a.state)
    return h


@njit(cache=True, nogil=True)
def take_sample(params: Any, a: Any, t_ns: Any, h_m: Any, drop_m: Any) -> None:
    """Let the bank learn one footprint height."""
    if a.samples == 0:
        r = 0.3e-3**2
        for i in range(N):
            start_model(i, a.state, a.cov, h_m, r)
            a.score_m2[i] = 1e-6
            a.long_m2[i] = 1e-6
            a.axis_z_m[i] = h_m + drop_m
        weigh(params, a)
        a.scale_m = 0.5e-3
        a.median_m = 0.3e-3 * math.sqrt(6.0) / 1.4826
        a.noise_m = 0.3e-3
        a.samples = 1
        a.returned = 1.0
        a.sample_ns = t_ns
        return
    dt = (t_ns - a.sample_ns) * 1e-9
    d = max(a.speed_mps, 1e-3) * dt
    if a.ticks > 0:
        advance_shadows(params, a, a.sample_ns, t_ns)
    a.sample_ns = t_ns
    for i in range(N):
        predict_model(i, a.state, a.cov, d)
    nu = h_m - blended_height(a)
    gate = max(params.gate_scales * a.scale_m, params.gate_m)
    if abs(nu) > gate:
        if a.quarantined > 0 and abs(nu - a.quarantine_shift_m / a.quarantined) < gate:
            a.quarantined += 1
            a.quarantine_shift_m += nu
            a.quarantine_way_m += d
        else:
            a.quarantined = 1
            a.quarantine_shift_m = nu
            a.quarantine_way_m = 0.0
        if a.quarantined < params.step_samples or a.quarantine_way_m < params.step_way_m * a.returned:
            return
        shift = a.quarantine_shift_m / a.quarantined
        for i in range(N):
            a.state[3 * i] += shift
        nu -= shift
        a.settle_ns = t_ns + 150_000_000
        a.quarantined = 0
        if a.returned > 0.0 and a.since_step_m < params.step_way_m:
            a.returned = 1.0
        a.returned *= 0.5
        a.since_step_m = 0.0
    else:
        if a.quarantined >= params.step_samples:
            a.returned = 1.0
        a.quarantined = 0
    a.since_step_m += d
    a.scale_m += 0.02 * (1.25 * min(abs(nu), gate) - a.scale_m)
    if t_ns > a.settle_ns:
        rate = d / params.score_way_m + dt / params.score_time_s
        f = max(1.0 - math.exp(-rate), 1.0 / (1.0 + a.samples))
        g = max(1.0 - math.exp(-rate / params.long_factor), 1.0 / (1.0 + a.samples))
        target = h_m + drop_m
        for i in range(N):
            e = a.axis_z_m[i] - target
            a.score_m2[i] += f * (e * e - a.score_m2[i])
            a.long_m2[i] += g * (e * e - a.long_m2[i])
        weigh(params, a)
    watch_noise(a, h_m)
    r = max(a.noise_m, 0.05e-3) ** 2
    for i in range(N):
        update_model(i, a.state, a.cov, h_m, r)
    a.samples += 1


@njit(cache=True, nogil=True)
def set_points(params: Any, a: Any, now_ns: Any, drop_m: Any, tick: Any) -> Any:
    """Blend the candidates' set points for now; on a tick remember each."""
    d = a.speed_mps * ((now_ns - a.sample_ns) * 1e-9 + params.tick_lead_s)
    lead = a.speed_mps * params.plant_tau_s
    z = 0.0
    slot = a.ticks & (TICKS - 1)
    for i in range(N):
        t = look_ahead(i, a.state, d, lead) + drop_m
        z += a.weight[i] * t
        if tick:
            base = i * TICKS
            if a.ticks > 1:
                acc = t - 2.0 * a.target_m[base + ((slot - 1) & (TICKS - 1))]
                acc = (acc + a.target_m[base + ((slot - 2) & (TICKS - 1))]) * 1e4
                a.effort[i] += 0.02 * (min(acc * acc, 100.0) - a.effort[i])
            a.target_m[base + slot] = t
    if tick:
        a.tick_t_ns[slot] = now_ns
        a.ticks += 1
        a.tick_ns = now_ns
    return z


@njit(cache=True, nogil=True)
def adaptive_demand(params: Any, state: Any, inputs: Any, output: Any, pose: Any) -> Any:
    """Demand of the adaptive mode into `output`."""
    a, sense = state.adaptive, state.sense
    a.now_ns = max(a.now_ns, inputs.t_ns)
    newest = (sense.pose_count - 1) & (POSES - 1)
    a.now_ns = max(a.now_ns, sense.pose_t_ns[newest])
    lateral_velocity(a, sense)
    for i in range(7):
        pose[i] = sense.pose[7 * newest + i]
    _, _, ground_z, _ = footprint(pose, params.tool_from_sensor, 0, params.offset_m)
    drop = pose[2] - ground_z
    if sense.fresh[0] != 0 and sense.range_t_ns[0] > a.sample_ns:
        t = sense.range_t_ns[0]
        pose_at(sense, t, 1, pose)
        _, _, z, _ = footprint(pose, params.tool_from_sensor, 0, sense.range_m[0])
        take_sample(params, a, t, z, drop)
    if a.samples == 0:
        return 0
    tick = a.now_ns - a.tick_ns >= TICK_NS - 1000
    a.set_point_m = set_points(params, a, a.now_ns, drop, tick)
    output.demand[2] = a.set_point_m - sense.pose[7 * newest + 2]
    return 1
