"""Shadow axes: a simulated copy of the controlled axis per model, driven by its setpoints."""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.estimation.model_bank import N_MODELS
from surffollow.forecast.plant.axis_model import step_axis
from surffollow.forecast.plant.controller_clock import oldest_period, period_at
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_estimation import MAX_MODELS, N_PERIODS

AXIS_STEP_NS = 2_000_000  # of the shadow axes
MAX_AXIS_STEPS = 32  # bounds the work per sample
MIN_TAU_S = 1e-3  # below, the steps would be too long for the axis
MAX_AXIS_GAP_NS = 250_000_000  # after a longer gap the axes are set to their setpoints
EFFORT_RATE = 0.02  # per controller period
EFFORT_UNIT = 1.0  # (1 m/s²)²
MAX_EFFORT = 100.0  # (10 m/s²)²: bounds the memory of a step
PERIOD_RATE_HZ2 = 1e4  # squared rate of the controller, 100 Hz


@jit
def reset_shadows(shadow: Any, z_m: Any) -> None:
    """Put every shadow axis to rest at a height."""
    for i in range(N_MODELS):
        shadow.position_m[i] = z_m
        shadow.velocity_mps[i] = 0.0


@jit
def propagate_shadows(params: Any, adaptive: Any, from_ns: Any, to_ns: Any) -> None:
    """Propagate every shadow axis with the setpoints of its model.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`shadow` updated)
    from_ns, to_ns : int64  begin and end of the time; without a positive length nothing moves
    """
    shadow, controller = adaptive.shadow, adaptive.controller
    span = to_ns - from_ns
    if controller.periods == 0 or span <= 0:
        return
    if span > MAX_AXIS_GAP_NS:
        slot = (controller.periods - 1) & (N_PERIODS - 1)
        for i in range(N_MODELS):
            shadow.position_m[i] = shadow.setpoint_m[slot * MAX_MODELS + i]
            shadow.velocity_mps[i] = 0.0
        return
    steps = min(max((span + AXIS_STEP_NS - 1) // AXIS_STEP_NS, 1), MAX_AXIS_STEPS)
    dt = span * 1e-9 / steps
    tau, v_max, a_max = max(adaptive.plant.tau_s, MIN_TAU_S), params.plant_v_max_mps, params.plant_a_max_mps2
    k = oldest_period(controller)
    for j in range(steps):
        k = period_at(controller, k, from_ns + (span * j) // steps)
        first = (k & (N_PERIODS - 1)) * MAX_MODELS
        for i in range(N_MODELS):
            target = shadow.setpoint_m[first + i]
            shadow.position_m[i], shadow.velocity_mps[i] = step_axis(
                tau, v_max, a_max, shadow.position_m[i], shadow.velocity_mps[i], target, dt
            )


@jit
def update_effort(adaptive: Any) -> None:
    """Update the effort with the setpoints of the period that has just been recorded."""
    shadow, controller = adaptive.shadow, adaptive.controller
    n = controller.periods
    now, one = MAX_MODELS * (n & (N_PERIODS - 1)), MAX_MODELS * ((n - 1) & (N_PERIODS - 1))
    two = MAX_MODELS * ((n - 2) & (N_PERIODS - 1))
    if n > 1:
        for i in range(N_MODELS):
            accel = PERIOD_RATE_HZ2 * (
                shadow.setpoint_m[now + i] - 2.0 * shadow.setpoint_m[one + i] + shadow.setpoint_m[two + i]
            )
            shadow.effort[i] += EFFORT_RATE * (min(accel * accel, MAX_EFFORT) - shadow.effort[i])
            shadow.log_effort[i] = math.log(shadow.effort[i] / EFFORT_UNIT + 1.0)


@jit
def record_setpoints(adaptive: Any) -> None:
    """Record the newest setpoints of all models for the period that begins, and update the effort."""
    shadow = adaptive.shadow
    first = (adaptive.controller.periods & (N_PERIODS - 1)) * MAX_MODELS
    for i in range(N_MODELS):
        shadow.setpoint_m[first + i] = adaptive.blend.model_m[i]
    update_effort(adaptive)


@jit
def reset_effort(shadow: Any) -> None:
    """Set the mean squared acceleration of all setpoints to zero."""
    for i in range(N_MODELS):
        shadow.effort[i] = shadow.log_effort[i] = 0.0
