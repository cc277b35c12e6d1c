"""Faults of a range sensor in the jobs of `scale_cases`: what the follower gets in place of a reading."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from scale_cases import Case
from surffollow.benchmark.scene import START_NS

P_SHARE = 0.5  # of the delay margin, in the gain of the P loop
P_TIMEOUT_TAUS, P_TIMEOUT_INTERVALS = 3.25, 2.5
BEGIN = 0.35  # of the run
# lengths, in τ or in three intervals if that is more
FAILS, ONCE, SHORT, TO_THE_END = (4.0, 40.0), (0.0, 2.0), (1.0, 4.0), (1e9, 1e9)


@dataclass(frozen=True)
class Fault:
    """Size in stand-offs (of late stamps in τ) and length, uniform; `signed`: the size has either sign.

    `misread(range, held, size, noise, generator)` gives the reading: from the range, the one when the fault
    began, the size in metres and the noise of the sensor. NaN: no reading.
    """

    size: tuple[float, float]
    length: tuple[float, float]
    misread: Callable[[float, float, float, float, np.random.Generator], float]
    signed: bool = False


FAULTS = {
    "stuck": Fault((0.0, 0.05), FAILS, lambda r, h, a, s, g: h + a + 0.05 * s * g.integers(0, 2), True),
    "blocked": Fault((0.0, 0.2), FAILS, lambda r, h, a, s, g: h + a + s * g.standard_normal(), True),
    "frozen": Fault((0.0, 0.0), FAILS, lambda r, h, a, s, g: h + 0.3 * s * g.standard_normal()),
    "held": Fault((0.0, 0.0), (0.5, 8.0), lambda r, h, a, s, g: h),
    "biased": Fault((0.0, 0.1), FAILS, lambda r, h, a, s, g: r + a, True),
    "near": Fault((0.1, 0.4), ONCE, lambda r, h, a, s, g: r - a),
    "burst": Fault((0.03, 0.28), SHORT, lambda r, h, a, s, g: r + a * g.uniform(-1.0, 1.0)),
    "glitches": Fault(
        (0.0, 0.3), TO_THE_END, lambda r, h, a, s, g: r + a * g.uniform(-1.0, 1.0) * (g.random() < 0.15)
    ),
    "far outliers": Fault(
        (0.05, 0.4), TO_THE_END, lambda r, h, a, s, g: r + a * g.random() * (g.random() < 0.3)
    ),
    "near outliers": Fault(
        (0.05, 0.4), TO_THE_END, lambda r, h, a, s, g: r - a * g.random() * (g.random() < 0.3)
    ),
    "lost": Fault((0.0, 0.0), FAILS, lambda r, h, a, s, g: math.nan),
    "mostly lost": Fault((0.0, 0.0), TO_THE_END, lambda r, h, a, s, g: r if g.random() < 0.3 else math.nan),
    "gain": Fault((0.0, 0.4), TO_THE_END, lambda r, h, a, s, g: r + a * (r / h), True),
    "coarse counts": Fault((0.002, 0.05), TO_THE_END, lambda r, h, a, s, g: a * round(r / a)),
    "much noise": Fault((0.01, 0.15), TO_THE_END, lambda r, h, a, s, g: r + a * g.standard_normal()),
    "late stamps": Fault((1.5, 4.0), FAILS, lambda r, h, a, s, g: r),
}


class PLoop:
    """A plain P loop on the distance: it sets a height per reading, and holds it for a while."""

    def __init__(self, case: Case) -> None:
        dead_s = case.latency_s + 0.5 / case.sensor_hz + 0.01 + 0.5 / case.pose_hz
        self._gain = min(1.3, P_SHARE * (case.tau_s + dead_s) / dead_s)
        self._timeout_ns = 1e9 * max(P_TIMEOUT_TAUS * case.tau_s, P_TIMEOUT_INTERVALS / case.sensor_hz)
        self._standoff_m, self._z_m, self._target_m = case.standoff_m, 0.0, 0.0
        self._t_ns, self._now_ns = -(1 << 60), 0

    def pose(self, t_ns: int, pose: Any) -> None:
        """Only the height is used."""
        self._z_m = float(pose[2])

    def step(self, t_ns: int, ranges_m: Any) -> list[float]:
        """The demand, 0 when the last reading is too old."""
        if math.isfinite(ranges_m[0]):
            self._target_m = self._z_m - self._gain * (float(ranges_m[0]) - self._standoff_m)
            self._t_ns = t_ns
        self._now_ns = max(self._now_ns, t_ns)
        recent = self._now_ns - self._t_ns <= self._timeout_ns
        return [0.0, 0.0, self._target_m - self._z_m if recent else 0.0, 0.0, 0.0, 0.0]

    def state(self) -> dict[str, Any]:
        """Its demand is always valid."""
        return {"status": ["VALID"]}


class FaultyDoor:
    """Hands poses and readings on to a follower, readings with a fault; notes when its demand is VALID.

    `valid`: seconds of each controller period and whether it was. The fault begins at `begin_s`.
    """

    def __init__(self, follower: Any, case: Case, fault: Fault, late: bool, seed: int, run_s: float) -> None:
        self._follower, self._case, self._fault = follower, case, fault
        self._rng = rng = np.random.default_rng([seed, 131])
        size, sign = float(rng.uniform(*fault.size)), float(rng.choice([-1.0, 1.0]))
        unit_s = max(case.tau_s, 3.0 / case.sensor_hz)
        self.begin_s = BEGIN * run_s
        self._end_s = self.begin_s + float(rng.uniform(*fault.length)) * unit_s
        self._size_m = size * case.standoff_m * (sign if fault.signed else 1.0)
        self._late_ns = round(1e9 * size * case.tau_s) if late else 0
        self._held_m = math.nan
        self.pose = follower.pose
        self.valid: list[tuple[float, bool]] = []

    def step(self, t_ns: int, ranges_m: Any) -> Any:
        """As `Follower.step`; no reading: a controller period."""
        near_m, far_m = self._case.window_m
        t_s, r = 1e-9 * (t_ns - START_NS), float(ranges_m[0])
        if not math.isfinite(r):
            demand = self._follower.step(t_ns, ranges_m)
            self.valid.append((t_s, "VALID" in self._follower.state()["status"]))
            return demand
        if self.begin_s <= t_s < self._end_s:
            self._held_m = r if math.isnan(self._held_m) else self._held_m
            r = self._fault.misread(r, self._held_m, self._size_m, self._case.sigma_m, self._rng)
            t_ns -= self._late_ns
        return self._follower.step(t_ns, np.array([r if near_m < r < far_m else math.nan]))
