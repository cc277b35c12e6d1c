"""Hazards: what a range sensor does at its worst, closed loop, and how near the tool comes to the ground.

A scenario is a family, a seed for ground and noise, and numbers that can be made smaller: `shrink` finds
the least scenario that still does harm.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.contest.families import hull, lap_joints, terrain
from surffollow.sim.plant import PlantConfig, axis_step, set_point_for

STANDOFF_M, NEAR_M, FAR_M = 0.1, 0.0508, 0.1524
SIGMA_M, COUNT_M = 0.25e-3, 25e-6
READING_MS, TICK_MS, LATE_MS, POSE_LATE_MS = 4, 10, 30, 10
SECONDS, BEGIN_S = 4.0, 2.0
P_GAIN, P_TIMEOUT_MS = 0.7, 130
PLANT = PlantConfig()


@dataclass(frozen=True)
class Scenario:
    """One hazard: readings (poses) wrong by `size_m` for `length_s`, or stamps too old by `late_s`."""

    family: str
    seed: int
    speed_mps: float
    size_m: float = 0.0
    length_s: float = 0.0
    late_s: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """Least clearance [m]; whether the tool touched the ground, and whether with a VALID demand."""

    clearance_m: float
    contact: bool
    contact_valid: bool


def draw(family: str, seed: int) -> Scenario:
    """Draw a scenario of a family."""
    rng = np.random.default_rng([seed, 79, *family.encode()])
    speed = float(np.exp(rng.uniform(np.log(0.03), np.log(0.4))))
    size, length, late = (float(v) for v in rng.random(3))
    sizes = {
        "stuck": (5e-3 * (2 * size - 1), 0.3 + 1.2 * length, 0.0),
        "biased": (10e-3 * (2 * size - 1), 0.02 + 1.0 * length, 0.0),
        "burst": (3e-3 + 25e-3 * size, 0.02 + 0.08 * length, 0.0),
        "near": (10e-3 + 30e-3 * size, 0.004 + 0.012 * length, 0.0),
        "late stamps": (0.0, 0.3 + 1.0 * length, 0.06 + 0.09 * late),
        "lost": (0.0, 0.2 + 1.6 * length, 0.0),
        "glitches": (30e-3 * size, 2.0, 0.0),
        "frame jump": (0.2 * (2 * size - 1), 2.0, 0.0),
        "slots": (5e-3 + 20e-3 * size, 0.0, 0.0),
    }
    return Scenario(family, seed, speed, *sizes[family])


FAMILIES = ("stuck", "biased", "burst", "near", "late stamps", "lost", "glitches", "frame jump", "slots")


class PLoop:
    """A plain P loop on the distance, as a user would write it."""

    def __init__(self) -> None:
        self._error, self._t_ns, self._now_ns = 0.0, -(1 << 60), 0

    def pose(self, t_ns: int, pose: Any) -> None:
        """Poses are not used."""

    def step(self, t_ns: int, ranges_m: Any) -> list[float]:
        """The demand: −gain · error while the last reading is young."""
        r = float(ranges_m[0])
        if NEAR_M < r < FAR_M:
            self._error, self._t_ns = r - STANDOFF_M, t_ns
        self._now_ns = max(self._now_ns, t_ns)
        young = self._now_ns - self._t_ns <= P_TIMEOUT_MS * 1_000_000
        return [0.0, 0.0, -P_GAIN * self._error if young else 0.0, 0.0, 0.0, 0.0]

    def state(self) -> dict[str, Any]:
        """It always believes in itself."""
        return {"status": ["VALID"]}


def _ground(s: Scenario) -> tuple[NDArray[np.float64], float]:
    """Heights every 0.5 mm along the path, and where it begins [m]."""
    rng = np.random.default_rng([s.seed, 83])
    x = -0.01 + 0.5e-3 * np.arange(int((SECONDS * s.speed_mps + 0.1) / 0.5e-3))
    make: Any = (hull, lap_joints, terrain)[s.seed % 3]
    heights = make(rng, x)
    if s.family == "slots":  # groups of five, 2 to 6 mm wide
        for first in np.arange(0.1, float(x[-1]), 0.15):
            for at, width in zip(first + np.cumsum(rng.uniform(8e-3, 20e-3, 5)), rng.uniform(2e-3, 6e-3, 5)):
                heights[(x > at) & (x < at + width)] -= s.size_m
    return heights, float(x[0])


def _misread(s: Scenario, r: float, held: float, rng: np.random.Generator) -> float:
    """What the sensor gives instead of `r`; `held` is what it read when the fault began."""
    if s.family == "stuck":
        return held + s.size_m + COUNT_M * int(rng.integers(0, 2))
    if s.family in ("biased", "near"):
        return r + (s.size_m if s.family == "biased" else -s.size_m)
    if s.family == "burst":
        return r + s.size_m * float(rng.uniform(-1.0, 1.0))
    if s.family == "lost":
        return math.nan
    if s.family == "glitches" and rng.random() < 0.15:
        return r + s.size_m * float(rng.uniform(-1.0, 1.0))
    return r


def play(follower: Any, s: Scenario) -> Outcome:
    """Run a follower through a scenario; see `FollowerLike`, and `state()["status"]`."""
    heights, x0 = _ground(s)
    rng = np.random.default_rng([s.seed, 89])
    h = np.interp(
        s.speed_mps * 1e-3 * np.arange(int(SECONDS * 1e3) + 1), x0 + 0.5e-3 * np.arange(len(heights)), heights
    )
    axis = np.array([h[0] + STANDOFF_M, 0.0])
    target, held, wrong_n = axis[0], STANDOFF_M, 0
    readings: list[tuple[int, int, float]] = []
    poses: list[tuple[int, float, float]] = []
    least, contact, contact_valid = math.inf, False, False
    report = axis[0]
    for ms in range(int(SECONDS * 1e3)):
        t, x = ms * 1e-3, s.speed_mps * ms * 1e-3
        clearance = axis[0] - h[ms]
        if ms > 200:
            least = min(least, clearance)
            if clearance <= 0.0 and not contact:
                contact = True
            if clearance <= 0.0 and not contact_valid:
                contact_valid = "VALID" in follower.state()["status"]
        if ms % TICK_MS == 0:
            off = s.size_m if s.family == "frame jump" and BEGIN_S <= t < BEGIN_S + s.length_s else 0.0
            poses.append((ms, x + off, float(axis[0]) + 0.05e-3 * float(rng.standard_normal())))
        if ms % READING_MS == 0:
            r = clearance + SIGMA_M * float(rng.standard_normal())
            stamp = ms
            if BEGIN_S <= t < BEGIN_S + s.length_s:
                if wrong_n == 0:
                    held = r
                r = _misread(s, r, held, rng)
                stamp = ms - round(1e3 * s.late_s)
                wrong_n += 1
            readings.append((ms + LATE_MS, stamp, r if NEAR_M < r < FAR_M else math.nan))
        while poses and poses[0][0] + POSE_LATE_MS <= ms:
            at, px, pz = poses.pop(0)
            follower.pose((1000 + at) * 1_000_000, np.array([px, 0.0, pz, 0.0, 0.0, 0.0, 1.0]))
            report = pz
        while readings and readings[0][0] <= ms:
            _, at, r = readings.pop(0)
            follower.step((1000 + at) * 1_000_000, np.array([r]))
        if ms % TICK_MS == 0:
            target = set_point_for(
                report, float(follower.step((1000 + ms) * 1_000_000, np.array([math.nan]))[2])
            )
        axis_step(axis, target, PLANT.tau_s, PLANT.v_max_mps, PLANT.a_max_mps2, 1e-3)
    return Outcome(least, contact, contact_valid)


def shrink(s: Scenario, harmful: Callable[[Scenario], bool]) -> Scenario:
    """Halve size, length and lateness while the scenario stays harmful."""
    changed = True
    while changed:
        changed = False
        for name in ("size_m", "length_s", "late_s"):
            value = getattr(s, name)
            smaller = replace(s, **{name: 0.5 * value})
            if abs(value) > 1e-4 and harmful(smaller):
                s, changed = smaller, True
    return s
