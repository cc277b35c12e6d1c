"""The default follower: a bank of models, each judged by what its demands would have done."""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from surffollow.forecast.adaptive_bank import (
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
T_SCORE_M = 0.1
T_SCORE_S = 0.5
POWER = 10.0
FLOOR_M2 = 0.02e-6
LEAD_S = 0.005
GATE = 8.0
GATE_M = 1e-3
NEED_WAY_M = 2.5e-3


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
def weigh(a: Any) -> None:
    best = a.score_m2[0]
    for i in range(1, N):
        best = min(best, a.score_m2[i])
    total = 0.0
    base = 1.0 / (best + FLOOR_M2)
    for i in range(N):
        w = ((a.score_m2[i] + FLOOR_M2) * base) ** -POWER
        a.weight[i] = w
        total += w
    for i in range(N):
        a.weight[i] /= total


@njit(cache=True, nogil=True)
def blended_height(a: Any) -> Any:
    h = 0.0
    for i in range(N):
        h += a.weight[i] * height_of(i, a.state)
    return h


@njit(cache=True, nogil=True)
def take_sample(params: Any, a: Any, t_ns: Any, h_m: Any, drop_m: Any) -> None:
    """Let the bank learn one footprint height."""
    r = 0.3e-3**2
    if a.samples == 0:
        for i in range(N):
            start_model(i, a.state, a.cov, h_m, r)
            a.score_m2[i] = 1e-6
            a.axis_z_m[i] = h_m + drop_m
        weigh(a)
        a.scale_m = 0.5e-3
        a.samples = 1
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
    gate = max(GATE * a.scale_m, GATE_M)
    if abs(nu) > gate:
        if a.quarantined > 0 and abs(nu - a.quarantine_shift_m / a.quarantined) < gate:
            a.quarantined += 1
            a.quarantine_shift_m += nu
            a.quarantine_way_m += d
        else:
            a.quarantined = 1
            a.quarantine_shift_m = nu
            a.quarantine_way_m = 0.0
        if a.quarantined < 3 or a.quarantine_way_m < NEED_WAY_M:
            return
        shift = a.quarantine_shift_m / a.quarantined
        for i in range(N):
            a.state[3 * i] += shift
        nu -= shift
        a.settle_ns = t_ns + 150_000_000
        a.quarantined = 0
    else:
        a.quarantined = 0
    a.scale_m += 0.02 * (1.25 * min(abs(nu), gate) - a.scale_m)
    if t_ns > a.settle_ns:
        f = min(1.0, d / T_SCORE_M + dt / T_SCORE_S)
        f = 1.0 - math.exp(-f)
        if a.samples < 2.0 / f:
            f = max(f, 1.0 / (1.0 + a.samples))
        target = h_m + drop_m
        for i in range(N):
            e = a.axis_z_m[i] - target
            a.score_m2[i] += f * (e * e - a.score_m2[i])
        weigh(a)
    for i in range(N):
        update_model(i, a.state, a.cov, h_m, r)
    a.samples += 1


@njit(cache=True, nogil=True)
def set_points(params: Any, a: Any, now_ns: Any, drop_m: Any, tick: Any) -> Any:
    """Blend the candidates' set points for now; on a tick remember each."""
    d = a.speed_mps * ((now_ns - a.sample_ns) * 1e-9 + LEAD_S)
    lead = a.speed_mps * params.plant_tau_s
    z = 0.0
    slot = a.ticks & (TICKS - 1)
    for i in range(N):
        t = look_ahead(i, a.state, d, lead) + drop_m
        z += a.weight[i] * t
        if tick:
            a.target_m[i * TICKS + slot] = t
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
