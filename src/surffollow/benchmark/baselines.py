"""The hand-made loops that a follower is judged against, jitted together with their run.

All get the same stamped data: readings with their stamps, poses interpolated to those stamps. A method is
two functions, one for a reading and one for a controller tick, on a parameter row and a state row.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.benchmark.loop import END, SAMPLE, STEP_S, TICK, World, advance
from surffollow.shm.jit import jit

HOLD, P, PI, LPF_GATE, KALMAN_FF = 0, 1, 2, 3, 4

# state row
(_STAMP, _ERROR, _INTEGRAL, _HEIGHT, _SLOPE, _X, _P00, _P01, _P11, _REJECTED, _COUNT, _CURSOR, _TARGET) = (
    range(13)
)
_SEEN = 13
STATE_SIZE = 14

# columns of a track: where readings were accepted, height and slope estimated there
_TRACK_X, _TRACK_H, _TRACK_S = 0, 1, 2
TRACK_COLUMNS = 3

READING_TIMEOUT_MS = 100.0  # p and pi act on no reading older than this …
READING_TIMEOUT_PERIODS = 3.0  # … or so many intervals of a slow sensor
INTEGRAL_LIMIT_M = 0.02
GLITCH_SAMPLES = 3
KALMAN_SIGMA_M = 0.3e-3  # reading and pose noise that the filter assumes
DROPOUT_AFTER_MS = 25.0  # no reading for so long beyond the sensor's latency: a drop-out, not a glitch
POLICY_EXTRAPOLATE, POLICY_HOLD = 0.0, 1.0


@jit
def pose_at(s: Any, w: World, ms: float) -> tuple[float, float]:
    """x and z at a time [ms] from the reports that have arrived, linear between and beyond them.

    Returns
    -------
    (x, z) float64 [m], NaN before the first report
    """
    last = s.poses - 1
    if last < 0:
        return math.nan, math.nan
    if last == 0:
        return w.reports[0].x, w.reports[0].z
    j = last
    while j > 1 and w.reports[j - 1].ms > ms:
        j -= 1
    f = (ms - w.reports[j - 1].ms) / (w.reports[j].ms - w.reports[j - 1].ms)
    x = w.reports[j - 1].x + f * (w.reports[j].x - w.reports[j - 1].x)
    z = w.reports[j - 1].z + f * (w.reports[j].z - w.reports[j - 1].z)
    return x, z


@jit
def lateral_speed(s: Any, w: World) -> float:
    """Lateral speed [m/s] over the last ten reports that have arrived; 0 before the second."""
    last = s.poses - 1
    if last < 1:
        return 0.0
    first = max(0, last - 10)
    return float(
        (w.reports[last].x - w.reports[first].x) / ((w.reports[last].ms - w.reports[first].ms) * STEP_S)
    )


@jit
def _note(m: NDArray[Any], track: NDArray[Any]) -> None:
    """Append the estimate to the track."""
    n = int(m[_COUNT])
    track[n, _TRACK_X] = m[_X]
    track[n, _TRACK_H] = m[_HEIGHT]
    track[n, _TRACK_S] = m[_SLOPE]
    m[_COUNT] = n + 1


@jit
def _height_at(m: NDArray[Any], track: NDArray[Any], x_m: float) -> float:
    """Estimated height at x: from the track where a leading sensor has been, else by the last slope."""
    n = int(m[_COUNT])
    if x_m >= m[_X] or n < 2:
        return float(m[_HEIGHT] + m[_SLOPE] * (x_m - m[_X]))
    i = int(m[_CURSOR])
    while i < n - 2 and track[i + 1, _TRACK_X] < x_m:
        i += 1
    m[_CURSOR] = i
    gap = track[i + 1, _TRACK_X] - track[i, _TRACK_X]
    if gap <= 0.0 or x_m <= track[i, _TRACK_X]:
        return float(track[i, _TRACK_H])
    f = (x_m - track[i, _TRACK_X]) / gap
    return float(track[i, _TRACK_H] + f * (track[i + 1, _TRACK_H] - track[i, _TRACK_H]))


@jit
def _lpf_sample(
    p: NDArray[Any], m: NDArray[Any], track: NDArray[Any], dt_s: float, x_m: float, h_m: float
) -> None:
    """Low-pass the height; a jump beyond the gate must be seen three times (p: τ [s], gate [m], lag [s])."""
    if m[_COUNT] > 0 and abs(h_m - m[_HEIGHT]) > p[1]:
        m[_REJECTED] += 1
        if m[_REJECTED] < GLITCH_SAMPLES:
            return
        m[_HEIGHT] = h_m
    elif m[_COUNT] == 0:
        m[_HEIGHT] = h_m
    else:
        m[_HEIGHT] += (1.0 - math.exp(-dt_s / p[0])) * (h_m - m[_HEIGHT])
    m[_REJECTED] = 0
    m[_X] = x_m
    _note(m, track)


@jit
def _kalman_sample(p: NDArray[Any], m: NDArray[Any], track: NDArray[Any], x_m: float, h_m: float) -> None:
    """Update height and slope (p: slope noise, height noise, gate [σ], rejects to reset, lag [s])."""
    r = KALMAN_SIGMA_M * KALMAN_SIGMA_M
    if m[_COUNT] == 0:
        m[_HEIGHT], m[_SLOPE], m[_X] = h_m, 0.0, x_m
        m[_P00], m[_P01], m[_P11] = r, 0.0, 1e-2
        _note(m, track)
        return
    dx = max(x_m - m[_X], 0.0)
    qs, qh = p[0] * p[0], p[1] * p[1]
    h = m[_HEIGHT] + m[_SLOPE] * dx
    p00 = m[_P00] + 2.0 * dx * m[_P01] + dx * dx * m[_P11] + qs * dx * dx * dx / 3.0 + qh * dx
    p01 = m[_P01] + dx * m[_P11] + 0.5 * qs * dx * dx
    p11 = m[_P11] + qs * dx
    innovation = h_m - h
    variance = p00 + r
    if innovation * innovation > p[2] * p[2] * variance:
        m[_REJECTED] += 1
        if m[_REJECTED] < p[3]:
            return
        # time-out: what was refused so often is the ground now; its slope is as it was, but less sure
        h = h_m
        p00, p01, p11 = r, 0.0, p11 + 1e-3
    else:
        k0, k1 = p00 / variance, p01 / variance
        h += k0 * innovation
        m[_SLOPE] += k1 * innovation
        p11 -= k1 * p01
        p01 -= k0 * p01
        p00 -= k0 * p00
    m[_HEIGHT], m[_X] = h, max(x_m, m[_X])
    m[_P00], m[_P01], m[_P11] = p00, p01, p11
    m[_REJECTED] = 0
    _note(m, track)


@jit
def on_sample(kind: int, p: NDArray[Any], m: NDArray[Any], track: NDArray[Any], s: Any, w: World) -> None:
    """Take the reading that has just arrived (index `samples` − 1)."""
    i = s.samples - 1
    r = w.readings[i].range
    if not math.isfinite(r):
        return
    stamp = float(w.readings[i].ms)
    dt_s = (stamp - m[_STAMP]) * STEP_S if m[_SEEN] > 0.0 else 0.0
    m[_STAMP] = stamp
    m[_SEEN] = 1.0
    m[_ERROR] = r - s.standoff_m
    if kind in (LPF_GATE, KALMAN_FF):
        x, z = pose_at(s, w, stamp)
        if not math.isfinite(z):
            return
        if kind == LPF_GATE:
            _lpf_sample(p, m, track, dt_s, x + s.lead_m, z - r)
        else:
            _kalman_sample(p, m, track, x + s.lead_m, z - r)


@jit
def on_tick(kind: int, p: NDArray[Any], m: NDArray[Any], track: NDArray[Any], s: Any, w: World) -> float:
    """Demand [m] to be added to the newest report that has arrived; 0 before anything is known."""
    if s.poses == 0:
        return 0.0
    z_report = w.reports[s.poses - 1].z
    if kind == HOLD:
        if m[_COUNT] == 0.0:
            m[_COUNT] = 1.0
            m[_TARGET] = z_report
        return float(m[_TARGET] - z_report)
    if m[_SEEN] == 0.0:
        return 0.0
    if kind in (P, PI):
        patience_ms = READING_TIMEOUT_MS
        if w.readings.shape[0] > 1:
            patience_ms = max(patience_ms, READING_TIMEOUT_PERIODS * (w.readings[1].ms - w.readings[0].ms))
        if s.ms - m[_STAMP] > patience_ms + (w.readings[0].arrival_ms - w.readings[0].ms):
            return 0.0
        if kind == P:
            return float(-p[0] * m[_ERROR])
        m[_INTEGRAL] -= p[1] * m[_ERROR] * s.tick_ms * STEP_S
        m[_INTEGRAL] = min(max(m[_INTEGRAL], -INTEGRAL_LIMIT_M), INTEGRAL_LIMIT_M)
        return float(-p[0] * m[_ERROR] + m[_INTEGRAL])
    if m[_COUNT] == 0.0:
        return 0.0
    ahead_s = (s.ms - w.reports[s.poses - 1].ms) * STEP_S
    lag_s = p[2] if kind == LPF_GATE else p[4]
    x = w.reports[s.poses - 1].x + lateral_speed(s, w) * (ahead_s + lag_s)
    lost_ms = s.ms - m[_STAMP] - (w.readings[0].arrival_ms - w.readings[0].ms)
    if not (kind == KALMAN_FF and p[5] == POLICY_HOLD and lost_ms > DROPOUT_AFTER_MS):
        m[_TARGET] = _height_at(m, track, x) + s.standoff_m
    return float(m[_TARGET] - z_report)


@jit
def run_baseline(kind: int, p: NDArray[Any], m: NDArray[Any], track: NDArray[Any], s: Any, w: World) -> None:
    """Run one baseline to the end of the path.

    Parameters
    ----------
    kind : `HOLD`, `P`, `PI`, `LPF_GATE` or `KALMAN_FF`
    p : float64 parameters of that kind
    m : (STATE_SIZE,) float64 zeros, state
    track : (readings, TRACK_COLUMNS) float64 scratch
    s, w : a fresh run
    """
    while True:
        event = advance(s, w)
        if event == END:
            return
        if event == SAMPLE:
            on_sample(kind, p, m, track, s, w)
        elif event == TICK:
            s.demand_m = on_tick(kind, p, m, track, s, w)


def run_jitted(kind: int, params: tuple[float, ...], s: Any, w: World) -> None:
    """Run one baseline with its parameters in a fresh run."""
    track = np.empty((max(1, len(w.readings)), TRACK_COLUMNS))
    run_baseline(kind, np.array(params, np.float64), np.zeros(STATE_SIZE), track, s, w)
