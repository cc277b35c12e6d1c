"""Plan the axis over ground known ahead: least squares with bounded acceleration, then invert the axis.

    min  ½ Σ w (z − g)² + ½ λ Σ a²   with |a| ≤ a_max, from where the axis is and how it moves

solved by the alternating direction method: one pentadiagonal system, factored once, and a clip, a fixed
number of times, warm-started from the last tick. Just beyond the known ground what is guessed
(`adaptive_beyond`) carries half the weight, lest the axis arrive there at a speed it cannot lose; farther on
nothing does.

Alone that would take half of a step down before its edge, toward solid ground. So what goes down before the
ground does costs more: ½ W (b − z)² where z is below b, with W large. Then the system is factored anew.
"""

from __future__ import annotations

from typing import Any

from surffollow.forecast.adaptive_judge import axis_speed
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import HORIZON

TICK_S = 0.01
ROUNDS, EARLY_ROUNDS = 25, 50  # the more where points are early
RHO = 60.0
A_SHARE = 0.9  # of the axis' acceleration: what is left corrects
INVERT_ROUNDS = 24
INVERT_STEPS = 5  # axis steps of 2 ms in a tick
UNKNOWN_WEIGHT = 1e-6
EARLY_M, EARLY_WEIGHT = 1.5e-3, 300.0  # lower than that before the ground falls away is early
EDGE_M = 6e-4  # an edge may lie so much farther on than seen
FORESEEN = 5  # ticks from now on; the errors until then may be the robot's own
FADE = 0.98  # per tick: readings tell of an error late
AFTER, AFTER_WEIGHT = 16, 0.5  # ticks beyond the known ground


@jit
def ground_weight(k: Any, known: Any) -> Any:
    """How much point k of the plan, k + 1 ticks from now, counts."""
    if k + 1 < known:
        return 1.0
    return AFTER_WEIGHT if k + 1 < known + AFTER else UNKNOWN_WEIGHT


@jit
def find_early(a: Any, known: Any, drop_m: Any, z_m: Any) -> Any:
    """Mark in `a.plan_early` the points that go down before the ground does; how many marks changed.

    They are below the lowest stand-off until then by more than `EARLY_M`, and below the axis as it is now:
    one that is late on its way up is not early.
    """
    lowest, changed = a.plan_g_m[0] + drop_m - z_m, 0
    late = min(int(EDGE_M / max(a.speed_mps * TICK_S, 1e-6)), HORIZON)
    for k in range(min(known - 1, HORIZON)):
        lowest = min(lowest, a.plan_g_m[max(k + 1 - late, 0)] + drop_m - z_m)
        a.plan_bound_m[k] = min(lowest - EARLY_M, 0.0)
        early = 1 if a.plan_z_m[k] < a.plan_bound_m[k] else 0
        if early != a.plan_early[k]:
            a.plan_early[k] = early
            changed += 1
    return changed


@jit
def note_foreseen(a: Any, known: Any, drop_m: Any, z_m: Any) -> None:
    """Remember how far off a good robot will be, at a step say: that tells nothing against the plan."""
    a.plan_error_m *= FADE
    for k in range(FORESEEN, min(known - 1, HORIZON)):
        a.plan_error_m = max(a.plan_error_m, abs(a.plan_z_m[k] - (a.plan_g_m[k + 1] + drop_m - z_m)))


@jit
def factor(a: Any, known: Any, stiff: Any) -> None:
    """LDLᵀ of W + stiff·DᵀD for second differences D that begin with two known points."""
    n = HORIZON
    for k in range(n):
        # row k of DᵀD: differences b_k (centre k-1), b_{k+1}, b_{k+2}
        d = 1.0 + (4.0 if k + 1 < n else 0.0) + (1.0 if k + 2 < n else 0.0)
        e = (-2.0 if k + 1 < n else 0.0) + (-2.0 if k + 2 < n else 0.0)
        f = 1.0 if k + 2 < n else 0.0
        d, e, f = ground_weight(k, known) + stiff * d, stiff * e, stiff * f
        if a.plan_early[k] != 0:
            d += EARLY_WEIGHT
        if k >= 1:
            d -= a.band_1[k - 1] ** 2 * a.band_0[k - 1]
            e -= a.band_1[k - 1] * a.band_2[k - 1] * a.band_0[k - 1]
        if k >= 2:
            d -= a.band_2[k - 2] ** 2 * a.band_0[k - 2]
        a.band_0[k] = d
        a.band_1[k] = e / d
        a.band_2[k] = f / d


@jit
def solve(a: Any) -> None:
    """Solve with those factors in place of `a.plan_z_m`."""
    n = HORIZON
    z = a.plan_z_m
    for k in range(n):
        if k >= 1:
            z[k] -= a.band_1[k - 1] * z[k - 1]
        if k >= 2:
            z[k] -= a.band_2[k - 2] * z[k - 2]
    for k in range(n - 1, -1, -1):
        z[k] /= a.band_0[k]
        if k + 1 < n:
            z[k] -= a.band_1[k] * z[k + 1]
        if k + 2 < n:
            z[k] -= a.band_2[k] * z[k + 2]


@jit
def plan_axis(params: Any, a: Any, known: Any, z_m: Any, v_mps: Any, drop_m: Any) -> Any:
    """Plan from the axis' state and return the speed that it should have one tick from now.

    Parameters
    ----------
    params, a : records of `Params`, `AdaptiveState`; `a.plan_g_m` holds all ground from now on
    known : int            ticks of ground known
    z_m, v_mps : float64   axis now
    drop_m : float64       tool above ground

    Returns
    -------
    float64 [m/s]
    """
    n = HORIZON
    most = A_SHARE * params.plant_a_max_mps2 * TICK_S * TICK_S
    calm = params.plan_calm_s4 / TICK_S**4
    stiff = calm + RHO
    for k in range(n):
        a.plan_early[k] = 0
    factor(a, known, stiff)
    before = -v_mps * TICK_S  # the point before now, relative to now
    for k in range(n - 1):
        a.plan_u[k] = a.plan_u[k + 1]
        a.plan_y[k] = a.plan_y[k + 1]
    a.plan_u[n - 1] = a.plan_y[n - 1] = 0.0
    rounds = ROUNDS
    for i in range(EARLY_ROUNDS):
        if i >= rounds:
            break
        for k in range(n):
            # point k lies k + 1 ticks from now
            ground = a.plan_g_m[min(k + 1, n - 1)] + drop_m - z_m
            a.plan_z_m[k] = ground_weight(k, known) * ground
            if a.plan_early[k] != 0:
                a.plan_z_m[k] += EARLY_WEIGHT * a.plan_bound_m[k]
        for k in range(n):
            # difference k spans points k-2, k-1 and k; the point before point 0 is now, at 0
            r = RHO * (a.plan_u[k] - a.plan_y[k]) - (stiff * before if k == 0 else 0.0)
            a.plan_z_m[k] += r
            if k >= 1:
                a.plan_z_m[k - 1] -= 2.0 * r
            if k >= 2:
                a.plan_z_m[k - 2] += r
        solve(a)
        if find_early(a, known, drop_m, z_m) > 0:
            factor(a, known, stiff)
            rounds = EARLY_ROUNDS
        z2, z1 = before, 0.0
        for k in range(n):
            b = a.plan_z_m[k] - 2.0 * z1 + z2
            z2, z1 = z1, a.plan_z_m[k]
            u = min(max(b + a.plan_y[k], -most), most)
            a.plan_y[k] += b - u
            a.plan_u[k] = u
    note_foreseen(a, known, drop_m, z_m)
    # the clipped accelerations are feasible, the points only nearly
    return v_mps + (a.plan_u[0] + 0.5 * a.plan_u[1]) / TICK_S


@jit
def axis_after_tick(params: Any, tau_s: Any, z_m: Any, v_mps: Any, target_m: Any) -> Any:
    """Speed of the axis one tick from now with a set point."""
    dt = TICK_S / INVERT_STEPS
    dv = params.plant_a_max_mps2 * dt
    for _ in range(INVERT_STEPS):
        d = target_m - z_m
        most = min(params.plant_v_max_mps, abs(d) / dt)
        w = min(max(axis_speed(d, tau_s, params.plant_a_max_mps2), -most), most)
        v_mps += min(max(w - v_mps, -dv), dv)
        z_m += v_mps * dt
    return v_mps


@jit
def invert_axis(params: Any, tau_s: Any, z_m: Any, v_mps: Any, wanted_mps: Any) -> Any:
    """Set point with which the axis has a speed one tick from now (bisection; the axis is monotone in it)."""
    v = abs(wanted_mps)
    reach = v * tau_s + v * v / params.plant_a_max_mps2 + 0.01
    low, high = z_m - reach, z_m + reach
    for _ in range(INVERT_ROUNDS):
        middle = 0.5 * (low + high)
        if axis_after_tick(params, tau_s, z_m, v_mps, middle) < wanted_mps:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)
