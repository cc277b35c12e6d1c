"""Lead the set point within limits of speed, acceleration and jerk, without ever overshooting for them.

Each cycle takes the greatest acceleration from which the set point can still be brought to rest at the
wanted height; when it can land on that height in this cycle and stop in the next, it does. Toward the
surface speed and acceleration are `toward_factor` of those away from it.
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit

PAUSE_NS = 100_000_000  # a set point not renewed for so long starts anew at the tool
FIRST_NS = 1_000_000  # the cycle assumed before the first
LONGEST_S = 0.02  # a cycle that took longer moves the set point no farther
ROUNDS = 8  # of bisection: 1/256 of what the jerk allows in a cycle


@njit(cache=True, nogil=True)
def way_to_rest(speed_mps: Any, accel_mps2: Any, a_max_mps2: Any, jerk_mps3: Any) -> Any:
    """Way until speed and acceleration are zero, from a speed ≥ 0, by the quickest braking [m]."""
    t = abs(accel_mps2) / jerk_mps3
    v = speed_mps + accel_mps2 * accel_mps2 / (2.0 * jerk_mps3)
    # to zero acceleration and on; or, already braking, as if begun with zero acceleration earlier
    if accel_mps2 > 0.0:
        first = speed_mps * t + accel_mps2 * t * t / 2.0 - jerk_mps3 * t * t * t / 6.0
    else:
        first = jerk_mps3 * t * t * t / 6.0 - v * t
    if v >= a_max_mps2 * a_max_mps2 / jerk_mps3:
        return first + 0.5 * v * (v / a_max_mps2 + a_max_mps2 / jerk_mps3)
    return first + v * math.sqrt(v / jerk_mps3)


@njit(cache=True, nogil=True)
def can_stop(e_m: Any, v_mps: Any, a_mps2: Any, dt_s: Any, v_max: Any, a_max: Any, jerk: Any) -> Any:
    """Whether a cycle at an acceleration leaves room to stop within `e_m` ≥ 0 and below `v_max`."""
    v = v_mps + a_mps2 * dt_s
    if a_mps2 > 0.0 and v + 0.5 * a_mps2 * (dt_s + a_mps2 / jerk) > v_max:
        return False
    if v <= 0.0:
        return v * dt_s + way_to_rest(0.0, max(a_mps2, 0.0), a_max, jerk) <= e_m
    return v * dt_s + way_to_rest(v, a_mps2, a_max, jerk) <= e_m


@njit(cache=True, nogil=True)
def next_accel(e_m: Any, v_mps: Any, a_mps2: Any, dt_s: Any, v_max: Any, a_max: Any, jerk: Any) -> Any:
    """Acceleration of the next cycle toward a set point `e_m` ≥ 0 ahead [m/s²].

    Parameters
    ----------
    e_m, v_mps, a_mps2 : float64   way to go, speed and acceleration now, positive toward it
    dt_s : float64                 length of the cycle
    v_max, a_max, jerk : float64   limits [m/s, m/s², m/s³]
    """
    change = jerk * dt_s
    low = min(max(a_mps2 - change, -a_max), a_mps2 + change)
    high = max(min(a_mps2 + change, a_max), a_mps2 - change)
    speed = e_m / dt_s
    land, brake = (speed - v_mps) / dt_s, -speed / dt_s
    if (
        low <= land <= high
        and speed <= v_max
        and abs(brake) <= min(a_max, change)
        and abs(brake - land) <= change
    ):
        return land
    if can_stop(e_m, v_mps, high, dt_s, v_max, a_max, jerk):
        return high
    if not can_stop(e_m, v_mps, low, dt_s, v_max, a_max, jerk):
        return low
    for _ in range(ROUNDS):
        middle = 0.5 * (low + high)
        if can_stop(e_m, v_mps, middle, dt_s, v_max, a_max, jerk):
            low = middle
        else:
            high = middle
    return low


@njit(cache=True, nogil=True)
def move_set_point(params: Any, a: Any, now_ns: Any, wanted_m: Any, tool_z_m: Any) -> None:
    """Lead `a.set_point_m` toward where it is wanted; after a pause it starts anew at the tool.

    Parameters
    ----------
    params, a : records of `Params`, `AdaptiveState` (updated)
    now_ns : int64
    wanted_m, tool_z_m : float64
    """
    if a.set_ns == 0 or now_ns - a.set_ns > PAUSE_NS:
        a.set_point_m, a.set_speed_mps, a.set_accel_mps2 = tool_z_m, 0.0, 0.0
        a.set_ns = now_ns - FIRST_NS
    dt = min((now_ns - a.set_ns) * 1e-9, LONGEST_S)
    if dt <= 0.0:
        return
    e = wanted_m - a.set_point_m
    up, gentle = (1.0, 1.0) if e >= 0.0 else (-1.0, params.toward_factor)
    accel = up * next_accel(
        up * e,
        up * a.set_speed_mps,
        up * a.set_accel_mps2,
        dt,
        gentle * params.max_speed_mps,
        gentle * params.max_accel_mps2,
        params.max_jerk_mps3,
    )
    a.set_accel_mps2 = accel
    a.set_speed_mps += accel * dt
    a.set_point_m += a.set_speed_mps * dt
    a.set_ns = now_ns
