"""Finite-horizon MPC of the axis over known ground: constrained least squares with a receding horizon.

Every controller period a quadratic programme (`preview_programme`) plans the axis over the next 40 periods.
The setpoint makes the axis model reach the first planned position. The planned velocity counts as well,
because position alone rings while the acceleration is limited.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.benchmark.preview_programme import (
    ACCEL_PENALTY,
    BOUND,
    FREE,
    HEAD,
    HISTORY_MS,
    HISTORY_Z,
    PERIODS,
    PLAN,
    REF,
    REPORTS,
    SPEED_PENALTY,
    STARTED,
    TICKS,
    V,
    Z,
    factor,
    solve,
)
from surffollow.shm.jit import jit
from surffollow.sim.plant import axis_step

HISTORY = 32  # controller periods of which the model's position is kept
CORRECTION = 0.1  # share of the difference between report and model that is taken over
BISECTIONS = 20
VELOCITY_SHARE = 0.5  # of a period: so much of the planned velocity is matched with the planned position
STEP_S = 1e-3  # of the simulated axis


@jit
def _distance(v_mps: float, tau_s: float, a_max_mps2: float) -> float:
    """Distance to the setpoint at which the sqrt controller demands this velocity [m]."""
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
def _move(g: NDArray[Any], axis: NDArray[Any], setpoint_m: float, s: Any) -> None:
    """Put into `axis` where the model is after one period with this setpoint."""
    axis[0], axis[1] = g[HEAD, Z], g[HEAD, V]
    for _ in range(s.tick_ms):
        axis_step(axis, setpoint_m, s.tau_s, s.v_max_mps, s.a_max_mps2, STEP_S)


@jit
def _correct(g: NDArray[Any], report_ms: float, report_z_m: float) -> None:
    """Let the model take over a share of its difference to a new report."""
    count = int(g[HEAD, TICKS])
    here, ms = g[HEAD, Z], 0.0
    for back in range(1, min(count, HISTORY) + 1):
        i = (count - back) % HISTORY
        earlier = g[HISTORY_MS, i]
        if earlier <= report_ms:
            model = g[HISTORY_Z, i]
            if back > 1 and ms > earlier:
                model += (report_ms - earlier) / (ms - earlier) * (here - model)
            by = CORRECTION * (report_z_m - model)
            g[HEAD, Z] += by
            for k in range(HISTORY):
                g[HISTORY_Z, k] += by
            return
        ms, here = earlier, g[HISTORY_Z, i]


@jit
def setpoint(
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
    head = g[HEAD]
    period_s = s.tick_ms * STEP_S
    effort = effort_s4 / period_s**4
    if head[STARTED] == 0.0:
        head[STARTED], head[Z], head[V] = 1.0, report_z_m, 0.0
        factor(g[FREE : FREE + 3], 0.0, effort)
        factor(g[BOUND : BOUND + 3], SPEED_PENALTY, effort + ACCEL_PENALTY)
    elif reports > head[REPORTS]:
        _correct(g, report_ms, report_z_m)
    head[REPORTS] = reports
    i = int(head[TICKS]) % HISTORY
    g[HISTORY_MS, i], g[HISTORY_Z, i] = s.ms, head[Z]
    head[TICKS] += 1.0
    for k in range(PERIODS):
        g[REF, k] -= head[Z]
    v_step, a_step = s.v_max_mps * period_s, s.a_max_mps2 * period_s * period_s
    solve(g, head[V] * period_s, effort, v_step, a_step)
    blend_s = VELOCITY_SHARE * period_s
    goal = head[Z] + g[PLAN, 0] + blend_s * 0.5 * g[PLAN, 1] / period_s
    # no setpoint outside of these changes what the axis can do within the period
    low, high = _reach(head[Z], head[V], -1.0, s), _reach(head[Z], head[V], 1.0, s)
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
    head[Z], head[V] = axis[0], axis[1]
    return float(best)
