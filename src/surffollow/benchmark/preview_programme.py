"""Constrained least squares over a horizon: the quadratic programme of the preview planner.

    min ½ Σ (z_k − r_k)² + ½ (effort/T⁴) Σ a_k²,  |z_k − z_(k−1)| ≤ v_max T,  |a_k| ≤ a_max T²

with a_k = z_k − 2 z_(k−1) + z_(k−2). When the unconstrained optimum respects the limits it is the plan;
otherwise ADMM continues from the duals of the period before.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.benchmark.pentadiagonal import factorise, solve_factors
from surffollow.shm.jit import jit

PERIODS = 40
ITERATIONS = 25
RELAXATION = 1.6
SPEED_PENALTY, ACCEL_PENALTY = 1.0, 4.0  # of ADMM, relative to the squared error

# rows of a planner's state
HEAD, PLAN, REF, _SPEED, _SPEED_DUAL, _ACCEL, _ACCEL_DUAL, _RHS = range(8)
FREE, BOUND = 8, 11  # three rows of factors each: without and with the penalties of the limits
HISTORY_MS, HISTORY_Z = 14, 15
ROWS = 16
# entries of row HEAD; the programme uses WARM alone
Z, V, STARTED, REPORTS, TICKS, WARM = range(6)


def new_planner() -> NDArray[np.float64]:
    """Return the state of a planner that has planned nothing."""
    return np.zeros((ROWS, PERIODS))


@jit
def reference(g: NDArray[Any]) -> NDArray[Any]:
    """Row to be filled with desired positions at the end of the next periods [m]."""
    row: NDArray[Any] = g[REF]
    return row


@jit
def factor(band: NDArray[Any], speed_weight: float, accel_weight: float) -> None:
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
    factorise(band)


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
    """Contribution of the known positions to the second difference."""
    return step_m if k == 0 else 0.0


@jit
def solve(g: NDArray[Any], step_m: float, effort: float, v_step_m: float, a_step_m: float) -> int:
    """Plan from position 0 and the last step over the reference in row `REF`.

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
    z, ref = g[PLAN], g[REF]
    for k in range(n):
        z[k] = ref[k]
    _add_accel(z, 0, effort * step_m)
    solve_factors(g[FREE : FREE + 3], z)
    free = True
    for k in range(n):
        a_max = 0.5 * a_step_m if k == 0 else a_step_m
        if abs(_speed(z, k)) > v_step_m or abs(_accel(z, k, step_m)) > a_max:
            free = False
            break
    if free:
        g[HEAD, WARM] = 0.0
        return 0
    speed, speed_dual, accel, accel_dual = g[_SPEED], g[_SPEED_DUAL], g[_ACCEL], g[_ACCEL_DUAL]
    for k in range(n):
        if g[HEAD, WARM] == 0.0 or k == n - 1:
            speed_dual[k], accel_dual[k] = 0.0, 0.0
            speed[k] = min(max(_speed(z, k), -v_step_m), v_step_m)
            accel[k] = min(max(_accel(z, k, step_m), -a_step_m), a_step_m)
        else:
            speed_dual[k], accel_dual[k] = speed_dual[k + 1], accel_dual[k + 1]
            speed[k], accel[k] = speed[k + 1], accel[k + 1]
    g[HEAD, WARM] = 1.0
    b = g[_RHS]
    for _ in range(ITERATIONS):
        for k in range(n):
            b[k] = ref[k]
        _add_accel(b, 0, effort * step_m)
        for k in range(n):
            _add_speed(b, k, SPEED_PENALTY * (speed[k] - speed_dual[k]))
            known = _known_accel(k, step_m)
            _add_accel(b, k, ACCEL_PENALTY * (accel[k] - accel_dual[k] + known))
        solve_factors(g[BOUND : BOUND + 3], b)
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
