"""Filters of the ground's height for the benchmark's baselines: low-pass, Kalman, Kalman with waves.

A filter updates the state row of a baseline with a reading and notes its estimate in the track.
"""

from __future__ import annotations

import math
from typing import Any

from numpy.typing import NDArray

from surffollow.benchmark import wave_filter as waves
from surffollow.shm.jit import jit

# state row
(STAMP, ERROR, INTEGRAL, HEIGHT, SLOPE, X, P00, P01, P11, REJECTED, COUNT, CURSOR, TARGET) = range(13)
SEEN = 13
# adaptive noise: variance of a reading, logarithm of the process noise's factor, last normalised innovation
R, LN_SCALE, LAST = 14, 15, 16
KEPT, PENDING = 17, 18  # readings that the preview planner keeps, and refused ones behind them
STATE_SIZE = 19

# columns of a track: where readings were accepted, height and slope estimated there
TRACK_X, TRACK_H, TRACK_S = 0, 1, 2
TRACK_COLUMNS = 3

GLITCH_SAMPLES = 3
KALMAN_SIGMA_M = 0.3e-3  # reading and pose noise that the filter assumes
R_RANGE = 400.0  # the adapted variance of a reading stays within this factor of the assumed one
MAX_LN_SCALE = math.log(1000.0)  # likewise the adapted process noise
# by so much ln(process noise) follows the correlation of successive innovations in one memory
WHITENESS = 5.0
MIN_PRODUCT, MAX_PRODUCT = -4.0, 4.0  # of two normalised innovations: one reading decides nothing
REFUSED, TAKEN, RESET = 0, 1, 2  # outcome of a filter for a reading


@jit
def note_estimate(m: NDArray[Any], track: NDArray[Any]) -> None:
    """Append the estimate to the track."""
    n = int(m[COUNT])
    track[n, TRACK_X] = m[X]
    track[n, TRACK_H] = m[HEIGHT]
    track[n, TRACK_S] = m[SLOPE]
    m[COUNT] = n + 1


@jit
def height_at(m: NDArray[Any], track: NDArray[Any], x_m: float) -> float:
    """Estimated height at x: from the track where a leading sensor has been, else by the last slope."""
    n = int(m[COUNT])
    if x_m >= m[X] or n < 2:
        return float(m[HEIGHT] + m[SLOPE] * (x_m - m[X]))
    i = int(m[CURSOR])
    while i < n - 2 and track[i + 1, TRACK_X] < x_m:
        i += 1
    m[CURSOR] = i
    gap = track[i + 1, TRACK_X] - track[i, TRACK_X]
    if gap <= 0.0 or x_m <= track[i, TRACK_X]:
        return float(track[i, TRACK_H])
    f = (x_m - track[i, TRACK_X]) / gap
    return float(track[i, TRACK_H] + f * (track[i + 1, TRACK_H] - track[i, TRACK_H]))


@jit
def update_low_pass(
    p: NDArray[Any], m: NDArray[Any], track: NDArray[Any], dt_s: float, x_m: float, h_m: float
) -> None:
    """Low-pass the height; a jump beyond the gate must be seen three times.

    Parameters
    ----------
    p : (≥ 2,) float64         τ [s], gate [m], lag [s]
    m : (STATE_SIZE,) float64  state row, updated
    track : (n, TRACK_COLUMNS) float64  receives the estimate
    dt_s : float [s]           since the reading before
    x_m, h_m : float [m]       place and height of the reading
    """
    if m[COUNT] > 0 and abs(h_m - m[HEIGHT]) > p[1]:
        m[REJECTED] += 1
        if m[REJECTED] < GLITCH_SAMPLES:
            return
        m[HEIGHT] = h_m
    elif m[COUNT] == 0:
        m[HEIGHT] = h_m
    else:
        m[HEIGHT] += (1.0 - math.exp(-dt_s / p[0])) * (h_m - m[HEIGHT])
    m[REJECTED] = 0
    m[X] = x_m
    note_estimate(m, track)


@jit
def propagate(m: NDArray[Any], dx: float, qs: float, qh: float) -> tuple[float, float, float, float]:
    """Height and covariance of the [height, slope] filter after a distance.

    Parameters
    ----------
    m : (STATE_SIZE,) float64  state row
    dx : float [m]             the distance
    qs, qh : float             noise densities of slope and height [1/m, m²/m]

    Returns
    -------
    float [m], 3 × float
    """
    h = m[HEIGHT] + m[SLOPE] * dx
    p00 = m[P00] + 2.0 * dx * m[P01] + dx * dx * m[P11] + qs * dx * dx * dx / 3.0 + qh * dx
    p01 = m[P01] + dx * m[P11] + 0.5 * qs * dx * dx
    p11 = m[P11] + qs * dx
    return h, p00, p01, p11


@jit
def correct(
    m: NDArray[Any], h: float, p00: float, p01: float, p11: float, innovation: float, variance: float
) -> tuple[float, float, float, float]:
    """Correct height, slope and covariance by an innovation; the slope in the state row.

    Parameters
    ----------
    m : (STATE_SIZE,) float64  state row; its slope is updated
    h, p00, p01, p11 : float   height and covariance, as propagated
    innovation : float [m]
    variance : float [m²]      of the innovation
    """
    k0, k1 = p00 / variance, p01 / variance
    m[SLOPE] += k1 * innovation
    return h + k0 * innovation, p00 - k0 * p00, p01 - k0 * p01, p11 - k1 * p01


@jit
def adapt_noise(
    m: NDArray[Any], innovation: float, variance: float, k0: float, p00: float, memory: float
) -> None:
    """Adapt the noise to the innovation.

    The variance of a reading follows residual² + P₀₀ after the update (covariance matching). The process
    noise grows while successive innovations have the same sign and falls while they alternate, because those
    of an optimal filter are white. Both from the variance of the innovation alone would not be observable.

    Parameters
    ----------
    m : (STATE_SIZE,) float64  state row, updated
    innovation : float [m]
    variance : float [m²]      of the innovation
    k0 : float                 gain of the height
    p00 : float [m²]           variance of the height after the update
    memory : float             readings that the adaptation averages
    """
    share = 1.0 / memory
    residual = (1.0 - k0) * innovation
    m[R] += share * (residual * residual + p00 - m[R])
    r = KALMAN_SIGMA_M * KALMAN_SIGMA_M
    m[R] = min(max(m[R], r / R_RANGE), r * R_RANGE)
    normalised = innovation / math.sqrt(variance)
    product = min(max(normalised * m[LAST], MIN_PRODUCT), MAX_PRODUCT)
    m[LN_SCALE] = min(max(m[LN_SCALE] + WHITENESS * share * product, -MAX_LN_SCALE), MAX_LN_SCALE)
    m[LAST] = normalised


@jit
def update_kalman(
    p: NDArray[Any], m: NDArray[Any], track: NDArray[Any], x_m: float, h_m: float, memory: float
) -> int:
    """Update height and slope.

    Parameters
    ----------
    p : (≥ 4,) float64         slope noise, height noise, gate [σ], rejects to reset
    m : (STATE_SIZE,) float64  state row, updated
    track : (n, TRACK_COLUMNS) float64  receives the estimate
    x_m, h_m : float [m]       place and height of the reading
    memory : float             readings that the adaptation of the noise averages; 0: noise as given

    Returns
    -------
    int  REFUSED, TAKEN or RESET
    """
    r = KALMAN_SIGMA_M * KALMAN_SIGMA_M
    if m[COUNT] == 0:
        m[HEIGHT], m[SLOPE], m[X] = h_m, 0.0, x_m
        m[P00], m[P01], m[P11] = r, 0.0, 1e-2
        m[R] = r
        note_estimate(m, track)
        return TAKEN
    dx = max(x_m - m[X], 0.0)
    qs, qh = p[0] * p[0], p[1] * p[1]
    if memory > 0.0:
        r = m[R]
        scale = math.exp(m[LN_SCALE])
        qs, qh = qs * scale, qh * scale
    h, p00, p01, p11 = propagate(m, dx, qs, qh)
    innovation = h_m - h
    variance = p00 + r
    made = TAKEN
    if innovation * innovation > p[2] * p[2] * variance:
        m[REJECTED] += 1
        if m[REJECTED] < p[3]:
            return REFUSED
        # time-out: what was refused so often is the ground now; its slope is as it was, but less sure
        h = h_m
        p00, p01, p11 = r, 0.0, p11 + 1e-3
        made = RESET
    else:
        k0 = p00 / variance
        h, p00, p01, p11 = correct(m, h, p00, p01, p11, innovation, variance)
        if memory > 0.0:
            adapt_noise(m, innovation, variance, k0, p00, memory)
    m[HEIGHT], m[X] = h, max(x_m, m[X])
    m[P00], m[P01], m[P11] = p00, p01, p11
    m[REJECTED] = 0
    note_estimate(m, track)
    return made


@jit
def update_waves(
    p: NDArray[Any],
    m: NDArray[Any],
    track: NDArray[Any],
    f: NDArray[Any],
    x_m: float,
    h_m: float,
    ahead_m: float,
) -> None:
    """Update [height, slope] filter and wave models.

    The gate is that of the model which is selected.

    Parameters
    ----------
    p : (≥ 7,) float64           as in `update_kalman`, lag [s], wavelength [m], wave noise
    m : (STATE_SIZE,) float64    state row, updated
    track : (n, TRACK_COLUMNS) float64  receives the estimate
    f : (ROWS, COLUMNS) float64  bank of `wave_filter`, updated
    x_m, h_m : float [m]         place and height of the reading
    ahead_m : float [m]          distance ahead at which the prediction is used
    """
    r = KALMAN_SIGMA_M * KALMAN_SIGMA_M
    if m[COUNT] == 0:
        update_kalman(p, m, track, x_m, h_m, 0.0)
        waves.initialise(f, p[5], x_m, h_m)
        return
    dx = max(x_m - m[X], 0.0)
    qs, qh, qw = p[0] * p[0], p[1] * p[1], p[6] * p[6]
    h, p00, p01, p11 = propagate(m, dx, qs, qh)
    innovation = h_m - h
    variance = p00 + r
    j = waves.selected(f)
    off, gate = innovation, variance
    if j != waves.SLOPE_MODEL:
        off = h_m - waves.height(f, j, dx)
        gate = waves.variance(f, j) + qh * dx + qw * dx + r
    jumped = off * off > p[2] * p[2] * gate
    if jumped:
        m[REJECTED] += 1
        if m[REJECTED] < p[3]:
            return
    waves.propagate(f, dx, qh, qw)
    if jumped:
        h = h_m
        p00, p01, p11 = r, 0.0, p11 + 1e-3
        waves.shift(f, h_m)
    else:
        h, p00, p01, p11 = correct(m, h, p00, p01, p11, innovation, variance)
        waves.update(f, h_m, r)
    m[HEIGHT], m[X] = h, max(x_m, m[X])
    m[P00], m[P01], m[P11] = p00, p01, p11
    m[REJECTED] = 0
    waves.score(f, m[X], h_m)
    waves.predict(f, m[X], ahead_m, m[HEIGHT] + m[SLOPE] * ahead_m)
    note_estimate(m, track)
    j = waves.selected(f)
    if j != waves.SLOPE_MODEL:
        track[int(m[COUNT]) - 1, TRACK_H] = waves.height(f, j, 0.0)
        track[int(m[COUNT]) - 1, TRACK_S] = waves.slope(f, j, 0.0)
