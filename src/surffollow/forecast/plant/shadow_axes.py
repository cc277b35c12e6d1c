"""Shadow axes: simulated copies of the controlled axis, driven by the setpoints of the models.

A model that may lead less has two: with its lead and without it (`estimation.setpoint_lead`).
"""

from surffollow.forecast.plant import axis_model
from surffollow.forecast.pose import newest_until
from surffollow.forecast.quantities import QUICK_RATE
from surffollow.forecast.sensing.kinematics import is_at_rest
from surffollow.shm.jit import jit, jit_inlined
from surffollow.shm.layout_adaptive_estimation import N_AXES, N_MODELS, N_PERIODS

# of a sensor that trails: half the setpoints kept, the others are for its latency
MAX_LAG_S = 0.5 * N_PERIODS * axis_model.PERIOD_S


@jit
def compared_lag_s(adaptive):
    """Time from the tool over a footprint to its sample when the sensor trails, MAX_LAG_S at most [s].

    At rest it is 0: the path is time there, and the tool was never over the footprint.
    """
    if is_at_rest(adaptive.kinematics):
        return 0.0
    return min(max(-adaptive.sample.lead_m, 0.0) / adaptive.kinematics.speed_mps, MAX_LAG_S)


@jit
def reset_shadows(shadow, t_ns, z_m):
    """Put every shadow axis to rest at a height, at a time."""
    shadow.t_ns = t_ns
    shadow.position_m[:] = z_m
    shadow.velocity_mps[:] = 0.0


@jit_inlined
def propagate_shadows(params, adaptive, t_ns):
    """Propagate every shadow axis up to a time with its setpoints; whether that is possible.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`shadow` updated)
    t_ns : int64  the time; not possible before that of the axes
    """
    shadow, controller, from_ns = adaptive.shadow, adaptive.controller, adaptive.shadow.t_ns
    z, v = shadow.position_m, shadow.velocity_mps
    span = t_ns - from_ns
    if span <= 0:
        return False
    shadow.t_ns = t_ns
    if controller.periods == 0:
        return True
    if span > axis_model.MAX_AXIS_GAP_NS:
        slot = newest_until(controller.latch_ns, controller.periods, t_ns) & (N_PERIODS - 1)
        for i in range(N_AXES):
            z[i], v[i] = shadow.setpoint_m[slot * N_AXES + i], 0.0
        return True
    steps = min(axis_model.time_steps(from_ns, t_ns)[0], 32)  # bounds the work per sample
    dt = span * 1e-9 / steps
    # with a smaller τ the steps would be too long for the axis
    tau, v_max, a_max = max(adaptive.plant.tau_s, 1e-3), params.plant_v_max_mps, params.plant_a_max_mps2
    for j in range(steps):
        k = newest_until(controller.latch_ns, controller.periods, from_ns + (span * j) // steps)
        first = (k & (N_PERIODS - 1)) * N_AXES
        for i in range(N_AXES):
            target = shadow.setpoint_m[first + i]
            z[i], v[i] = axis_model.step_axis(tau, v_max, a_max, z[i], v[i], target, dt)
    return True


@jit
def record_setpoints(adaptive):
    """Record the newest setpoints of all axes for the period that begins, and update the effort."""
    shadow, newest_m, before_m = adaptive.shadow, adaptive.blend.model_m, adaptive.shadow.before_m
    first = (adaptive.controller.periods & (N_PERIODS - 1)) * N_AXES
    for i in range(N_AXES):
        shadow.setpoint_m[first + i] = adaptive.blend.axis_m[i]
    for i in range(N_MODELS):
        one_m, two_m = before_m[i], before_m[N_MODELS + i]
        if adaptive.controller.periods > 1:
            accel = 1.0 / axis_model.PERIOD_S**2 * (newest_m[i] - 2.0 * one_m + two_m)
            # (10 m/s²)² bounds the memory of a step
            shadow.effort[i] += QUICK_RATE * (min(accel * accel, 100.0) - shadow.effort[i])
        before_m[i], before_m[N_MODELS + i] = newest_m[i], one_m
