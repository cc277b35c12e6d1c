"""Finite-horizon MPC of the axis over known ground: constrained least squares with a receding horizon.

Every controller period a quadratic programme plans the axis over the next 40 periods:

    min ½ Σ (z_k − r_k)² + ½ (effort/T⁴) Σ a_k²,  |z_k − z_(k−1)| ≤ v_max T,  |a_k| ≤ a_max T²

with a_k = z_k − 2 z_(k−1) + z_(k−2). When the unconstrained optimum respects the limits it is the plan; else
ADMM goes on from the duals of the period before. The setpoint makes the axis model reach the first planned
position; its velocity counts as well, because position alone rings while the acceleration is limited.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.shm.jit import jit
from surffollow.sim.plant import axis_step

PERIODS = 40
ITERATIONS = 25
RELAXATION = 1.6
SPEED_PENALTY, ACCEL_PENALTY = 1.0, 4.0  # of ADMM, relative to the squared error
HISTORY = 32  # controller periods of which the model's position is kept
CORRECTION = 0.1  # share of the difference between report and model that is taken over
BISECTIONS = 20
VELOCITY_SHARE = 0.5  # of a period: so much of the planned velocity is matched with the planned position
STEP_S = 1e-3  # of the simulated axis

# rows of the state
_HEAD, _PLAN, _REF, _SPEED, _SPEED_DUAL, _ACCEL, _ACCEL_DUAL, _RHS = range(8)
_FREE, _BOUND = 8, 11  # three rows of factors each: without and with the penalties of the limits
_HISTORY_MS, _HISTORY_Z = 14, 15
ROWS = 16
# head
_Z, _V, _STARTED, _REPORTS, _TICKS, _WARM = range(6)


def new_planner() -> NDArray[np.float64]:
    """Return the state of a planner that has planned nothing."""
    return np.zeros((ROWS, PERIODS))


@jit
def _factor(band: NDArray[Any], speed_weight: float, accel_weight: float) -> None:
    """LDLᵀ of I + speed_weight·D1ᵀD1 + accel_weight·D2ᵀD2, pentadiagonal; both start at known positions."""
    n = PERIODS
    for k in range(n):
        band[0, k], band[1, k], band[2, k] = 1.0, 0.0, 0.0
    for k in range(n):  # row k of D1: z_k − z_(k−1); of D2: z_k − 2 z_(k−1) + z_(k−2)
        band[0, k] += speed_weight + accel_weight
        if k >= 1:
            band[0, k - 1] += speed_weight + 4.0 * accel_weight
            band[1, k - 1] -= speed_weight + 2.0 * accel_weight
        if k >= 2:
            band[0, k - 2] += accel_weight
            band[1, k - 2] -= 2.0 * accel_weight
            band[2, k - 2] += accel_weight
    for k in range(n):
        d = band[0, k]
        l1, l2 = band[1, k] / d, band[2, k] / d
        if k + 1 < n:
            band[0, k + 1] -= l1 * band[1, k]
            band[1, k + 1] -= l1 * band[2, k]
        if k + 2 < n:
            band[0, k + 2] -= l2 * band[2, k]
        band[1, k], band[2, k] = l1, l2


@jit
def _solve(band: NDArray[Any], b: NDArray[Any]) -> None:
    """Solve with the factors of `_factor`, in place."""
    n = PERIODS
    for k in range(n - 1):
        b[k + 1] -= band[1, k] * b[k]
        if k + 2 < n:
            b[k + 2] -= band[2, k] * b[k]
    for k in range(n):
        b[k] /= band[0, k]
    for k in range(n - 2, -1, -1):
        b[k] -= band[1, k] * b[k + 1]
        if k + 2 < n:
            b[k] -= band[2, k] * b[k + 2]


@jit
def _speed(z: NDArray[Any], k: int) -> float:
    """First difference of a plan that begins at 0."""
    return float(z[k] - (z[k - 1] if k >= 1 else 0.0))


@jit
def _accel(z: NDArray[Any], k: int, step_m: float) -> float:
    """Second difference of a plan that begins at 0, with the last step before it."""
    before = z[k - 1] if k >= 1 else 0.0
    two = z[k - 2] if k >= 2 else (0.0 if k == 1 else -step_m)
    return float(z[k] - 2.0 * before + two)


@jit
def _add_speed(b: NDArray[Any], k: int, value: float) -> None:
    """b += D1ᵀ of an entry."""
    b[k] += value
    if k >= 1:
        b[k - 1] -= value


@jit
def _add_accel(b: NDArray[Any], k: int, value: float) -> None:
    """b += D2ᵀ of an entry."""
    b[k] += value
    if k >= 1:
        b[k - 1] -= 2.0 * value
    if k >= 2:
        b[k - 2] += value


@jit
def _known_accel(k: int, step_m: float) -> float:
    """What the known positions contribute to the second difference."""
    return step_m if k == 0 else 0.0


@jit
def solve(g: NDArray[Any], step_m: float, effort: float, v_step_m: float, a_step_m: float) -> int:
    """Plan from position 0 and the last step over the reference in row `_REF`.

    Parameters
    ----------
    g : state of a planner
    step_m : what the axis would move in one period at its present speed [m]
    effort : weight of the squared second difference
    v_step_m, a_step_m : limits of first and second difference [m]

    Returns
    -------
    int64 iterations of ADMM
    """
    n = PERIODS
    z, ref = g[_PLAN], g[_REF]
    for k in range(n):
        z[k] = ref[k]
    _add_accel(z, 0, effort * step_m)
    _solve(g[_FREE : _FREE + 3], z)
    free = True
    for k in range(n):
        a_max = 0.5 * a_step_m if k == 0 else a_step_m
        if abs(_speed(z, k)) > v_step_m or abs(_accel(z, k, step_m)) > a_max:
            free = False
            break
    if free:
        g[_HEAD, _WARM] = 0.0
        return 0
    speed, speed_dual, accel, accel_dual = g[_SPEED], g[_SPEED_DUAL], g[_ACCEL], g[_ACCEL_DUAL]
    for k in range(n):
        if g[_HEAD, _WARM] == 0.0 or k == n - 1:
            speed_dual[k], accel_dual[k] = 0.0, 0.0
            speed[k] = min(max(_speed(z, k), -v_step_m), v_step_m)
            accel[k] = min(max(_accel(z, k, step_m), -a_step_m), a_step_m)
        else:
            speed_dual[k], accel_dual[k] = speed_dual[k + 1], accel_dual[k + 1]
            speed[k], accel[k] = speed[k + 1], accel[k + 1]
    g[_HEAD, _WARM] = 1.0
    b = g[_RHS]
    for _ in range(ITERATIONS):
        for k in range(n):
            b[k] = ref[k]
        _add_accel(b, 0, effort * step_m)
        for k in range(n):
            _add_speed(b, k, SPEED_PENALTY * (speed[k] - speed_dual[k]))
            known = _known_accel(k, step_m)
            _add_accel(b, k, ACCEL_PENALTY * (accel[k] - accel_dual[k] + known))
        _solve(g[_BOUND : _BOUND + 3], b)
        for k in range(n):
            z[k] = b[k]
        for k in range(n):
            s = RELAXATION * _speed(z, k) + (1.0 - RELAXATION) * speed[k] + speed_dual[k]
            speed[k] = min(max(s, -v_step_m), v_step_m)
            speed_dual[k] = s - speed[k]
            a_max = 0.5 * a_step_m if k == 0 else a_step_m
            a = RELAXATION * _accel(z, k, step_m) + (1.0 - RELAXATION) * accel[k] + accel_dual[k]
            accel[k] = min(max(a, -a_max), a_max)
            accel_dual[k] = a - accel[k]
    return ITERATIONS


@jit
def _distance(v_mps: float, tau_s: float, a_max_mps2: float) -> float:
    """Distance to the setpoint at which the sqrt controller wants this velocity [m]."""
    linear_m = a_max_mps2 * tau_s * tau_s
    if abs(v_mps) <= linear_m / tau_s:
        return float(v_mps * tau_s)
    return math.copysign(0.5 * (v_mps * v_mps / a_max_mps2 + linear_m), v_mps)


@jit
def _reach(z_m: float, v_mps: float, sign: float, s: Any) -> float:
    """Setpoint at which the axis accelerates with all it has for one period, upward or downward [m]."""
    period_s = s.tick_ms * STEP_S
    v = v_mps + sign * s.a_max_mps2 * period_s
    v = min(max(v, -s.v_max_mps), s.v_max_mps)
    return float(z_m + 0.5 * (v_mps + v) * period_s + _distance(v, s.tau_s, s.a_max_mps2))


@jit
def _move(g: NDArray[Any], axis: NDArray[Any], set_point_m: float, s: Any) -> None:
    """Put into `axis` where the model is after one period with this setpoint."""
    axis[0], axis[1] = g[_HEAD, _Z], g[_HEAD, _V]
    for _ in range(s.tick_ms):
        axis_step(axis, set_point_m, s.tau_s, s.v_max_mps, s.a_max_mps2, STEP_S)


@jit
def _correct(g: NDArray[Any], report_ms: float, report_z_m: float) -> None:
    """Let the model take over a share of its difference to a new report."""
    count = int(g[_HEAD, _TICKS])
    here, ms = g[_HEAD, _Z], 0.0
    for back in range(1, min(count, HISTORY) + 1):
        i = (count - back) % HISTORY
        earlier = g[_HISTORY_MS, i]
        if earlier <= report_ms:
            model = g[_HISTORY_Z, i]
            if back > 1 and ms > earlier:
                model += (report_ms - earlier) / (ms - earlier) * (here - model)
            by = CORRECTION * (report_z_m - model)
            g[_HEAD, _Z] += by
            for k in range(HISTORY):
                g[_HISTORY_Z, k] += by
            return
        ms, here = earlier, g[_HISTORY_Z, i]


@jit
def set_point(
    g: NDArray[Any], effort_s4: float, reports: int, report_ms: float, report_z_m: float, s: Any
) -> float:
    """Setpoint of this controller period [m].

    Parameters
    ----------
    g : state of a planner; row `reference(g)` holds where the axis should be at the end of the next periods
    effort_s4 : weight of the squared acceleration against the squared error [s⁴]
    reports, report_ms, report_z_m : how many reports came, timestamp and height of the newest
    s : the run, for the axis and the time
    """
    head = g[_HEAD]
    period_s = s.tick_ms * STEP_S
    effort = effort_s4 / period_s**4
    if head[_STARTED] == 0.0:
        head[_STARTED], head[_Z], head[_V] = 1.0, report_z_m, 0.0
        _factor(g[_FREE : _FREE + 3], 0.0, effort)
        _factor(g[_BOUND : _BOUND + 3], SPEED_PENALTY, effort + ACCEL_PENALTY)
    elif reports > head[_REPORTS]:
        _correct(g, report_ms, report_z_m)
    head[_REPORTS] = reports
    i = int(head[_TICKS]) % HISTORY
    g[_HISTORY_MS, i], g[_HISTORY_Z, i] = s.ms, head[_Z]
    head[_TICKS] += 1.0
    for k in range(PERIODS):
        g[_REF, k] -= head[_Z]
    v_step, a_step = s.v_max_mps * period_s, s.a_max_mps2 * period_s * period_s
    solve(g, head[_V] * period_s, effort, v_step, a_step)
    blend_s = VELOCITY_SHARE * period_s
    goal = head[_Z] + g[_PLAN, 0] + blend_s * 0.5 * g[_PLAN, 1] / period_s
    # no setpoint outside of these changes what the axis can do within the period
    low, high = _reach(head[_Z], head[_V], -1.0, s), _reach(head[_Z], head[_V], 1.0, s)
    axis = np.empty(2)
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        _move(g, axis, middle, s)
        if axis[0] + blend_s * axis[1] < goal:
            low = middle
        else:
            high = middle
    best = 0.5 * (low + high)
    _move(g, axis, best, s)
    head[_Z], head[_V] = axis[0], axis[1]
    return float(best)


@jit
def reference(g: NDArray[Any]) -> NDArray[Any]:
    """Row to be filled with wanted positions at the end of the next periods [m]."""
    row: NDArray[Any] = g[_REF]
    return row


@jit
def smoothed(seen: NDArray[Any], first: int, count: int, x_m: float, width_m: float) -> tuple[float, int]:
    """Height at x by a local line through the readings within ±width, triangular weights.

    Parameters
    ----------
    seen : (n, 2) float64, place and height of readings along the path [m]
    first, count : search from here; so many there are
    x_m, width_m : [m]

    Returns
    -------
    (float64, int64) height [m], where to search from for a greater x
    """
    while first < count - 1 and seen[first, 0] < x_m - width_m:
        first += 1
    w0 = w1 = w2 = h0 = h1 = 0.0
    i = first
    n = 0
    while i < count and seen[i, 0] <= x_m + width_m:
        d = seen[i, 0] - x_m
        w = 1.0 - abs(d) / width_m
        if w > 0.0:
            w0 += w
            w1 += w * d
            w2 += w * d * d
            h0 += w * seen[i, 1]
            h1 += w * d * seen[i, 1]
            n += 1
        i += 1
    det = w0 * w2 - w1 * w1
    if n >= 3 and det > 1e-3 * w0 * w0 * width_m * width_m:
        return (w2 * h0 - w1 * h1) / det, first
    if n >= 1:
        return h0 / w0, first
    j = min(max(i, 1), count - 1)  # a gap: linear between its ends
    if count < 2 or x_m <= seen[j - 1, 0] or seen[j, 0] <= seen[j - 1, 0]:
        return float(seen[max(j - 1, 0), 1]), first
    share = min((x_m - seen[j - 1, 0]) / (seen[j, 0] - seen[j - 1, 0]), 1.0)
    return float(seen[j - 1, 1] + share * (seen[j, 1] - seen[j - 1, 1])), first
