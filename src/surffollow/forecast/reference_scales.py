"""Reference scales of the default follower: kernels compute with dimensionless numbers.

The constants of the default follower are in metres and seconds of a cell with 0.1 m stand-off and an axis of
40 ms. A length and a time, powers of two that are 1 for such a cell, follow from the stand-off and the
assumed time constant. Parameters, poses, ranges and preview are divided by them before the cycle, and the
output is multiplied behind it. Multiplying by a power of two is exact: lengths × 2^k and times × 2^m scale
the demand bit for bit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from surffollow.config.params import PARAMS
from surffollow.forecast.reset import begin_anew
from surffollow.shm import atomics as at
from surffollow.shm.jit import jit, jit_inlined
from surffollow.shm.layout_follow import (
    CHANNELS,
    CONVERSION_WINDOW,
    MAX_PREVIEW,
    POSES,
    SCALED_UNITS,
    FollowState,
    Output,
    Params,
    ScaledState,
)
from surffollow.shm.schema import Schema

# stand-offs and time constants from here to twice as much have scale 1; 0.1 m and 40 ms among them
STANDOFF_M, TAU_S = 0.052, 0.038
TIME_ORIGIN_NS = 1 << 42  # dimensionless time of the first cycle: a time of 0 means never
MAX_SHIFT = 12  # dimensionless times of a fast axis: 2^62 ns stay above 10 days
# powers of length and time by unit; a rotation is dimensionless as it is
EXPONENTS: dict[str, tuple[int, int]] = {
    "": (0, 0),
    "1": (0, 0),
    "rad": (0, 0),
    "m": (1, 0),
    "m/count": (1, 0),
    "1/m": (-1, 0),
    "s": (0, 1),
    "m/s": (1, -1),
    "m/s^2": (1, -2),
    "m/s^3": (1, -3),
    "m s^2/m": (0, 2),
    "s^4": (0, 4),
    "rad/s": (0, -1),
    "rad/s^2": (0, -2),
}
_NUMBER, _COUNT, _DURATION, _UNSCALED = 0, 1, 2, 3
# fields of the output that the cycle sets itself, in SI units
_CYCLE_FIELDS = ("t_ns", "pose_t_ns", "status", "cycle", "epoch", "range_m", "range_t_ns", "stop", "stop_now")
_POSE_UNITS = {"m, 1": ("m",) * 3 + ("1",) * 4, "m, rad": ("m",) * 3 + ("rad",) * 3}
POWERS = sorted(set(EXPONENTS.values()))
assert len(POWERS) <= SCALED_UNITS
_POWERS = np.array(POWERS, np.int64)


def _table(schema: type[Schema]) -> NDArray[np.int64]:
    """Per word of a record: what it is, and which of `POWERS` its unit has."""
    rows: list[tuple[int, int]] = []
    for f in schema.FIELDS:
        for k in range(f.count):
            units = _POSE_UNITS.get(f.unit, (f.unit,))
            if schema is Output and f.name in _CYCLE_FIELDS:
                rows.append((_UNSCALED, 0))
            elif f.code == "f8":
                rows.append((_NUMBER, POWERS.index(EXPONENTS[units[k % len(units)]])))
            elif f.unit == "ns":
                rows.append((_DURATION, 0))
            else:
                rows.append((_COUNT, 0))
    return np.array(rows, np.int64)


_PARAMS, _OUTPUT = _table(Params), _table(Output)
_PARAMS_AT, _OUTPUT_AT = FollowState.offset("scaled", "params"), FollowState.offset("scaled", "output")
_SCALED_AT, _SCALED_WORDS = FollowState.offset("scaled"), ScaledState.SIZE // 8


@jit
def scale_exponent(value, usual):
    """Binary logarithm of the greatest power of two that is not above value / usual, both > 0."""
    _, e = math.frexp(value / usual)
    return min(max(e - 1, -MAX_SHIFT), MAX_SHIFT)


@jit
def choose_scales(params, state):
    """Set the reference scales; when they change, the default follower begins without knowledge.

    Parameters
    ----------
    params, state : (1,) records of `Params`, `FollowState`
    """
    d, p = state[0].scaled, params[0]
    shift = scale_exponent(p.plant_tau_s, TAU_S)
    length = math.ldexp(1.0, scale_exponent(p.offset_m, STANDOFF_M))
    if length == d.length and shift == d.shift:
        return
    begun = d.length != 0.0
    for k in range(_SCALED_WORDS):
        at.store_relaxed_i64(state.ctypes.data + _SCALED_AT + 8 * k, 0)
    d.length, d.time, d.shift = length, math.ldexp(1.0, shift), shift
    for u in range(_POWERS.shape[0]):
        d.unit[u] = length ** _POWERS[u, 0] * d.time ** _POWERS[u, 1]
        d.per_unit[u] = 1.0 / d.unit[u]
    if begun:
        begin_anew(state, 0)


@jit_inlined
def is_unscaled(d):
    """Whether dimensionless numbers are metres and seconds."""
    return d.length == 1.0 and d.shift == 0


@jit_inlined
def dimensionless_duration(d, ns):
    """A dimensionless duration: nanoseconds over the reference time."""
    return ns >> d.shift if d.shift >= 0 else ns << -d.shift


@jit_inlined
def dimensionless_time(d, t_ns):
    """A dimensionless time: that since the epoch over the reference time; without an epoch as it is."""
    return t_ns if d.epoch_ns == 0 else dimensionless_duration(d, t_ns - d.epoch_ns) + TIME_ORIGIN_NS


@jit
def scale_sense(d, sense, n_channels):
    """Copy new poses and samples to the dimensionless record."""
    scaled, per_m = d.sense, 1.0 / d.length
    n, first = sense.pose_count, d.sense.pose_count
    if first > n or (first > 0 and first > n - POSES):
        last = (first - 1) & (POSES - 1)
        if first > n or scaled.pose_t_ns[last] != dimensionless_time(d, sense.pose_t_ns[last]):
            first = 0  # the pose history was reset
    for k in range(max(first, n - POSES), n):
        slot = k & (POSES - 1)
        scaled.pose_t_ns[slot] = dimensionless_time(d, sense.pose_t_ns[slot])
        for i in range(7):
            scaled.pose[7 * slot + i] = sense.pose[7 * slot + i] * (per_m if i < 3 else 1.0)
    scaled.pose_count = n
    for c in range(n_channels):
        n, first = sense.window_n[c], scaled.window_n[c]
        if scaled.losses[c] != sense.losses[c] or first > n:
            first = 0
        for k in range(max(first, n - CONVERSION_WINDOW), n):
            slot = c * CONVERSION_WINDOW + (k & (CONVERSION_WINDOW - 1))
            scaled.window_m[slot] = sense.window_m[slot] * per_m
            scaled.window_t_ns[slot] = dimensionless_time(d, sense.window_t_ns[slot])
        scaled.window_n[c], scaled.losses[c] = n, sense.losses[c]
        scaled.fresh[c], scaled.valid[c] = sense.fresh[c], sense.valid[c]
        scaled.range_m[c] = sense.range_m[c] * per_m
        scaled.range_t_ns[c] = dimensionless_time(d, sense.range_t_ns[c])
    for c in range(n_channels, CHANNELS):
        scaled.fresh[c] = 0


@jit
def scale_inputs(params, state, inputs, output):
    """Fill the dimensionless records of this cycle.

    Parameters
    ----------
    params, state, inputs, output : (1,) records of `Params`, `FollowState`, `Inputs`, `Output`
    """
    d, i, target = state[0].scaled, inputs[0], state.ctypes.data
    if d.epoch_ns == 0:
        d.epoch_ns = i.t_ns
    source = params.ctypes.data
    for k in range(_PARAMS.shape[0]):
        to = target + _PARAMS_AT + 8 * k
        if _PARAMS[k, 0] == _NUMBER:
            at.store_relaxed_f64(to, at.load_relaxed_f64(source + 8 * k) * d.per_unit[_PARAMS[k, 1]])
        else:
            word = at.load_relaxed_i64(source + 8 * k)
            at.store_relaxed_i64(to, dimensionless_duration(d, word) if _PARAMS[k, 0] == _DURATION else word)
    scale_sense(d, state[0].sense, params[0].n_channels)
    per_m = 1.0 / d.length
    fold = state[0].fold
    d.fold.close, d.fold.close_z_m = fold.close, fold.close_z_m * per_m
    d.fold.close_range_m = fold.close_range_m * per_m
    d.inputs.t_ns, d.inputs.n_ranges = dimensionless_time(d, i.t_ns), i.n_ranges
    n = min(max(i.n_preview, 0), MAX_PREVIEW)
    d.inputs.n_preview = n
    d.inputs.preview_from_m, d.inputs.preview_step_m = i.preview_from_m * per_m, i.preview_step_m * per_m
    for k in range(n):
        d.inputs.preview_m[k] = i.preview_m[k] * per_m
    # only what the kernels read: the rest of the output is no part of the state and is not replayed
    o, out = output[0], d.output
    out.fresh, out.delta_h_m, out.error_m = o.fresh, 0.0, 0.0
    for k in range(6):
        out.demand[k] = 0.0
    for k in range(3 * CHANNELS):
        if (o.fresh >> (k // 3)) & 1 != 0:
            out.target_m[k] = o.target_m[k] * per_m


@jit
def unscale_outputs(state, output):
    """Copy the dimensionless output and the fold-back latch back in SI units; timestamps stay."""
    d, fold = state[0].scaled, state[0].fold
    fold.close, fold.close_z_m = d.fold.close, d.fold.close_z_m * d.length
    fold.close_range_m = d.fold.close_range_m * d.length
    source, target = state.ctypes.data + _OUTPUT_AT, output.ctypes.data
    for k in range(_OUTPUT.shape[0]):
        if _OUTPUT[k, 0] == _NUMBER:
            at.store_relaxed_f64(target + 8 * k, at.load_relaxed_f64(source + 8 * k) * d.unit[_OUTPUT[k, 1]])
        elif _OUTPUT[k, 0] == _COUNT:
            at.store_relaxed_i64(target + 8 * k, at.load_relaxed_i64(source + 8 * k))


# given by driver, configuration or the sensor's window at every scale
_CONFIGURED = (
    "offset_m",
    "range_min_m",
    "range_max_m",
    "too_close_m",
    "too_close_exit_m",
    "sensor_latency_ns",
    "plant_tau_s",
)
_NOT_LOWERED = ("pose_timeout_ns", "loss_timeout_ns", "plant_v_max_mps", "plant_a_max_mps2")


def scaled_defaults(offset_m: float, tau_s: float) -> dict[str, float]:
    """Defaults of the parameters with a dimension for a stand-off and a time constant.

    With scale 1 they are those of `PARAMS`. Time-outs are never below their defaults: the rates of pose
    reports and sensors do not depend on the axis. Nor are the limits of the axis: one that is too high costs
    accuracy, one that is too low costs clearance over rising ground.
    """
    length = math.ldexp(1.0, scale_exponent.py_func(offset_m, STANDOFF_M))
    time = math.ldexp(1.0, scale_exponent.py_func(tau_s, TAU_S))
    found: dict[str, float] = {}
    for name, spec in PARAMS.items():
        unit = Params.field(name).unit
        if name in _CONFIGURED:
            continue
        powers = (0, 1) if unit == "ns" else EXPONENTS[unit]
        if powers == (0, 0):
            continue
        value = spec.default * length ** powers[0] * time ** powers[1]
        if name in _NOT_LOWERED:
            value = max(value, spec.default)
        found[name] = min(max(value, spec.low), spec.high)
    return found
