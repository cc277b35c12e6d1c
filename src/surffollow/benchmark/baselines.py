"""The hand-made loops that a follower is judged against, jitted together with their run.

All get the same stamped data: readings with their stamps, poses interpolated to those stamps. A method is
two functions, one for a reading and one for a controller tick, on a parameter row and a state row.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.benchmark import preview_planner as planner
from surffollow.benchmark import wave_filter as waves
from surffollow.benchmark.loop import END, SAMPLE, STEP_S, TICK, World, advance
from surffollow.shm.jit import jit

HOLD, P, PI, LPF_GATE, KALMAN_FF, KALMAN_WAVE, KALMAN_ADAPTIVE, PREVIEW = range(8)

# state row
(_STAMP, _ERROR, _INTEGRAL, _HEIGHT, _SLOPE, _X, _P00, _P01, _P11, _REJECTED, _COUNT, _CURSOR, _TARGET) = (
    range(13)
)
_SEEN = 13
# adaptive noise: variance of a reading, logarithm of the process noise's factor, last normalised innovation
_R, _LN_SCALE, _LAST = 14, 15, 16
_KEPT, _PENDING = 17, 18  # readings that the preview planner keeps, and refused ones behind them
STATE_SIZE = 19

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
R_RANGE = 400.0  # the adapted variance of a reading stays within this factor of the assumed one
LN_SCALE = math.log(1000.0)  # likewise the adapted process noise
WHITENESS = (
    5.0  # by so much ln(process noise) follows the correlation of successive innovations in one memory
)
LEAST_PRODUCT, GREATEST_PRODUCT = -4.0, 4.0  # of two normalised innovations: one reading decides nothing
REFUSED, TAKEN, RESET = 0, 1, 2  # what a filter made of a reading


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
def _propagated(m: NDArray[Any], dx: float, qs: float, qh: float) -> tuple[float, float, float, float]:
    """Height and covariance of the [height, slope] filter after a distance."""
    h = m[_HEIGHT] + m[_SLOPE] * dx
    p00 = m[_P00] + 2.0 * dx * m[_P01] + dx * dx * m[_P11] + qs * dx * dx * dx / 3.0 + qh * dx
    p01 = m[_P01] + dx * m[_P11] + 0.5 * qs * dx * dx
    p11 = m[_P11] + qs * dx
    return h, p00, p01, p11


@jit
def _adapt(m: NDArray[Any], innovation: float, variance: float, k0: float, p00: float, memory: float) -> None:
    """Adapt the noise to the innovation.

    The variance of a reading follows residual² + P₀₀ after the update (covariance matching). The process
    noise grows while successive innovations have the same sign and falls while they alternate, because those
    of an optimal filter are white. Both from the variance of the innovation alone would not be observable.
    """
    share = 1.0 / memory
    residual = (1.0 - k0) * innovation
    m[_R] += share * (residual * residual + p00 - m[_R])
    r = KALMAN_SIGMA_M * KALMAN_SIGMA_M
    m[_R] = min(max(m[_R], r / R_RANGE), r * R_RANGE)
    normalised = innovation / math.sqrt(variance)
    product = min(max(normalised * m[_LAST], LEAST_PRODUCT), GREATEST_PRODUCT)
    m[_LN_SCALE] = min(max(m[_LN_SCALE] + WHITENESS * share * product, -LN_SCALE), LN_SCALE)
    m[_LAST] = normalised


@jit
def _kalman_sample(
    p: NDArray[Any], m: NDArray[Any], track: NDArray[Any], x_m: float, h_m: float, memory: float
) -> int:
    """Update height and slope (p: slope noise, height noise, gate [σ], rejects to reset).

    `memory` is how many readings the adaptation of the noise averages; 0 keeps the noise as given.
    """
    r = KALMAN_SIGMA_M * KALMAN_SIGMA_M
    if m[_COUNT] == 0:
        m[_HEIGHT], m[_SLOPE], m[_X] = h_m, 0.0, x_m
        m[_P00], m[_P01], m[_P11] = r, 0.0, 1e-2
        m[_R] = r
        _note(m, track)
        return TAKEN
    dx = max(x_m - m[_X], 0.0)
    qs, qh = p[0] * p[0], p[1] * p[1]
    if memory > 0.0:
        r = m[_R]
        scale = math.exp(m[_LN_SCALE])
        qs, qh = qs * scale, qh * scale
    h, p00, p01, p11 = _propagated(m, dx, qs, qh)
    innovation = h_m - h
    variance = p00 + r
    made = TAKEN
    if innovation * innovation > p[2] * p[2] * variance:
        m[_REJECTED] += 1
        if m[_REJECTED] < p[3]:
            return REFUSED
        # time-out: what was refused so often is the ground now; its slope is as it was, but less sure
        h = h_m
        p00, p01, p11 = r, 0.0, p11 + 1e-3
        made = RESET
    else:
        k0, k1 = p00 / variance, p01 / variance
        h += k0 * innovation
        m[_SLOPE] += k1 * innovation
        p11 -= k1 * p01
        p01 -= k0 * p01
        p00 -= k0 * p00
        if memory > 0.0:
            _adapt(m, innovation, variance, k0, p00, memory)
    m[_HEIGHT], m[_X] = h, max(x_m, m[_X])
    m[_P00], m[_P01], m[_P11] = p00, p01, p11
    m[_REJECTED] = 0
    _note(m, track)
    return made


@jit
def _wave_sample(
    p: NDArray[Any],
    m: NDArray[Any],
    track: NDArray[Any],
    f: NDArray[Any],
    x_m: float,
    h_m: float,
    ahead_m: float,
) -> None:
    """Update [height, slope] filter and wave models (p: as above, lag [s], wavelength [m], wave noise).

    The gate is that of the model which is selected. `ahead_m` is how far ahead its prediction is used.
    """
    r = KALMAN_SIGMA_M * KALMAN_SIGMA_M
    if m[_COUNT] == 0:
        _kalman_sample(p, m, track, x_m, h_m, 0.0)
        waves.initialise(f, p[5], x_m, h_m)
        return
    dx = max(x_m - m[_X], 0.0)
    qs, qh, qw = p[0] * p[0], p[1] * p[1], p[6] * p[6]
    h, p00, p01, p11 = _propagated(m, dx, qs, qh)
    innovation = h_m - h
    variance = p00 + r
    j = waves.selected(f)
    off, gate = innovation, variance
    if j != waves.SLOPE_MODEL:
        off = h_m - waves.height(f, j, dx)
        gate = waves.variance(f, j) + qh * dx + qw * dx + r
    jumped = off * off > p[2] * p[2] * gate
    if jumped:
        m[_REJECTED] += 1
        if m[_REJECTED] < p[3]:
            return
    waves.propagate(f, dx, qh, qw)
    if jumped:
        h = h_m
        p00, p01, p11 = r, 0.0, p11 + 1e-3
        waves.shift(f, h_m)
    else:
        k0, k1 = p00 / variance, p01 / variance
        h += k0 * innovation
        m[_SLOPE] += k1 * innovation
        p11 -= k1 * p01
        p01 -= k0 * p01
        p00 -= k0 * p00
        waves.update(f, h_m, r)
    m[_HEIGHT], m[_X] = h, max(x_m, m[_X])
    m[_P00], m[_P01], m[_P11] = p00, p01, p11
    m[_REJECTED] = 0
    waves.score(f, m[_X], h_m)
    waves.predict(f, m[_X], ahead_m, m[_HEIGHT] + m[_SLOPE] * ahead_m)
    _note(m, track)
    j = waves.selected(f)
    if j != waves.SLOPE_MODEL:
        track[int(m[_COUNT]) - 1, _TRACK_H] = waves.height(f, j, 0.0)
        track[int(m[_COUNT]) - 1, _TRACK_S] = waves.slope(f, j, 0.0)


@jit
def _wave_target(
    p: NDArray[Any], m: NDArray[Any], track: NDArray[Any], f: NDArray[Any], s: Any, x_m: float, v_mps: float
) -> float:
    """Height for the tool: x is the place one lag ahead; a wave's part for the axis is τ · v · slope."""
    j = waves.selected(f)
    if j == waves.SLOPE_MODEL:
        return float(_height_at(m, track, x_m))
    back = min(s.tau_s, p[4])
    here = x_m - v_mps * back
    if here < m[_X]:
        return _height_at(m, track, x_m) if x_m < m[_X] else float(waves.height(f, j, x_m - m[_X]))
    ahead = here - m[_X]
    return float(waves.height(f, j, ahead) + back * v_mps * waves.slope(f, j, ahead))


@jit
def _keep_reading(m: NDArray[Any], seen: NDArray[Any], made: int, x_m: float, h_m: float) -> None:
    """Keep a reading for the preview planner; refused ones count when the filter is reset to them."""
    kept, pending = int(m[_KEPT]), int(m[_PENDING])
    at = kept if made == TAKEN else kept + pending
    if at < seen.shape[0]:
        seen[at, 0], seen[at, 1] = x_m, h_m
    if made == REFUSED:
        m[_PENDING] = pending + 1
        return
    m[_KEPT] = min(at + 1, seen.shape[0])
    m[_PENDING] = 0.0


@jit
def _planned(
    p: NDArray[Any],
    m: NDArray[Any],
    seen: NDArray[Any],
    g: NDArray[Any],
    s: Any,
    w: World,
    x_m: float,
    v_mps: float,
) -> float:
    """Setpoint of the preview planner (p: as above, smoothing width [m], effort [s⁴]); x is that of now."""
    wanted = planner.reference(g)
    count = int(m[_KEPT])
    cursor = int(m[_CURSOR])
    way = v_mps * s.tick_ms * STEP_S
    for k in range(planner.PERIODS):
        x = min(x_m + (k + 1) * way, m[_X])  # behind the last reading: its height
        h, cursor = planner.smoothed(seen, cursor, count, x, p[4])
        if k == 0:
            m[_CURSOR] = cursor
        wanted[k] = h + s.standoff_m
    last = w.reports[s.poses - 1]
    return float(planner.set_point(g, p[5], s.poses, float(last.ms), last.z, s))


@jit
def on_sample(
    kind: int,
    p: NDArray[Any],
    m: NDArray[Any],
    track: NDArray[Any],
    memory: NDArray[Any],
    s: Any,
    w: World,
) -> None:
    """Take the reading that has just arrived (index `samples` − 1)."""
    i = s.samples - 1
    r = w.readings[i].range
    if not math.isfinite(r):
        return
    stamp = w.readings[i].told_ms
    dt_s = (stamp - m[_STAMP]) * STEP_S if m[_SEEN] > 0.0 else 0.0
    m[_STAMP] = stamp
    m[_SEEN] = 1.0
    m[_ERROR] = r - s.standoff_m
    if kind < LPF_GATE:
        return
    x, z = pose_at(s, w, stamp)
    if not math.isfinite(z):
        return
    x, h = x + s.lead_m, z - r
    if kind == LPF_GATE:
        _lpf_sample(p, m, track, dt_s, x, h)
    elif kind == KALMAN_WAVE:
        late_s = (s.ms - stamp) * STEP_S
        ahead = max(lateral_speed(s, w) * (late_s + p[4]) - s.lead_m, 0.0)
        _wave_sample(p, m, track, memory, x, h, ahead)
    elif kind == PREVIEW:
        _keep_reading(m, memory, _kalman_sample(p, m, track, x, h, 0.0), x, h)
    else:
        _kalman_sample(p, m, track, x, h, p[5] if kind == KALMAN_ADAPTIVE else 0.0)


@jit
def on_tick(
    kind: int,
    p: NDArray[Any],
    m: NDArray[Any],
    track: NDArray[Any],
    memory: NDArray[Any],
    plan: NDArray[Any],
    s: Any,
    w: World,
) -> float:
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
            patience_ms = max(
                patience_ms, READING_TIMEOUT_PERIODS * (w.readings[1].told_ms - w.readings[0].told_ms)
            )
        if s.ms - m[_STAMP] > patience_ms + (w.readings[0].arrival_ms - w.readings[0].told_ms):
            return 0.0
        if kind == P:
            return float(-p[0] * m[_ERROR])
        m[_INTEGRAL] -= p[1] * m[_ERROR] * s.tick_ms * STEP_S
        m[_INTEGRAL] = min(max(m[_INTEGRAL], -INTEGRAL_LIMIT_M), INTEGRAL_LIMIT_M)
        return float(-p[0] * m[_ERROR] + m[_INTEGRAL])
    if m[_COUNT] == 0.0:
        return 0.0
    ahead_s = (s.ms - w.reports[s.poses - 1].ms) * STEP_S
    v = lateral_speed(s, w)
    if kind == PREVIEW:
        return float(_planned(p, m, memory, plan, s, w, w.reports[s.poses - 1].x + v * ahead_s, v) - z_report)
    lag_s = p[2] if kind == LPF_GATE else p[4]
    x = w.reports[s.poses - 1].x + v * (ahead_s + lag_s)
    if kind == KALMAN_WAVE:
        return float(_wave_target(p, m, track, memory, s, x, v) + s.standoff_m - z_report)
    lost_ms = s.ms - m[_STAMP] - (w.readings[0].arrival_ms - w.readings[0].told_ms)
    if not (kind == KALMAN_FF and p[5] == POLICY_HOLD and lost_ms > DROPOUT_AFTER_MS):
        m[_TARGET] = _height_at(m, track, x) + s.standoff_m
    return float(m[_TARGET] - z_report)


@jit
def run_baseline(
    kind: int,
    p: NDArray[Any],
    m: NDArray[Any],
    track: NDArray[Any],
    memory: NDArray[Any],
    plan: NDArray[Any],
    s: Any,
    w: World,
) -> None:
    """Run one baseline to the end of the path.

    Parameters
    ----------
    kind, p, m : which, its parameters, its state row (`STATE_SIZE`) of zeros
    track : (readings, `TRACK_COLUMNS`) float64, room for one estimate per reading
    memory, plan : what some kinds need beside, see `run_jitted`
    s, w : a fresh run
    """
    while True:
        event = advance(s, w)
        if event == END:
            return
        if event == SAMPLE:
            on_sample(kind, p, m, track, memory, s, w)
        elif event == TICK:
            s.demand_m = on_tick(kind, p, m, track, memory, plan, s, w)


def run_jitted(kind: int, params: tuple[float, ...], s: Any, w: World) -> None:
    """Run one baseline with its parameters in a fresh run."""
    count = max(1, len(w.readings))
    track = np.empty((count, TRACK_COLUMNS))
    memory = plan = np.empty((1, 1))
    if kind == KALMAN_WAVE:
        memory = waves.new_bank()
    elif kind == PREVIEW:
        memory, plan = np.empty((count, 2)), planner.new_planner()
    run_baseline(kind, np.array(params, np.float64), np.zeros(STATE_SIZE), track, memory, plan, s, w)
