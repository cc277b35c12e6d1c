"""Model of the controlled axis: proportional, square-root profile, bounded velocity and acceleration."""

import math

from surffollow.shm.jit import jit, jit_inlined

# of an axis model: beyond, another controller leads the robot; of a height between two reports
MAX_MODEL_ERROR_M = 5e-4
PERIOD_S = 0.01  # of the plan: one controller period
LONG_TAUS = 0.5  # of the axis' time constant: a longer time is long for it
AXIS_STEP_NS = 2_000_000  # of all axis models
MAX_AXIS_GAP_NS = 250_000_000  # after a longer gap the axes are set to their setpoints


@jit
def is_long(time, tau):
    """Whether a time is long for the axis: what comes behind it is late."""
    return time > LONG_TAUS * tau


@jit_inlined
def axis_velocity(distance_m, tau_s, a_max_mps2):
    """Velocity at which the axis approaches its setpoint: proportional, then square root [m/s]."""
    d, linear = abs(distance_m), a_max_mps2 * tau_s * tau_s
    speed_mps = math.sqrt(2.0 * a_max_mps2 * (d - 0.5 * linear)) if d > linear else d * (1.0 / tau_s)
    return math.copysign(speed_mps, distance_m)


@jit_inlined
def step_axis(tau_s, v_max_mps, a_max_mps2, z_m, v_mps, target_m, dt_s):
    """Position and velocity of the axis after a time step toward its setpoint [m, m/s].

    Parameters
    ----------
    tau_s : float64       time constant [s]
    v_max_mps, a_max_mps2 : float64  limits of velocity [m/s] and acceleration [m/s²]
    z_m, v_mps : float64  position [m] and velocity [m/s] now
    target_m : float64    setpoint [m]
    dt_s : float64        length of the step [s], > 0
    """
    d = target_m - z_m
    limit = min(v_max_mps, abs(d) * (1.0 / dt_s))
    w = min(max(axis_velocity(d, tau_s, a_max_mps2), -limit), limit)
    dv = a_max_mps2 * dt_s
    v_mps += min(max(w - v_mps, -dv), dv)
    return z_m + v_mps * dt_s, v_mps


@jit
def time_steps(from_ns, to_ns):
    """Number of time steps between two times, and their span [ns], MAX_AXIS_GAP_NS at most."""
    span_ns = min(to_ns - from_ns, MAX_AXIS_GAP_NS)
    return (span_ns + AXIS_STEP_NS - 1) // AXIS_STEP_NS, span_ns


@jit
def position_ahead(params, tau_s, z_m, v_mps, target_m, hold_s):
    """Position of the axis one period of a plan behind a time in which a setpoint is held [m].

    Parameters
    ----------
    params : record of `Params`
    tau_s : float64       time constant [s]
    z_m, v_mps : float64  position [m] and velocity [m/s] now
    target_m : float64    the setpoint [m]
    hold_s : float64      the time [s]; behind it the velocity is constant
    """
    v_max, a_max, steps = params.plant_v_max_mps, params.plant_a_max_mps2, int(PERIOD_S * 1e9) // AXIS_STEP_NS
    for _ in range(steps):
        z_m, v_mps = step_axis(tau_s, v_max, a_max, z_m, v_mps, target_m, hold_s / steps)
    return z_m + v_mps * PERIOD_S


@jit
def invert_axis(params, tau_s, z_m, v_mps, desired_m, hold_s):
    """Setpoint with which `position_ahead` is the desired one [m].

    Bisection: that position is monotone in the setpoint. One that the axis does not attain would give a
    setpoint at the end of the interval searched; the next attainable one is taken instead.

    Parameters
    ----------
    params, tau_s, z_m, v_mps, hold_s : as in `position_ahead`
    desired_m : float64  the position [m]
    """
    v_mps = min(max(v_mps, -params.plant_v_max_mps), params.plant_v_max_mps)  # of an estimate it may be more
    v = abs(v_mps) + params.plant_a_max_mps2 * hold_s  # the greatest that a setpoint can give
    reach = v * tau_s + v * v / params.plant_a_max_mps2 + 0.01
    low, high = z_m - reach, z_m + reach
    lowest_m = position_ahead(params, tau_s, z_m, v_mps, low, hold_s)
    highest_m = position_ahead(params, tau_s, z_m, v_mps, high, hold_s)
    rest_m = (1.0 - 0.999) * (highest_m - lowest_m)  # for rounding
    desired_m = min(max(desired_m, lowest_m + rest_m), highest_m - rest_m)
    for _ in range(24):  # resolution: 6e-8 of the interval searched
        middle = 0.5 * (low + high)
        if position_ahead(params, tau_s, z_m, v_mps, middle, hold_s) < desired_m:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)
