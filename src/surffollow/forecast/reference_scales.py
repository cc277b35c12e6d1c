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
from surffollow.forecast import reset
from surffollow.forecast.sensing.clock import scale_duration
from surffollow.shm import atomics as at
from surffollow.shm import layout_follow as layout
from surffollow.shm.jit import jit, jit_inlined

# stand-offs and time constants from here to twice as much have scale 1; 0.1 m and 40 ms among them
STANDOFF_M, TAU_S = 0.052, 0.038


def exponents(unit: str) -> tuple[int, int]:
    """Powers of length and time in a unit: 1 and −2 in "m/s^2"."""
    powers = {"m": 0, "s": 0}
    for side, sign in zip(unit.replace("ns", "s").split("/"), (1, -1)):
        for factor in side.split():
            name, _, power = factor.partition("^")
            powers[name] = powers.get(name, 0) + sign * int(power or 1)
    return powers["m"], powers["s"]


def _words(record: str, left_out: tuple[str, ...] = ()) -> NDArray[np.int64]:
    """Words of a record of `ScaledState`.

    Rows: offsets in the record and in `FollowState` [bytes], 1 of a real number, powers of length and time.
    """
    schema, at_state = layout.ScaledState.field(record).nested, layout.FollowState.offset("scaled", record)
    assert schema is not None
    rows: list[tuple[int, ...]] = []
    for f in schema.FIELDS:
        if f.name not in left_out:
            unit, _, rotation = f.unit.partition(", ")  # of poses: three lengths, then a rotation
            size = 7 if rotation == "1" else 6 if rotation else f.count
            for k in range(f.count):
                powers = (0, 0) if rotation and k % size >= 3 else exponents(unit)
                offset = f.offset + 8 * k
                rows.append((offset, at_state + offset, f.code == "f8", *powers))
    return np.array(rows, np.int64)


_PARAMS = _words("params")
# but what the cycle sets itself, in SI units
_OUTPUT = _words(
    "output",
    ("t_ns", "pose_t_ns", "status", "cycle", "epoch", "range_m", "range_t_ns", "stop", "stop_now"),
)


@jit
def scale_exponent(value, usual):
    """Binary logarithm of the greatest power of two that is not above value / usual, both > 0.

    It is −12 to 12: dimensionless times of a fast axis, 2^62 ns, stay above 10 days.
    """
    _, e = math.frexp(value / usual)
    return min(max(e - 1, -12), 12)


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
    reset.clear_record(state, reset.SCALED)
    d.length, d.time, d.shift = length, math.ldexp(1.0, shift), shift
    if begun:
        reset.reset_follower(state, 0)


@jit_inlined
def is_unscaled(d):
    """Whether dimensionless numbers are metres and seconds."""
    return d.length == 1.0 and d.shift == 0


@jit_inlined
def dimensionless_time(d, t_ns):
    """A dimensionless time: that since the epoch over the reference time; without an epoch as it is.

    It is never 0, which means never: it begins at 2^42.
    """
    return t_ns if d.epoch_ns == 0 else scale_duration(t_ns - d.epoch_ns, d.shift) + (1 << 42)


@jit
def scale_words(d, words, record, state, sign):
    """Copy words of a record, real numbers times their units to the power `sign`.

    Parameters
    ----------
    d : record of `ScaledState`
    words : (n, 5) int64   see `_words`
    record, state : int64  addresses of the record in SI units and of `FollowState`
    sign : int             −1: to dimensionless numbers, 1: to SI units
    """
    _, e = math.frexp(d.length)
    for k in range(words.shape[0]):
        source, target, time = record + words[k, 0], state + words[k, 1], words[k, 4]
        if sign > 0:
            source, target = target, source
        if words[k, 2] != 0:
            power = sign * (words[k, 3] * (e - 1) + time * d.shift)
            at.store_relaxed_f64(target, math.ldexp(at.load_relaxed_f64(source), power))
        else:
            word = at.load_relaxed_i64(source)
            at.store_relaxed_i64(target, scale_duration(word, d.shift) if time != 0 else word)


@jit
def scale_sense(d, sense, n_channels):
    """Copy poses and samples to the dimensionless record; poses back to one that is there already."""
    scaled, per_m, n = d.sense, 1.0 / d.length, sense.pose_count
    scaled.pose_count, scaled.outside = n, sense.outside
    for k in range(n - 1, max(0, n - layout.POSES) - 1, -1):
        slot = k & (layout.POSES - 1)
        t_ns = dimensionless_time(d, sense.pose_t_ns[slot])
        if t_ns == scaled.pose_t_ns[slot]:
            break
        scaled.pose_t_ns[slot] = t_ns
        for i in range(7):
            scaled.pose[7 * slot + i] = sense.pose[7 * slot + i] * (per_m if i < 3 else 1.0)
    for k in range(n_channels * layout.CONVERSION_WINDOW):
        scaled.window_m[k] = sense.window_m[k] * per_m
        scaled.window_t_ns[k] = dimensionless_time(d, sense.window_t_ns[k])
    for c in range(layout.CHANNELS):
        scaled.window_n[c], scaled.fresh[c] = sense.window_n[c], sense.fresh[c]
        scaled.valid[c], scaled.range_m[c] = sense.valid[c], sense.range_m[c] * per_m
        scaled.range_t_ns[c] = dimensionless_time(d, sense.range_t_ns[c])


@jit
def scale_inputs(params, state, inputs, output):
    """Fill the dimensionless records of this cycle.

    Parameters
    ----------
    params, state, inputs, output : (1,) records of `Params`, `FollowState`, `Inputs`, `Output`
    """
    d, i, fold = state[0].scaled, inputs[0], state[0].fold
    if d.epoch_ns == 0:
        d.epoch_ns = i.t_ns
    scale_words(d, _PARAMS, params.ctypes.data, state.ctypes.data, -1)
    scale_sense(d, state[0].sense, params[0].n_channels)
    per_m = 1.0 / d.length
    d.fold.close, d.fold.close_z_m = fold.close, fold.close_z_m * per_m
    d.fold.channel, d.fold.close_range_m = fold.channel, fold.close_range_m * per_m
    d.inputs.t_ns, d.inputs.n_ranges = dimensionless_time(d, i.t_ns), i.n_ranges
    for c in range(i.n_ranges):
        d.inputs.given_m[c] = i.given_m[c] * per_m
    d.inputs.n_preview = min(max(i.n_preview, 0), layout.MAX_PREVIEW)
    d.inputs.preview_from_m, d.inputs.preview_step_m = i.preview_from_m * per_m, i.preview_step_m * per_m
    for k in range(d.inputs.n_preview):
        d.inputs.preview_m[k] = i.preview_m[k] * per_m
    # only what the kernels read: the rest of the output is no part of the state and is not replayed
    o, out = output[0], d.output
    out.fresh, out.delta_h_m, out.error_m = o.fresh, 0.0, 0.0
    out.demand[:] = 0.0
    for k in range(3 * layout.CHANNELS):
        if (o.fresh >> (k // 3)) & 1 != 0:
            out.target_m[k] = o.target_m[k] * per_m


@jit
def unscale_outputs(state, output):
    """Copy the dimensionless output and the fold-back latch back in SI units; timestamps stay."""
    d, fold = state[0].scaled, state[0].fold
    fold.close, fold.close_z_m = d.fold.close, d.fold.close_z_m * d.length
    fold.channel, fold.close_range_m = d.fold.channel, d.fold.close_range_m * d.length
    scale_words(d, _OUTPUT, output.ctypes.data, state.ctypes.data, 1)


def scaled_defaults(offset_m: float, tau_s: float) -> dict[str, float]:
    """Defaults of the parameters with a dimension for a stand-off and a time constant.

    With scale 1 they are those of `PARAMS`. Driver, configuration or the sensor's window give the stand-off,
    τ, window, fold-back and latency. Time-outs are never below their defaults: the rates of pose reports and
    sensors do not depend on the axis. Nor are the limits of the axis: one that is too high costs accuracy,
    one that is too low costs clearance over rising ground.
    """
    length = math.ldexp(1.0, scale_exponent.py_func(offset_m, STANDOFF_M))
    time = math.ldexp(1.0, scale_exponent.py_func(tau_s, TAU_S))
    found: dict[str, float] = {}
    for name, spec in PARAMS.items():
        powers = exponents(layout.Params.field(name).unit)
        given = name.startswith(("offset", "plant_tau", "range", "too_close", "sensor_latency"))
        if given or powers == (0, 0):
            continue
        value = spec.default * length ** powers[0] * time ** powers[1]
        if name.startswith("plant") or name.endswith("timeout_ns"):
            value = max(value, spec.default)
        found[name] = min(max(value, spec.low), spec.high)
    return found
