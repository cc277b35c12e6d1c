"""Fault detection and isolation (FDI) of several beams.

Each beam gives a height under the tool by way of the known slopes. A beam that deviates from the median of
these heights by more than the gate is excluded. After some samples it is accepted again (the ground has
turned), unless three others agree on a plane or its own reading does not change.
"""

from __future__ import annotations

from typing import Any

from surffollow.forecast.adaptive.kinematics import predict_pose
from surffollow.forecast.pose import footprint, rotate
from surffollow.shm.jit import jit

MAX_REFERENCE_AGE_NS = 12_000_000  # a beam this much older than the newest no longer sets the pace
MAX_AGE_NS = 25_000_000  # older footprints do not belong to the same plane
STUCK_NS = 100_000_000  # a reading that stays the same so long while the others change is stuck
GATE_SIGMAS, MIN_GATE_M = 8.0, 2e-3
CONFIRMATION_SAMPLES = 5
WEIGHT_RECOVERY = 0.1  # weight that a beam gains per sample
MIN_WEIGHT = 0.05  # of a beam that is believed although it is odd


@jit
def choose_reference(params: Any, a: Any, sense: Any) -> Any:
    """The channel whose samples set the pace: the last one while it delivers and agrees; -1: none."""
    newest = 0
    for c in range(params.n_channels):
        newest = max(newest, a.beam_ns[c])
    best, least = -1, 3
    for k in range(params.n_channels):
        c = (a.primary + k) % params.n_channels
        if a.beam_ns[c] == 0:
            continue
        trouble = 0
        if sense.valid[c] == 0 or newest - a.beam_ns[c] > MAX_REFERENCE_AGE_NS:
            trouble = 2
        elif a.beam_odd[c] > 0:
            trouble = 1
        if trouble < least:
            best, least = c, trouble
    if best >= 0:
        a.primary = best
    return best


@jit
def any_beam_changed(a: Any, n_channels: Any, since_ns: Any) -> Any:
    """1 when a beam that still delivers has changed its reading since then: not all sensors are stuck."""
    for c in range(n_channels):
        if a.beam_ns[c] > since_ns and a.beam_changed_ns[c] > since_ns:
            return 1
    return 0


@jit
def observe_beams(params: Any, a: Any, sense: Any, pose: Any) -> Any:
    """Footprints of all fresh channels; the channel whose samples set the pace, or -1.

    `pose` (7,) is scratch.
    """
    for c in range(params.n_channels):
        if sense.fresh[c] == 0:
            continue
        t_ns, range_m = sense.range_t_ns[c], sense.range_m[c]
        predict_pose(a, sense, t_ns, pose)
        x, y, z, _ = footprint(pose, params.tool_from_sensor, c, range_m)
        a.beam_m[3 * c], a.beam_m[3 * c + 1], a.beam_m[3 * c + 2] = x, y, z
        if a.beam_ns[c] == 0 or range_m != a.beam_range_m[c] or t_ns < a.beam_changed_ns[c]:
            a.beam_changed_ns[c] = t_ns
        a.beam_range_m[c], a.beam_ns[c] = range_m, t_ns
        # where the axis meets the ground when the stand-off is kept: near enough for the curvature's share
        dx, dy, _ = rotate(
            pose[3], pose[4], pose[5], pose[6], 0.0, 0.0, params.tool_from_sensor[2] - params.offset_m
        )
        a.axis_x_m, a.axis_y_m = pose[0] + dx, pose[1] + dy
    return choose_reference(params, a, sense)


@jit
def _median(values: Any, n: Any) -> Any:
    """Median of the first n values, which are sorted in place."""
    for i in range(1, n):
        v, j = values[i], i
        while j > 0 and values[j - 1] > v:
            values[j] = values[j - 1]
            j -= 1
        values[j] = v
    return values[n // 2] if n % 2 == 1 else 0.5 * (values[n // 2 - 1] + values[n // 2])


@jit
def half_squared_distance(a: Any, c: Any) -> Any:
    """Half the squared distance of a beam's footprint from the tool's axis [m²]."""
    dx, dy = a.beam_m[3 * c] - a.axis_x_m, a.beam_m[3 * c + 1] - a.axis_y_m
    return 0.5 * (dx * dx + dy * dy)


@jit
def beam_height(a: Any, c: Any, x_m: Any, y_m: Any) -> Any:
    """Height at (x, y) of the plane through a beam's footprint, the curvature's share taken off [m]."""
    dx, dy = a.beam_m[3 * c] - x_m, a.beam_m[3 * c + 1] - y_m
    return a.beam_m[3 * c + 2] - a.slope_x * dx - a.slope_y * dy - a.curve * half_squared_distance(a, c)


@jit
def isolate_faults(a: Any, n_channels: Any, t_ns: Any, x_m: Any, y_m: Any) -> Any:
    """Mark the beams that agree, weigh them, and return how many there are."""
    n, still = 0, 0
    for c in range(n_channels):
        a.beam_good[c] = 0
        if a.beam_ns[c] == 0 or abs(t_ns - a.beam_ns[c]) > MAX_AGE_NS:
            a.beam_weight[c] = 0.0
            continue
        a.beam_h_m[c] = beam_height(a, c, x_m, y_m)
        a.beam_sort_m[n] = a.beam_h_m[c]
        a.beam_good[c] = 1
        still += 1 if a.beam_ns[c] - a.beam_changed_ns[c] > STUCK_NS else 0
        n += 1
    if n == 0:
        return 0
    middle = _median(a.beam_sort_m, n)
    gate = max(GATE_SIGMAS * a.noise_m, MIN_GATE_M)
    agree = 0
    for c in range(n_channels):
        if a.beam_good[c] != 0 and abs(a.beam_h_m[c] - middle) <= gate:
            agree += 1
    majority = agree >= 3 and a.plane_rank == 2
    good = 0
    for c in range(n_channels):
        if a.beam_good[c] == 0:
            continue
        off = abs(a.beam_h_m[c] - middle) / gate
        odd = off > 1.0 and n >= 2 and a.planes > 0
        a.beam_odd[c] = min(max(a.beam_odd[c] + (1 if odd else -1), 0), 2 * CONFIRMATION_SAMPLES)
        stuck = still == 1 and n >= 2 and a.beam_ns[c] - a.beam_changed_ns[c] > STUCK_NS
        if stuck or (odd and a.beam_odd[c] <= CONFIRMATION_SAMPLES) or (majority and a.beam_odd[c] > 0):
            a.beam_odd[c] = max(a.beam_odd[c], 1)
            a.beam_good[c] = 0
            a.beam_weight[c] = 0.0
            continue
        full = max((1.0 - off * off) ** 2, MIN_WEIGHT) if off < 1.0 else MIN_WEIGHT
        if a.planes == 0:
            a.beam_weight[c] = 1.0
        else:
            a.beam_weight[c] = min(full, a.beam_weight[c] + WEIGHT_RECOVERY)
        good += 1
    return good


@jit
def mean_height(a: Any, n_channels: Any, x_m: Any, y_m: Any) -> Any:
    """Weighted mean of the good beams' heights at (x, y) [m]."""
    total, weights = 0.0, 0.0
    for c in range(n_channels):
        if a.beam_good[c] != 0:
            total += a.beam_weight[c] * beam_height(a, c, x_m, y_m)
            weights += a.beam_weight[c]
    return total / weights
