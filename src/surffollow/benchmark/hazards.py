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

from surffollow.benchmark.families import hull, lap_joints, terrain
from surffollow.sim.plant import PlantConfig, axis_step, set_point_for

STANDOFF_M, NEAR_M, FAR_M = 0.1, 0.0508, 0.1524
SIGMA_M, COUNT_M = 0.25e-3, 25e-6
READING_MS, TICK_MS, LATE_MS, POSE_LATE_MS = 4, 10, 30, 10
SECONDS, BEGIN_S = 4.0, 2.0
MARGIN_M, STEP_M = 0.1, 0.5e-3
LEAD_M, RING_M = 0.05, 0.03
P_GAIN, P_TIMEOUT_MS = 0.7, 130
PLANT = PlantConfig()
_THIRD = 2.0 * math.pi / 3.0
ONE = ((0.0, 0.0),)
LEADING = ((0.0, 0.0), (LEAD_M, 0.0))
FOUR = ((0.0, 0.0), *((RING_M * math.cos(k * _THIRD), RING_M * math.sin(k * _THIRD)) for k in range(3)))


@dataclass(frozen=True)
class Kind:
    """A family: ranges of `size_m` and `length_s`, uniform; where the sensors are [m].

    `signed`: the size has either sign. `passes`: 2 means there and back over the same ground.
    """

    size_m: tuple[float, float] = (0.0, 0.0)
    length_s: tuple[float, float] = (0.0, 0.0)
    signed: bool = False
    late_s: tuple[float, float] = (0.0, 0.0)
    mounts_m: tuple[tuple[float, float], ...] = ONE
    passes: int = 1


KINDS = {
    "stuck": Kind((0.0, 5e-3), (0.3, 1.5), signed=True),
    "blocked": Kind((0.0, 5e-3), (0.3, 1.5), signed=True),
    "frozen": Kind((0.1 * SIGMA_M, 0.5 * SIGMA_M), (0.3, 1.5)),
    "biased": Kind((0.0, 10e-3), (0.02, 1.02), signed=True),
    "burst": Kind((3e-3, 28e-3), (0.02, 0.1)),
    "near": Kind((10e-3, 40e-3), (0.004, 0.016)),
    "late stamps": Kind(length_s=(0.3, 1.3), late_s=(0.06, 0.15)),
    "early stamps": Kind(length_s=(0.3, 1.3), late_s=(-0.15, -0.02)),
    "lost": Kind(length_s=(0.2, 1.8)),
    "glitches": Kind((0.0, 30e-3), (2.0, 2.0)),
    "frame jump": Kind((0.0, 0.2), (2.0, 2.0), signed=True),
    "slots": Kind((5e-3, 25e-3)),
    "leading frozen": Kind((0.0, 5e-3), (0.3, 2.0), signed=True, mounts_m=LEADING),
    "leading wrong": Kind((0.0, 20e-3), (0.3, 2.0), signed=True, mounts_m=LEADING),
    "two of four": Kind((0.0, 30e-3), (0.1, 2.0), signed=True, mounts_m=FOUR),
    "filled slot": Kind((5e-3, 25e-3), passes=2),
    "jump on known ground": Kind((0.0, 0.1), (2.0, 2.0), signed=True, passes=2),
}
FAMILIES = tuple(KINDS)


@dataclass(frozen=True)
class Scenario:
    """One hazard: readings (poses) wrong by `size_m` for `length_s`, or stamps too old by `late_s`
    (negative: in the future)."""

    family: str
    seed: int
    speed_mps: float
    size_m: float = 0.0
    length_s: float = 0.0
    late_s: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """Least clearance [m], greatest tilt [rad]; contact with the ground, and contact with a VALID demand."""

    clearance_m: float
    contact: bool
    contact_valid: bool
    tilt_rad: float = 0.0


def draw(family: str, seed: int) -> Scenario:
    """Draw a scenario of a family."""
    kind = KINDS[family]
    rng = np.random.default_rng([seed, 79, *family.encode()])
    speed = float(np.exp(rng.uniform(np.log(0.03), np.log(0.4))))
    size, length, late = (float(v) for v in rng.random(3))
    if kind.signed:
        size = 2.0 * size - 1.0
    low, high = kind.size_m
    return Scenario(
        family,
        seed,
        speed,
        math.copysign(low, size) + (high - low) * size,
        kind.length_s[0] + (kind.length_s[1] - kind.length_s[0]) * length,
        kind.late_s[0] + (kind.late_s[1] - kind.late_s[0]) * late,
    )


class PLoop:
    """A plain P loop on the distance of the first sensor, as a user would write it."""

    def __init__(self) -> None:
        self._error, self._t_ns, self._now_ns = 0.0, -(1 << 60), 0

    def pose(self, t_ns: int, pose: Any) -> None:
        """Poses are not used."""

    def step(self, t_ns: int, ranges_m: Any) -> list[float]:
        """The demand: −gain · error while the last reading is recent."""
        r = float(ranges_m[0])
        if NEAR_M < r < FAR_M:
            self._error, self._t_ns = r - STANDOFF_M, t_ns
        self._now_ns = max(self._now_ns, t_ns)
        recent = self._now_ns - self._t_ns <= P_TIMEOUT_MS * 1_000_000
        return [0.0, 0.0, -P_GAIN * self._error if recent else 0.0, 0.0, 0.0, 0.0]

    def state(self) -> dict[str, Any]:
        """Its demand is always valid."""
        return {"status": ["VALID"]}


@dataclass(frozen=True)
class Ground:
    """Heights every `STEP_M` from `x0_m`; those of the second pass are `later_m`."""

    x0_m: float
    first_m: NDArray[np.float64]
    later_m: NDArray[np.float64]

    def height_m(self, x_m: float, later: bool) -> float:
        """Height at x, linear between the points."""
        heights = self.later_m if later else self.first_m
        f = min(max((x_m - self.x0_m) / STEP_M, 0.0), len(heights) - 1.001)
        i = int(f)
        return float(heights[i] + (f - i) * (heights[i + 1] - heights[i]))

    def distance_m(self, x_m: float, z_m: float, later: bool) -> float:
        """Distance of a point above the ground from its nearest point; negative below it."""
        heights = self.later_m if later else self.first_m
        reach, i = int(MARGIN_M / STEP_M), round((x_m - self.x0_m) / STEP_M)
        k = np.arange(max(i - reach, 0), min(i + reach, len(heights)))
        nearest = float(np.hypot(self.x0_m + STEP_M * k - x_m, heights[k] - z_m).min())
        return math.copysign(nearest, z_m - self.height_m(x_m, later))


def make_ground(s: Scenario) -> Ground:
    """Make the ground of a scenario."""
    rng = np.random.default_rng([s.seed, 83])
    x = -MARGIN_M + STEP_M * np.arange(int((SECONDS * s.speed_mps + 2.0 * MARGIN_M) / STEP_M))
    make: Any = (hull, lap_joints, terrain)[s.seed % 3]
    later = make(rng, x)
    first = later.copy()
    if s.family == "slots":  # groups of five, 2 to 6 mm wide
        for begin in np.arange(0.1, float(x[-1]), 0.15):
            for at, width in zip(begin + np.cumsum(rng.uniform(8e-3, 20e-3, 5)), rng.uniform(2e-3, 6e-3, 5)):
                first[(x > at) & (x < at + width)] -= s.size_m
    if s.family == "filled slot":  # 20 to 60 mm wide; all or every other one is filled before the second pass
        for k, begin in enumerate(np.arange(0.02, float(x[-1]), 0.15)):
            slot = (x > begin) & (x < begin + rng.uniform(20e-3, 60e-3))
            first[slot] -= s.size_m
            if k % 2 == 0 and s.seed % 2 == 0:
                later[slot] -= s.size_m
    return Ground(float(x[0]), first, later if s.family == "filled slot" else first)


def misread(s: Scenario, r: float, held: float, rng: np.random.Generator) -> float:
    """What the sensor gives instead of `r`; `held` is what it read when the fault began."""
    n = float(rng.standard_normal()) if s.family in ("blocked", "frozen") else 0.0
    if s.family in ("stuck", "leading frozen"):
        return held + s.size_m + COUNT_M * int(rng.integers(0, 2))
    if s.family in ("blocked", "frozen"):  # something moves with the sensor; less noise than usual
        return held + (s.size_m + SIGMA_M * n if s.family == "blocked" else s.size_m * n)
    if s.family in ("biased", "near", "leading wrong", "two of four"):
        return r + (-s.size_m if s.family == "near" else s.size_m)
    if s.family == "burst":
        return r + s.size_m * float(rng.uniform(-1.0, 1.0))
    if s.family == "lost":
        return math.nan
    if s.family == "glitches" and rng.random() < 0.15:
        return r + s.size_m * float(rng.uniform(-1.0, 1.0))
    return r


def faulty_channels(s: Scenario) -> tuple[int, ...]:
    """Channels whose readings are wrong during the fault."""
    if s.family.startswith("leading"):
        return (1,)
    if s.family == "two of four":
        return tuple(int(c) for c in np.random.default_rng([s.seed, 97]).permutation(4)[:2])
    return (0,)


def quaternion(tilt: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternion (x, y, z, w) of the rotation vector (tilt_x, tilt_y, 0) [rad]."""
    angle = math.hypot(tilt[0], tilt[1])
    k = math.sin(0.5 * angle) / angle if angle > 0.0 else 0.5
    return np.array([k * tilt[0], k * tilt[1], 0.0, math.cos(0.5 * angle)])


def rotate(q: NDArray[np.float64], v: tuple[float, float, float]) -> NDArray[np.float64]:
    """Rotate v by the unit quaternion q."""
    u, w = q[:3], q[3]
    t = 2.0 * np.cross(u, v)
    return np.asarray(v + w * t + np.cross(u, t), np.float64)


def true_range(
    ground: Ground, later: bool, x: float, z: float, q: NDArray[np.float64], mount: tuple[float, float]
) -> float:
    """Distance along a beam to ground that does not vary with y [m]."""
    if q[3] == 1.0:
        return z - ground.height_m(x + mount[0], later)
    at, beam = rotate(q, (*mount, 0.0)), rotate(q, (0.0, 0.0, -1.0))
    r = z + at[2] - ground.height_m(x + at[0], later)
    for _ in range(4):
        r = (z + at[2] - ground.height_m(x + at[0] + r * beam[0], later)) / -beam[2]
    return float(r)


def play(follower: Any, s: Scenario) -> Outcome:
    """Run a follower through a scenario; see `FollowerLike`, and `state()["status"]`."""
    kind, ground, faulty = KINDS[s.family], make_ground(s), faulty_channels(s)
    rng = np.random.default_rng([s.seed, 89])
    n = len(kind.mounts_m)
    axis = np.array([ground.height_m(0.0, False) + STANDOFF_M, 0.0])
    target, report = axis[0], axis[0]
    tilt, tilt_target, tilt_report = np.zeros(2), np.zeros(2), np.zeros(2)
    held, wrong_n = np.full(n, STANDOFF_M), 0
    readings: list[tuple[int, int, NDArray[np.float64]]] = []
    poses: list[tuple[int, float, float, NDArray[np.float64]]] = []
    least, contact, contact_valid, most_tilt = math.inf, False, False, 0.0
    turn_s = SECONDS if kind.passes == 2 else math.inf
    begin_s = turn_s + 0.3 if kind.passes == 2 else BEGIN_S
    for ms in range(int(SECONDS * 1e3) * kind.passes):
        t, later = ms * 1e-3, ms * 1e-3 >= turn_s
        x = s.speed_mps * (t if not later else 2.0 * turn_s - t)
        height = axis[0] - ground.height_m(x, later)
        # a tool that turns to the normal keeps its distance from the nearest ground
        clearance = ground.distance_m(x, axis[0], later) if n > 2 else height
        wrong = begin_s <= t < begin_s + s.length_s
        if ms > 200 and (kind.passes == 1 or later):
            least = min(least, clearance)
            most_tilt = max(most_tilt, math.hypot(tilt[0], tilt[1]))
            if clearance <= 0.0 and not contact_valid:
                contact, contact_valid = True, "VALID" in follower.state()["status"]
        if ms % TICK_MS == 0:
            off = s.size_m if "jump" in s.family and wrong else 0.0
            poses.append((ms, x + off, float(axis[0]) + 0.05e-3 * float(rng.standard_normal()), tilt.copy()))
        if ms % READING_MS == 0:
            q = quaternion(tilt)
            r = np.array([true_range(ground, later, x, axis[0], q, m) for m in kind.mounts_m])
            r += SIGMA_M * rng.standard_normal(n)
            stamp = ms
            if wrong:
                if wrong_n == 0:
                    held = r.copy()
                for c in faulty:
                    r[c] = misread(s, r[c], held[c], rng)
                stamp = ms - round(1e3 * s.late_s)
                wrong_n += 1
            r[~((r > NEAR_M) & (r < FAR_M))] = math.nan
            readings.append((ms + LATE_MS, stamp, r))
        while poses and poses[0][0] + POSE_LATE_MS <= ms:
            at, px, pz, pt = poses.pop(0)
            follower.pose((1000 + at) * 1_000_000, np.array([px, 0.0, pz, *quaternion(pt)]))
            report, tilt_report = pz, pt
        while readings and readings[0][0] <= ms:
            _, at, r = readings.pop(0)
            follower.step((1000 + at) * 1_000_000, r)
        if ms % TICK_MS == 0:
            demand = follower.step((1000 + ms) * 1_000_000, np.full(n, math.nan))
            target = set_point_for(report, float(demand[2]))
            tilt_target = tilt_report + np.array([float(demand[3]), float(demand[4])])
        axis_step(axis, target, PLANT.tau_s, PLANT.v_max_mps, PLANT.a_max_mps2, 1e-3)
        tilt += (tilt_target - tilt) * (1e-3 / PLANT.tau_s)
    return Outcome(float(least), contact, contact_valid, most_tilt)


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
