"""Jerk-limited setpoint: limits on velocity, acceleration and jerk without overshoot.

Each cycle takes the greatest acceleration from which the setpoint can still be brought to rest at its
target. When it can reach the target in this cycle and stop in the next one, it does; the next cycle is taken
to be as short as the shortest one lately. Toward the surface the limits of velocity and acceleration are
multiplied by `toward_factor` until the setpoint has arrived for the first time, and just behind a fall of the
ground, which may be a slot.
"""

import math

from surffollow.forecast.quantities import MAX_GAP_NS, PAUSE_NS, SETTLED_SAMPLES
from surffollow.shm.jit import jit, jit_inlined
from surffollow.shm.layout_follow import RUN_DRYRUN

SHORT_CYCLE_S = 5e-4  # of a quick caller: the overshoot of shorter ones is small; the first cycle is as long


@jit
def stopping_distance(speed_mps, accel_mps2, a_max_mps2, jerk_mps3):
    """Distance until velocity and acceleration are zero, from a velocity ≥ 0 [m].

    Parameters
    ----------
    speed_mps : float64   velocity [m/s], ≥ 0
    accel_mps2 : float64  acceleration now [m/s²]
    a_max_mps2, jerk_mps3 : float64  limits of acceleration [m/s²] and jerk [m/s³]
    """
    t = abs(accel_mps2) / jerk_mps3
    cubic_m = jerk_mps3 * t * t * t / 6.0
    v = speed_mps + accel_mps2 * accel_mps2 / (2.0 * jerk_mps3)
    # first to zero acceleration; while braking, as if begun with zero acceleration earlier
    if accel_mps2 > 0.0:
        first = speed_mps * t + accel_mps2 * t * t / 2.0 - cubic_m
    else:
        first = cubic_m - v * t
    if v >= a_max_mps2 * a_max_mps2 / jerk_mps3:
        return first + 0.5 * v * (v / a_max_mps2 + a_max_mps2 / jerk_mps3)
    return first + v * math.sqrt(v / jerk_mps3)


@jit
def can_stop(e_m, v_mps, a_mps2, dt_s, v_max, a_max, jerk):
    """Whether a cycle at an acceleration leaves room to stop within `e_m` ≥ 0 and below `v_max`.

    Parameters
    ----------
    e_m, v_mps : float64          distance to go [m] and velocity [m/s] now, positive toward the target
    a_mps2 : float64              acceleration of the cycle [m/s²]
    dt_s : float64                length of the cycle [s]
    v_max, a_max, jerk : float64  limits [m/s, m/s², m/s³]
    """
    v = v_mps + a_mps2 * dt_s
    if a_mps2 > 0.0 and v + 0.5 * a_mps2 * (dt_s + a_mps2 / jerk) > v_max:
        return False
    towards_mps, a_mps2 = max(v, 0.0), a_mps2 if v > 0.0 else max(a_mps2, 0.0)
    return v * dt_s + stopping_distance(towards_mps, a_mps2, a_max, jerk) <= e_m


@jit_inlined
def next_acceleration(e_m, v_mps, a_mps2, dt_s, next_s, v_max, a_max, jerk):
    """Acceleration of the next cycle toward a target `e_m` ≥ 0 ahead [m/s²].

    Parameters
    ----------
    e_m, v_mps, a_mps2 : float64   distance to go, velocity and acceleration now, positive toward it
    dt_s : float64                 length of the cycle
    next_s : float64               shortest length of the next one
    v_max, a_max, jerk : float64   limits [m/s, m/s², m/s³]
    """
    change = jerk * dt_s
    low = min(max(a_mps2 - change, -a_max), a_mps2 + change)
    high = max(min(a_mps2 + change, a_max), a_mps2 - change)
    speed = e_m / dt_s
    land, brake, next_change = (speed - v_mps) / dt_s, speed / next_s, jerk * next_s
    stops = brake <= min(a_max, next_change) and brake + land <= next_change
    if low <= land <= high and speed <= v_max and stops:
        return land
    if can_stop(e_m, v_mps, high, dt_s, v_max, a_max, jerk):
        return high
    if not can_stop(e_m, v_mps, low, dt_s, v_max, a_max, jerk):
        return low
    for _ in range(8):  # resolution: 1/256 of the change that the jerk allows in a cycle
        middle = 0.5 * (low + high)
        if can_stop(e_m, v_mps, middle, dt_s, v_max, a_max, jerk):
            low = middle
        else:
            high = middle
    return low


@jit
def restart_pause_s(setpoint):
    """Pause after which a setpoint begins at the tool again [s]."""
    return max(PAUSE_NS * 1e-9, 3.0 * setpoint.interval_s)


@jit
def update_interval(setpoint, dt_s):
    """Update the usual and the shortest interval between calls."""
    if dt_s > setpoint.interval_s:
        setpoint.interval_s = min(dt_s, max(2.0 * setpoint.interval_s, MAX_GAP_NS * 1e-9))
    else:
        setpoint.interval_s += 0.2 * (dt_s - setpoint.interval_s)
    if setpoint.min_interval_s == 0.0 or dt_s < setpoint.min_interval_s:
        setpoint.min_interval_s = dt_s
    else:
        setpoint.min_interval_s += 0.002 * (dt_s - setpoint.min_interval_s)


@jit
def acceleration_limit(params, ratio):
    """Limit of the setpoint's acceleration; `ratio`: more of the axis' own one, for a plan [m/s²]."""
    return min(params.max_accel_mps2, ratio * 20.0 * params.plant_a_max_mps2)


@jit_inlined
def propagate_setpoint(params, adaptive, target_m, dt_s):
    """Move the setpoint for a time at one acceleration.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`setpoint` updated)
    target_m : float64  target of the setpoint [m]
    dt_s : float64      the time [s]
    """
    setpoint, gate = adaptive.setpoint, adaptive.gate
    e = target_m - setpoint.position_m
    direction = 1.0 if e >= 0.0 else -1.0
    # behind a confirmed fall of the ground slots and groups of them are so long
    may_be_slot = gate.step_m < 0.0 and gate.travel_since_step_m < 12.0 * params.step_travel_m
    gentle = e < 0.0 and (setpoint.approaching != 0 or may_be_slot)
    factor = params.toward_factor if gentle else 1.0
    # setpoints much quicker than the axis add effort only; those of a plan are farther ahead of it, so that
    # it responds sooner
    ratio = 1.0 + 2.0 * adaptive.preview.share
    v_max = min(params.max_speed_mps, ratio * 2.0 * params.plant_v_max_mps)
    a_max = acceleration_limit(params, ratio)
    ahead_m, v, a = direction * e, direction * setpoint.velocity_mps, direction * setpoint.acceleration_mps2
    v_max, a_max = factor * v_max, factor * a_max
    next_s = min(dt_s, max(setpoint.min_interval_s, SHORT_CYCLE_S))
    accel = next_acceleration(ahead_m, v, a, dt_s, next_s, v_max, a_max, params.max_jerk_mps3)
    setpoint.acceleration_mps2 = direction * accel
    setpoint.velocity_mps += setpoint.acceleration_mps2 * dt_s
    setpoint.position_m += setpoint.velocity_mps * dt_s
    # on its target but for rounding
    if abs(target_m - setpoint.position_m) < 1e-5 and adaptive.estimate.samples >= SETTLED_SAMPLES:
        setpoint.approaching = 0


@jit_inlined
def limit_setpoint(params, adaptive, now_ns, target_m, tool_z_m):
    """Move the setpoint toward its target within the limits; after a pause it begins at the tool.

    It begins there, too, when a limit falls: velocity and acceleration that the limits of before allowed
    cannot be stopped within those in force.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (updated)
    now_ns : int64
    target_m : float64  target of the setpoint [m]
    tool_z_m : float64  height of the tool in the newest pose reported [m]
    """
    setpoint = adaptive.setpoint
    setpoint.in_dryrun = 1 if params.run == RUN_DRYRUN else 0
    pause, dt = setpoint.t_ns == 0, (now_ns - setpoint.t_ns) * 1e-9
    if not pause:
        if dt <= 0.0:
            return
        pause = dt > restart_pause_s(setpoint)
        update_interval(setpoint, dt)
    setpoint.t_ns = now_ns
    accel_mps2, jerk_mps3 = acceleration_limit(params, 1.0), params.max_jerk_mps3
    fallen = accel_mps2 < setpoint.max_accel_mps2 or jerk_mps3 < setpoint.max_jerk_mps3
    setpoint.max_accel_mps2, setpoint.max_jerk_mps3 = accel_mps2, jerk_mps3
    if fallen or pause:
        # where a limit fell with the motion of the tool, which its axis can stop; none toward the surface
        rate_mps = 0.0 if pause else max(adaptive.kinematics.climb_mps, 0.0)
        setpoint.position_m = tool_z_m + rate_mps * adaptive.plant.tau_s
        setpoint.velocity_mps, setpoint.acceleration_mps2 = rate_mps, 0.0
    if pause:
        setpoint.approaching, dt = 1, SHORT_CYCLE_S
    longest_s = 0.02  # a longer cycle moves the setpoint no farther, unless all are long
    dt = min(dt, longest_s) if dt <= PAUSE_NS * 1e-9 else dt
    steps = math.ceil(dt / longest_s)
    for _ in range(steps):
        propagate_setpoint(params, adaptive, target_m, dt / steps)


@jit
def release_setpoint(setpoint):
    """Begin at the tool with the next setpoint."""
    setpoint.t_ns = 0
