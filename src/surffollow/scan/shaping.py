"""Command shaping: zero-vibration, ZVD and extra-insensitive impulses for one or more modes (paper §4.2)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from surffollow.errors import ScanInputError
from surffollow.scan.checks import Floats, finite, positive, real_array

EI_TOLERANCE = 0.05  # residual at the design frequency that an EI shaper admits


@dataclass(frozen=True)
class Shaper:
    """Impulses that a command is convolved with.

    Attributes
    ----------
    times_s : (n,) float64 [s]
        ascending, from 0
    amplitudes : (n,) float64
        above 0, their sum is 1
    highest_hz : float
        highest design frequency; 0: none

    Examples
    --------
    >>> from surffollow.scan import Shaper
    >>> shaper = Shaper.zvd(2.0)
    >>> shaper.times_s, shaper.amplitudes
    (array([0.  , 0.25, 0.5 ]), array([0.25, 0.5 , 0.25]))
    """

    times_s: Floats
    amplitudes: Floats
    highest_hz: float = 0.0

    @classmethod
    def none(cls) -> Shaper:
        """One impulse: the command as it is."""
        return cls(np.zeros(1), np.ones(1))

    @classmethod
    def zv(cls, frequency_hz: float, damping: float = 0.0) -> Shaper:
        """Zero vibration: two impulses, [1, K] / (1 + K) at 0 and T_d / 2.

        Parameters
        ----------
        frequency_hz : float [Hz]
            undamped natural frequency, above 0
        damping : float
            ratio ζ, 0 ≤ ζ < 1

        Returns
        -------
        Shaper
            two impulses
        """
        k, period = _constants(frequency_hz, damping)
        return cls(np.array([0.0, period / 2]), np.array([1.0, k]) / (1.0 + k), float(frequency_hz))

    @classmethod
    def zvd(cls, frequency_hz: float, damping: float = 0.0) -> Shaper:
        """Zero vibration and derivative: [1, 2K, K²] / (1 + K)² at 0, T_d / 2, T_d.

        Parameters
        ----------
        frequency_hz, damping : float
            as for `zv`

        Returns
        -------
        Shaper
            three impulses: ZV convolved with itself

        Notes
        -----
        K = exp(-ζπ / √(1 - ζ²)), T_d = 1 / (f √(1 - ζ²)) (Singer and Seering 1990, the paper's ref. 11).
        """
        k, period = _constants(frequency_hz, damping)
        made = np.array([1.0, 2.0 * k, k * k]) / (1.0 + k) ** 2
        return cls(np.array([0.0, period / 2, period]), made, float(frequency_hz))

    @classmethod
    def ei(cls, frequency_hz: float, damping: float = 0.0, *, tolerance: float = EI_TOLERANCE) -> Shaper:
        """Extra insensitive: a little residual at the design frequency for a wider range around it.

        Parameters
        ----------
        frequency_hz, damping : float
            as for `zv`
        tolerance : float
            residual V at the design frequency without damping, 0 ≤ V < 1

        Returns
        -------
        Shaper
            three impulses

        Notes
        -----
        [(1 + V) / 4, (1 - V) K / 2, (1 + V) K² / 4], normalised, at 0, T_d / 2, T_d, with V the tolerance.
        The residual at the design frequency is V K² / (sum before normalisation), V without damping.
        """
        v = finite("tolerance", tolerance, "1")
        if not 0.0 <= v < 1.0:
            raise ScanInputError(f"tolerance is {v:g}; expected 0 ≤ tolerance < 1")
        k, period = _constants(frequency_hz, damping)
        made = np.array([(1.0 + v) / 4.0, (1.0 - v) * k / 2.0, (1.0 + v) * k * k / 4.0])
        return cls(np.array([0.0, period / 2, period]), made / made.sum(), float(frequency_hz))

    def __mul__(self, other: Shaper) -> Shaper:
        """Both shapers, one after the other: for two modes."""
        times = (self.times_s[:, None] + other.times_s[None, :]).reshape(-1)
        sizes = (self.amplitudes[:, None] * other.amplitudes[None, :]).reshape(-1)
        order = np.argsort(times, kind="stable")
        return Shaper(times[order], sizes[order], max(self.highest_hz, other.highest_hz))

    @property
    def duration_s(self) -> float:
        """How much longer a shaped command takes [s]."""
        return float(self.times_s[-1])

    def residual(self, frequency_hz: ArrayLike, damping: float = 0.0) -> Floats:
        """Residual vibration of a mode, as a part of the unshaped one, after the last impulse.

        Parameters
        ----------
        frequency_hz : float [Hz]
            of the mode; may be an array
        damping : float
            ratio ζ, 0 ≤ ζ < 1

        Returns
        -------
        float64
            residual vibration as a part of the unshaped one, in the shape of `frequency_hz`

        Notes
        -----
        V = exp(-ζ ω t_n) √(C² + S²), C and S the sums of A_i exp(ζ ω t_i) times cos and sin of ω_d t_i.

        Examples
        --------
        >>> import numpy as np
        >>> from surffollow.scan import Shaper
        >>> np.round(Shaper.zv(2.0).residual([2.0, 2.2]), 3) + 0.0
        array([0.   , 0.156])
        """
        zeta = _damping(damping)
        omega = 2.0 * math.pi * np.asarray(frequency_hz, np.float64)[..., None]
        angle = (1j * math.sqrt(1.0 - zeta * zeta) + zeta) * omega * self.times_s
        last = np.exp(-zeta * omega[..., 0] * self.times_s[-1])
        return np.asarray(last * np.abs((self.amplitudes * np.exp(angle)).sum(axis=-1)))

    def function(self, command: Callable[[Floats], Floats]) -> Callable[[Floats], Floats]:
        """A command of time, shaped: evaluated at the shifted times, so that no impulse is rounded.

        Parameters
        ----------
        command : callable
            a function of time [s]

        Returns
        -------
        callable
            the shaped command, a function of time [s]
        """

        def shaped(t_s: Floats) -> Floats:
            made: Floats = sum(
                (a * command(t_s - s) for s, a in zip(self.times_s, self.amplitudes)), np.float64(0.0)
            )
            return made

        return shaped

    def shape(self, command: ArrayLike, rate_hz: float) -> Floats:
        """A sampled command, shaped, with the tail that the last impulse adds.

        Parameters
        ----------
        command : (n,) or (n, m) float
            at rest before its first and after its last sample
        rate_hz : float [Hz]

        Returns
        -------
        (n + ⌈duration × rate⌉, …) float64
            linear between samples; impulses are not rounded to samples

        Raises
        ------
        ScanInputError
            a trace shorter than the shaper, or a design frequency at or above half the rate

        Examples
        --------
        >>> import numpy as np
        >>> from surffollow.scan import Shaper
        >>> Shaper.zv(2.0).shape([0.0, 1.0, 1.0], rate_hz=8.0)    # half at once, half after 0.25 s
        array([0. , 0.5, 0.5, 1. , 1. ])
        """
        given = np.asarray(command, np.float64)
        columns = given.reshape(given.shape[0], math.prod(given.shape[1:])) if given.ndim else given
        q = real_array("command", columns, (None, None))
        rate = positive("rate_hz", rate_hz, "Hz")
        if self.highest_hz >= 0.5 * rate:
            raise ScanInputError(
                f"the shaper is for {self.highest_hz:g} Hz, the trace has {rate:g} samples per second; "
                "expected a frequency below half of that"
            )
        if (len(q) - 1) / rate < self.duration_s:
            raise ScanInputError(
                f"the shaper lasts {self.duration_s:g} s, the trace {max(len(q) - 1, 0) / rate:g} s; its "
                "frequency lies outside the trace"
            )
        if not np.isfinite(q).all():
            raise ScanInputError("command has values that are not finite; shape its planned parts one by one")
        more = math.ceil(self.duration_s * rate - 1e-9)
        t = np.arange(len(q) + more) / rate
        own = np.arange(len(q)) / rate
        made = np.zeros((len(t), q.shape[1]))
        for s, a in zip(self.times_s, self.amplitudes):
            for k in range(q.shape[1]):
                made[:, k] += a * np.interp(t - s, own, q[:, k])
        return made.reshape(len(t), *given.shape[1:])


def _damping(damping: float) -> float:
    zeta = finite("damping", damping, "1")
    if not 0.0 <= zeta < 1.0:
        raise ScanInputError(f"damping is {zeta:g}; expected a ratio 0 ≤ ζ < 1")
    return zeta


def _constants(frequency_hz: float, damping: float) -> tuple[float, float]:
    """K and T_d."""
    root = math.sqrt(1.0 - _damping(damping) ** 2)
    return math.exp(-damping * math.pi / root), 1.0 / (positive("frequency_hz", frequency_hz, "Hz") * root)
