"""Reference scales: the kernels of the multiple-model follower see plain numbers.

The reference length is the greatest power of two metres up to the stand-off, the reference time the greatest
power of two nanoseconds up to the assumed time constant of the axis. Multiplying by a power of two is
exact, so lengths × 2^k and times × 2^m give the same plain numbers and the demand scales bit for bit.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit

DERIVED = -1.0  # value of a parameter that follows from window, stand-off and plant
# of the way from the near limit to the stand-off: the contest's sensor has 3.8 and 7.6 mm of 50.8
TOO_CLOSE_SHARE, TOO_CLOSE_EXIT_SHARE = 0.075, 0.15
MAX_DEMAND_SHARE = 0.5  # of the stand-off
SPAN = 1 << 52  # reference times after which plain time begins anew: float64 is exact up to 2^53


@jit
def power_of_two(value: Any) -> Any:
    """Greatest power of two that is not above a positive number."""
    _, e = math.frexp(value)
    return math.ldexp(1.0, e - 1)


@jit
def set_reference(params: Any, m: Any, t_ns: Any) -> Any:
    """Compute the reference scales and the told quantities in plain numbers.

    Returns
    -------
    int64  1: the scales changed, so the caller begins anew; 0: they are as before
    """
    r = m.reference
    length = power_of_two(params.offset_m)
    tau_ns = int(power_of_two(params.plant_tau_s * 1e9))
    changed = 0
    if length != r.length_m or tau_ns != r.time_ns or abs(t_ns - r.epoch_ns) // tau_ns >= SPAN:
        changed = 1
        r.length_m, r.time_ns, r.epoch_ns = length, tau_ns, t_ns
    tau_s = tau_ns * 1e-9
    r.tau = params.plant_tau_s * 1e9 / tau_ns
    r.standoff = params.offset_m / length
    r.v_max = params.plant_v_max_mps * tau_s / length
    r.a_max = params.plant_a_max_mps2 * tau_s * tau_s / length
    r.near = params.range_min_m / length
    room = r.standoff - r.near
    r.too_close = r.near + TOO_CLOSE_SHARE * room
    r.too_close_exit = r.near + TOO_CLOSE_EXIT_SHARE * room
    if params.too_close_m >= 0.0:
        r.too_close, r.too_close_exit = params.too_close_m / length, params.too_close_exit_m / length
    r.max_demand = MAX_DEMAND_SHARE * r.standoff
    if params.max_demand_m >= 0.0:
        r.max_demand = params.max_demand_m / length
    r.toward_factor = params.toward_factor
    return changed


@jit
def plain_time(r: Any, t_ns: Any) -> Any:
    """A time in plain numbers."""
    return (t_ns - r.epoch_ns) / r.time_ns
