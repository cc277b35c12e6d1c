"""From conversions to distances: the first step of a cycle (paper §3.2.1)."""

from __future__ import annotations

from typing import Any

from surffollow.forecast.pose import push_pose
from surffollow.shm.conversion import (
    FLAG_INVALID,
    conversion_channel,
    conversion_counts,
    conversion_dt_ns,
    conversion_flags,
)
from surffollow.shm.jit import jit_inlined
from surffollow.shm.layout_follow import CHANNELS, CONVERSION_WINDOW


@jit_inlined
def take_conversions(params: Any, sense: Any, inputs: Any) -> None:
    """Add the cycle's conversions to their windows and average the newest `sensor_readings`.

    A conversion on or outside the valid range, or flagged by its driver, empties its
    channel's window: a mean never spans a loss. The reading is stamped at the middle of
    its conversions, less the sensor's latency.

    Parameters
    ----------
    params, sense, inputs : records of `Params`, `SenseState` (updated), `Inputs`
    """
    n_channels = params.n_channels
    for c in range(CHANNELS):
        sense.fresh[c] = 0
    for k in range(inputs.n_conversions):
        word = inputs.conversion[k]
        c = conversion_channel(word)
        if c >= n_channels:
            continue
        range_m = params.zero_m[c] + params.scale_m[c] * conversion_counts(word)
        bad = (conversion_flags(word) & FLAG_INVALID) != 0
        if bad or not (params.range_min_m < range_m < params.range_max_m):
            sense.window_n[c] = 0
            sense.valid[c] = 0
            sense.fresh[c] = 0
            continue
        n = sense.window_n[c]
        slot = c * CONVERSION_WINDOW + (n & (CONVERSION_WINDOW - 1))
        sense.window_m[slot] = range_m
        sense.window_t_ns[slot] = inputs.t_ns + conversion_dt_ns(word)
        sense.window_n[c] = n + 1
        sense.fresh[c] = 1
    readings = params.sensor_readings
    for c in range(n_channels):
        n = sense.window_n[c]
        if sense.fresh[c] == 0 or n < readings:
            sense.fresh[c] = 0
            continue
        total = 0.0
        base = c * CONVERSION_WINDOW
        for i in range(n - readings, n):
            total += sense.window_m[base + (i & (CONVERSION_WINDOW - 1))]
        first_ns = sense.window_t_ns[base + ((n - readings) & (CONVERSION_WINDOW - 1))]
        last_ns = sense.window_t_ns[base + ((n - 1) & (CONVERSION_WINDOW - 1))]
        sense.range_m[c] = total / readings
        sense.range_t_ns[c] = first_ns + (last_ns - first_ns) // 2 - params.sensor_latency_ns
        sense.valid[c] = 1


@jit_inlined
def take_ranges(params: Any, sense: Any, inputs: Any) -> None:
    """Take distances that come ready-made (a CSV, an embedder); NaN, or none given, is no reading."""
    for c in range(CHANNELS):
        sense.fresh[c] = 0
        sense.valid[c] = 0
    for c in range(min(inputs.n_ranges, params.n_channels)):
        range_m = inputs.given_m[c]
        if params.range_min_m < range_m < params.range_max_m:
            sense.range_m[c] = range_m
            sense.range_t_ns[c] = inputs.given_t_ns - params.sensor_latency_ns
            sense.fresh[c] = 1
            sense.valid[c] = 1


@jit_inlined
def take_poses(sense: Any, inputs: Any) -> None:
    """Append the cycle's new poses to the history."""
    for k in range(inputs.n_poses):
        push_pose(sense, inputs.pose_t_ns[k], inputs.pose, k * 7)
