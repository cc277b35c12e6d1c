"""Natural frequency and damping from a recorded ring-down (paper §4: an accelerometer at the tip)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from surffollow.errors import ScanInputError
from surffollow.scan.checks import Floats, positive, real_array

MIN_PERIODS = 2.0
MIN_EXPLAINED = 0.5  # part of the variance that the mode must explain
FREQUENCY_SPAN = 1.5  # the fit keeps within this factor of the spectrum's peak
HIGHEST_DAMPING = 0.9  # of the fit
MAX_DAMPING = 0.7  # a mode with more hardly swings: a drift or a decay fits as well


@dataclass(frozen=True)
class Mode:
    """One vibration mode.

    Attributes
    ----------
    frequency_hz : float
        undamped natural frequency
    damping : float
        ratio ζ
    amplitude : float
        at the first sample, in the trace's unit
    explained : float
        part of the trace's variance that the fit explains, 0 … 1

    Examples
    --------
    >>> from surffollow.scan import Mode, Shaper
    >>> mode = Mode(frequency_hz=2.0, damping=0.0, amplitude=0.3, explained=0.99)
    >>> Shaper.zv(mode.frequency_hz, mode.damping).duration_s
    0.25
    """

    frequency_hz: float
    damping: float
    amplitude: float
    explained: float


def identify_mode(
    ring_down: ArrayLike, rate_hz: float, *, band_hz: tuple[float, float] | None = None
) -> Mode:
    """The strongest mode of a ring-down.

    Parameters
    ----------
    ring_down : (n,) float
        acceleration or deflection after the motion has ended
    rate_hz : float [Hz]
        samples per second
    band_hz : (low, high) [Hz]
        where to look; None: from two periods in the trace to 0.4 of the rate

    Returns
    -------
    Mode

    Raises
    ------
    ScanInputError
        too short a trace, a band outside it, or a trace that is no damped oscillation

    Notes
    -----
    x(t) = e^{-ζωt} (a cos ω_d t + b sin ω_d t) + c: the spectrum's peak starts a fit over ω and ζ;
    a, b and c follow linearly.

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import identify_mode
    >>> t_s = np.arange(200) / 100.0
    >>> mode = identify_mode(np.exp(-0.4 * t_s) * np.cos(2 * np.pi * 2.5 * t_s), rate_hz=100.0)
    >>> round(mode.frequency_hz, 2), round(mode.damping, 3)
    (2.5, 0.025)
    """
    x = real_array("ring_down", ring_down, (None,))
    rate = positive("rate_hz", rate_hz, "Hz")
    if len(x) < 8 or not np.isfinite(x).all():
        raise ScanInputError(f"a ring-down of {len(x)} samples; expected at least 8, all finite")
    lowest, highest = MIN_PERIODS * rate / len(x), 0.4 * rate
    low, high = (lowest, highest) if band_hz is None else band_hz
    if not (lowest - 1e-9 <= low < high <= 0.5 * rate):
        raise ScanInputError(
            f"the band {low:g} to {high:g} Hz lies outside the trace, which shows {lowest:.3g} "
            f"to {0.5 * rate:g} Hz; "
            "record longer or faster"
        )
    mean = x - x.mean()
    variance = float((mean**2).mean())
    if variance <= 0.0:
        raise ScanInputError("the ring-down is constant; nothing vibrates in it")
    padded = 8 * len(x)
    spectrum = np.abs(np.fft.rfft(mean * np.hanning(2 * len(x))[len(x) :], padded))
    frequencies = np.fft.rfftfreq(padded, 1.0 / rate)
    inside = (frequencies >= low) & (frequencies <= high)
    peak = float(frequencies[inside][np.argmax(spectrum[inside])])
    t = np.arange(len(x)) / rate
    scale = math.sqrt(variance)

    def fit(p: Floats) -> tuple[Floats, Floats]:
        basis = _basis(t, float(np.exp(p[0])), float(p[1]))
        weights, *_ = np.linalg.lstsq(basis, x, rcond=None)
        return np.asarray(basis @ weights - x), np.asarray(weights, np.float64)

    span = math.log(FREQUENCY_SPAN)
    start = math.log(peak)
    found = [
        least_squares(
            lambda p: fit(p)[0] / scale,
            [start, zeta],
            bounds=([start - span, 0.0], [start + span, HIGHEST_DAMPING]),
            x_scale=[0.01, 0.01],
        )
        for zeta in (0.01, 0.1)
    ]
    best = min(found, key=lambda f: float(f.cost))
    left, weights = fit(best.x)
    explained = 1.0 - float((left**2).mean()) / variance
    if explained < MIN_EXPLAINED:
        raise ScanInputError(
            f"one mode explains {100.0 * explained:.0f} % of the trace, expected at least "
            f"{100.0 * MIN_EXPLAINED:.0f} %; cut the motion off, or narrow band_hz around {peak:.3g} Hz"
        )
    found_hz, damping = float(np.exp(best.x[0])), float(best.x[1])
    if damping > MAX_DAMPING:
        raise ScanInputError(
            f"the trace drifts or decays without swinging: the best mode of it has a damping of "
            f"{damping:.2g}, expected at most {MAX_DAMPING:g}; cut the motion off, or take the drift out"
        )
    return Mode(found_hz, damping, float(np.hypot(weights[0], weights[1])), explained)


def _basis(t: Floats, frequency_hz: float, zeta: float) -> Floats:
    omega = 2.0 * math.pi * frequency_hz
    fall, angle = np.exp(-zeta * omega * t), omega * math.sqrt(1.0 - zeta * zeta) * t
    return np.column_stack([fall * np.cos(angle), fall * np.sin(angle), np.ones(len(t))])
