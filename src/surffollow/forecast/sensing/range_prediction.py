"""Predict the range itself over time, for logs and for horizons far beyond the controller's.

A bank of damped straight lines (filters of range and rate) and "no change". Each is weighted by the errors of
the predictions that it made 2, 5, 10 and 20 snapshots ago, at the horizon nearest to the one asked for.
"""

import math

import numpy as np

from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_sensing import N_HORIZONS, N_TRENDS, SNAPSHOTS

SNAPSHOT_NS = 90_000_000  # between snapshots, or the samples' interval if that is longer
HORIZON_SNAPSHOTS = np.array([2, 5, 10, 20])  # horizons, in snapshots
SCORE_RATE = 0.01  # per snapshot
WEIGHT_POWER = 5.0  # of the inverse squared error
INTERVAL_RATE = 0.1  # of the usual interval, per sample
GATE_SCALES = 8.0  # in usual innovations
SCALE_RATE = 0.05  # of the usual innovation, per sample
MIN_SCALE_M = 1e-6  # of a sensor without noise
GAP_INTERVALS = 5.0  # usual intervals, or seconds if that is more: begin at the next range


RATIOS = np.array([0.2, 0.6, 2.0, 8.0, 20.0])  # of rate noise to reading noise [s^-1.5]
DAMPINGS_S = np.array([1.0, 2.5, 8.0])
# the first line is "no change", then come all ratios with the first damping
DAMPING_S = np.concatenate([DAMPINGS_S[:1], np.repeat(DAMPINGS_S, len(RATIOS))])
assert len(DAMPING_S) == N_TRENDS


@jit
def damped_time(horizon_s, damping_s):
    """Integral of a damped unit rate over a horizon [s]."""
    return damping_s * (1.0 - math.exp(-horizon_s / damping_s))


@jit
def reset_prediction(prediction, t_ns, range_m):
    """Begin all lines at a range."""
    for k in range(N_TRENDS):
        prediction.range_m[k], prediction.rate_mps[k] = range_m, 0.0
        prediction.covariance[3 * k], prediction.covariance[3 * k + 1], prediction.covariance[3 * k + 2] = (
            1.0,
            0.0,
            1.0,
        )
    prediction.t_ns = t_ns
    prediction.rejected = 0
    prediction.snapshots = 0


@jit
def score_predictions(prediction, t_ns, range_m):
    """Update the errors of earlier snapshots with a range, then take a snapshot."""
    for j in range(N_HORIZONS):
        back = prediction.snapshots - HORIZON_SNAPSHOTS[j]
        if back < 0:
            continue
        slot = back & (SNAPSHOTS - 1)
        h = (t_ns - prediction.snapshot_ns[slot]) * 1e-9
        prediction.horizon_s[j] = (
            h
            if prediction.horizon_s[j] == 0.0
            else prediction.horizon_s[j] + 0.1 * (h - prediction.horizon_s[j])
        )
        for k in range(N_TRENDS):
            s = slot * N_TRENDS + k
            e = (
                range_m
                - prediction.snapshot_range_m[s]
                - prediction.snapshot_rate_mps[s] * damped_time(h, DAMPING_S[k])
            )
            prediction.error_m2[j * N_TRENDS + k] += SCORE_RATE * (
                e * e - prediction.error_m2[j * N_TRENDS + k]
            )
    slot = prediction.snapshots & (SNAPSHOTS - 1)
    for k in range(N_TRENDS):
        (
            prediction.snapshot_range_m[slot * N_TRENDS + k],
            prediction.snapshot_rate_mps[slot * N_TRENDS + k],
        ) = prediction.range_m[k], prediction.rate_mps[k]
    prediction.snapshot_ns[slot] = t_ns
    prediction.snapshots += 1


@jit
def update_prediction(prediction, t_ns, range_m):
    """Update all lines with a range; a single outlier is rejected."""
    dt = (t_ns - prediction.t_ns) * 1e-9
    if prediction.t_ns == 0 or dt <= 0.0 or dt > GAP_INTERVALS * max(prediction.interval_s, 1.0):
        reset_prediction(prediction, t_ns, range_m)
        return
    prediction.interval_s += (INTERVAL_RATE if prediction.interval_s > 0.0 else 1.0) * (
        dt - prediction.interval_s
    )
    mean = prediction.range_m[0] / N_TRENDS
    for j in range(DAMPINGS_S.size):
        g = damped_time(dt, DAMPINGS_S[j])
        for k in range(1 + j * RATIOS.size, 1 + (j + 1) * RATIOS.size):
            mean += (prediction.range_m[k] + g * prediction.rate_mps[k]) / N_TRENDS
    innovation = range_m - mean
    outlier = (
        abs(innovation) > GATE_SCALES * max(prediction.scale_m, MIN_SCALE_M) and prediction.scale_m > 0.0
    )
    if outlier and prediction.rejected < 1:
        prediction.rejected += 1
        return
    shift = innovation if outlier else 0.0
    prediction.rejected = 0
    rate = SCALE_RATE if prediction.scale_m > 0.0 else 1.0
    prediction.scale_m += rate * (1.25 * abs(innovation) - prediction.scale_m)
    prediction.range_m[0] = range_m
    for j in range(DAMPINGS_S.size):
        g, e = damped_time(dt, DAMPINGS_S[j]), math.exp(-dt / DAMPINGS_S[j])
        for i in range(RATIOS.size):
            k, q = 1 + j * RATIOS.size + i, RATIOS[i] * RATIOS[i]
            c = 3 * k
            r, v = prediction.range_m[k] + g * prediction.rate_mps[k] + shift, e * prediction.rate_mps[k]
            p00, p01, p11 = (
                prediction.covariance[c],
                prediction.covariance[c + 1],
                prediction.covariance[c + 2],
            )
            p00 += 2.0 * g * p01 + g * g * p11 + q * dt * dt * dt / 3.0
            p01 = e * (p01 + g * p11) + 0.5 * q * dt * dt
            p11 = e * e * p11 + q * dt
            s = p00 + 1.0
            k0, k1 = p00 / s, p01 / s
            prediction.range_m[k], prediction.rate_mps[k] = r + k0 * (range_m - r), v + k1 * (range_m - r)
            prediction.covariance[c], prediction.covariance[c + 1], prediction.covariance[c + 2] = (
                p00 - k0 * p00,
                p01 - k0 * p01,
                p11 - k1 * p01,
            )
    prediction.t_ns = t_ns
    last = prediction.snapshot_ns[(prediction.snapshots - 1) & (SNAPSHOTS - 1)]
    if prediction.snapshots == 0 or t_ns - last >= SNAPSHOT_NS:
        score_predictions(prediction, t_ns, range_m)


@jit
def predict_range(prediction, horizon_s):
    """Range at a horizon after the newest one [m]; NaN before the first."""
    if prediction.t_ns == 0:
        return math.nan
    j = 0
    for i in range(1, N_HORIZONS):
        if prediction.horizon_s[i] > 0.0 and abs(prediction.horizon_s[i] - horizon_s) < abs(
            prediction.horizon_s[j] - horizon_s
        ):
            j = i
    least = 1e300
    for k in range(N_TRENDS):
        least = min(least, prediction.error_m2[j * N_TRENDS + k])
    total, weight = 0.0, 0.0
    for k in range(N_TRENDS):
        score = prediction.error_m2[j * N_TRENDS + k]
        w = (least / score) ** WEIGHT_POWER if score > 0.0 and least > 0.0 else 1.0
        total += w * (prediction.range_m[k] + prediction.rate_mps[k] * damped_time(horizon_s, DAMPING_S[k]))
        weight += w
    return total / weight
