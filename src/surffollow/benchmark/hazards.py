"""Hazards: range sensors and poses at their worst, closed loop, and how near the tool comes to the ground.

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

from surffollow.benchmark.hazard_ground import make_ground, quaternion, true_range
from surffollow.benchmark.hazard_scenarios import (
    BEGIN_S,
    COUNT_M,
    FAR_M,
    KINDS,
    LATE_MS,
    NEAR_M,
    OUTLIER_SHARE,
    POSE_LATE_MS,
    SECONDS,
    SIGMA_M,
    STANDOFF_M,
    TICK_MS,
    Scenario,
)
from surffollow.sim.plant import PlantConfig, axis_step, setpoint_for

P_GAIN, P_TIMEOUT_MS, P_TIMEOUT_INTERVALS = 0.7, 130, 2.5
HELD_MS = 100
NOISY = tuple(f for f in KINDS if "blocked" in f or f.startswith("frozen") or f == "constant and far")
PLANT = PlantConfig()


@dataclass(frozen=True)
class Outcome:
    """Least clearance [m], greatest tilt [rad]; contact with the ground, and contact with a VALID demand."""

    clearance_m: float
    contact: bool
    contact_valid: bool
    tilt_rad: float = 0.0


class PLoop:
    """A plain P loop on the distance of the first sensor, as a user would write it.

    Under a sensor of more than `HELD_MS` it sets a height per reading and holds it: a demand that is repeated
    until the next reading would oscillate.
    """

    def __init__(self, interval_ms: int = 0) -> None:
        self._demand_m, self._target_m, self._z_m = 0.0, 0.0, 0.0
        self._t_ns, self._now_ns = -(1 << 60), 0
        self._held = interval_ms > HELD_MS
        self._timeout_ns = max(P_TIMEOUT_MS, P_TIMEOUT_INTERVALS * interval_ms) * 1_000_000

    def pose(self, t_ns: int, pose: Any) -> None:
        """Only the height is used, to hold one."""
        self._z_m = float(pose[2])

    def step(self, t_ns: int, ranges_m: Any) -> list[float]:
        """The demand: −gain · error while the last reading is recent."""
        r = float(ranges_m[0])
        if NEAR_M < r < FAR_M:
            self._demand_m, self._t_ns = -P_GAIN * (r - STANDOFF_M), t_ns
            self._target_m = self._z_m + self._demand_m
        self._now_ns = max(self._now_ns, t_ns)
        recent = self._now_ns - self._t_ns <= self._timeout_ns
        demand_m = self._target_m - self._z_m if self._held else self._demand_m
        return [0.0, 0.0, demand_m if recent else 0.0, 0.0, 0.0, 0.0]

    def state(self) -> dict[str, Any]:
        """Its demand is always valid."""
        return {"status": ["VALID"]}


def shortfall_m(plain_m: float, own_m: float) -> float:
    """How far a least clearance is below that of the P loop, or below the stand-off if that is less [m].

    A P loop that lags over falling ground keeps more than the stand-off. That is no clearance to miss.
    """
    return min(plain_m, STANDOFF_M) - own_m


def misread(s: Scenario, r: float, held: float, rng: np.random.Generator) -> float:
    """The reading in place of `r` [m].

    Parameters
    ----------
    s : Scenario
    r : float [m]     the reading without a fault
    held : float [m]  what the sensor read when the fault began
    rng : Generator
    """
    n = float(rng.standard_normal()) if s.family in NOISY else 0.0
    if s.family in ("stuck", "leading frozen", "all stuck", "one of four"):
        return held + s.size_m + COUNT_M * int(rng.integers(0, 2))
    if s.family == "held":
        return held
    if s.family in NOISY:  # something moves with the sensor; less noise than usual
        return held + (s.size_m * n if s.family.startswith("frozen") else s.size_m + SIGMA_M * n)
    if s.family in ("biased", "near", "leading wrong", "two of four"):
        return r + (-s.size_m if s.family == "near" else s.size_m)
    if s.family == "gain":
        return r * (1.0 + s.size_m)
    if s.family == "coarse counts":
        return s.size_m * round(r / s.size_m)
    if s.family == "much noise":
        return r + s.size_m * float(rng.standard_normal())
    if s.family == "burst":
        return r + s.size_m * float(rng.uniform(-1.0, 1.0))
    if s.family == "lost" or (s.family == "mostly lost" and rng.random() < s.size_m):
        return math.nan
    if s.family.endswith("outliers") and rng.random() < OUTLIER_SHARE:  # spray and fish, or multiple echoes
        return r + s.size_m * float(rng.uniform(-1.0, 0.0) if s.family == "near outliers" else rng.random())
    if s.family == "glitches" and rng.random() < 0.15:
        return r + s.size_m * float(rng.uniform(-1.0, 1.0))
    return r


def bend_step(s: Scenario, bend: NDArray[np.float64], change_mps: float) -> None:
    """Advance deflection [m] and rate [m/s] of a structure by a millisecond in which its axis speeds up.

    Parameters
    ----------
    s : Scenario
    bend : (2,) float64     updated
    change_mps : float64    change of the velocity of the axis [m/s]
    """
    if s.bend_hz == 0.0:
        return
    omega = 2.0 * math.pi * s.bend_hz
    bend[1] -= change_mps + 1e-3 * omega * (2.0 * s.bend_damping * bend[1] + omega * bend[0])
    bend[0] += 1e-3 * bend[1]


def faulty_channels(s: Scenario) -> tuple[int, ...]:
    """Channels whose readings are wrong during the fault."""
    if s.family.startswith("leading"):
        return (1,)
    if s.family.startswith("all"):
        return tuple(range(len(KINDS[s.family].mounts_m)))
    if s.family.startswith(("one of", "two of")):
        count, n = 2 if s.family == "two of four" else 1, len(KINDS[s.family].mounts_m)
        return tuple(int(c) for c in np.random.default_rng([s.seed, 97]).permutation(n)[:count])
    return (0,)


def play(follower: Any, s: Scenario) -> Outcome:
    """Run a follower through a scenario; see `FollowerLike`, and `state()["status"]`."""
    kind, ground, faulty = KINDS[s.family], make_ground(s), faulty_channels(s)
    rng = np.random.default_rng([s.seed, 89])
    n = len(kind.mounts_m)
    axis = np.array([ground.height_m(0.0, False) + STANDOFF_M, 0.0])
    target, report = axis[0], axis[0]
    bend = np.zeros(2)
    tilt, tilt_target, tilt_report = np.zeros(2), np.zeros(2), np.zeros(2)
    held, wrong_n = np.full(n, STANDOFF_M), 0
    readings: list[tuple[int, int, NDArray[np.float64]]] = []
    poses: list[tuple[int, tuple[float, float], float, NDArray[np.float64]]] = []
    least, contact, contact_valid, most_tilt = math.inf, False, False, 0.0
    turn_s = SECONDS if kind.passes == 2 else math.inf
    begin_s = turn_s + 0.3 if kind.passes == 2 else BEGIN_S
    for ms in range(int(SECONDS * 1e3) * kind.passes):
        t, later = ms * 1e-3, ms * 1e-3 >= turn_s
        x = s.place_m(t if not later else 2.0 * turn_s - t)
        z_m = axis[0] + bend[0] - s.heave_at(t)  # the ground heaves, its profile stays
        height = z_m - ground.height_m(x, later)
        # a tool that turns to the normal keeps its distance from the nearest ground
        clearance = ground.distance_m(x, z_m, later) if n > 2 else height
        wrong = begin_s <= t < begin_s + s.length_s
        if ms > 200 and (kind.passes == 1 or later):
            least = min(least, clearance)
            most_tilt = max(most_tilt, math.hypot(tilt[0], tilt[1]))
            if clearance <= 0.0 and not contact_valid:
                contact, contact_valid = True, "VALID" in follower.state()["status"]
        old_ms = round(1e3 * s.late_s) if wrong and s.family == "old poses" else 0
        talks = ms % TICK_MS == 0 and not (wrong and s.family == "controller pauses")
        if talks:
            off = s.size_m if "jump" in s.family and wrong else 0.0
            up, off = (off, 0.0) if s.family == "height jump" else (0.0, off)
            z = float(axis[0] + (bend[0] if kind.bend_seen else 0.0)) + 0.05e-3 * float(rng.standard_normal())
            poses.append((ms + old_ms, (x + off, z + up), z, tilt.copy()))
        if ms % s.interval_ms == 0:
            q = quaternion(tilt)
            r = np.array([true_range(ground, later, x, z_m, q, m) for m in kind.mounts_m])
            r += SIGMA_M * rng.standard_normal(n)
            stamp, arrival = ms, ms + LATE_MS
            if wrong:
                if wrong_n == 0:
                    held = r.copy()
                for c in faulty:
                    r[c] = misread(s, r[c], held[c], rng)
                if s.family == "overtaking":
                    arrival += round(1e3 * s.late_s * rng.random())
                elif s.family != "old poses":
                    stamp = ms - round(1e3 * s.late_s)
                wrong_n += 1
            r[~((r > NEAR_M) & (r < FAR_M))] = math.nan
            readings.append((arrival, stamp, r))
            readings.sort(key=lambda reading: reading[0])
        while poses and poses[0][0] + POSE_LATE_MS <= ms:
            at, (px, pz), own, pt = poses.pop(0)
            follower.pose((1000 + at) * 1_000_000, np.array([px, 0.0, pz, *quaternion(pt)]))
            report, tilt_report = own, pt  # the controller adds to its own position
        while readings and readings[0][0] <= ms:
            _, at, r = readings.pop(0)
            follower.step((1000 + at) * 1_000_000, r)
        if talks:
            demand = follower.step((1000 + ms) * 1_000_000, np.full(n, math.nan))
            target = setpoint_for(report, float(demand[2]))
            tilt_target = tilt_report + np.array([float(demand[3]), float(demand[4])])
        before_mps = float(axis[1])
        axis_step(axis, target, s.lag * PLANT.tau_s, PLANT.v_max_mps, PLANT.a_max_mps2, 1e-3)
        bend_step(s, bend, float(axis[1]) - before_mps)
        axis[0] += s.push_mps * 1e-3 if t >= BEGIN_S else 0.0
        tilt += (tilt_target - tilt) * (1e-3 / PLANT.tau_s)
    return Outcome(float(least), contact, contact_valid, most_tilt)


def shrink(s: Scenario, harmful: Callable[[Scenario], bool]) -> Scenario:
    """Halve size, length, lateness, push and heave while the scenario stays harmful."""
    changed = True
    while changed:
        changed = False
        for name in ("size_m", "length_s", "late_s", "push_mps", "heave_m"):
            value = getattr(s, name)
            smaller = replace(s, **{name: 0.5 * value})
            if abs(value) > 1e-4 and harmful(smaller):
                s, changed = smaller, True
    return s
