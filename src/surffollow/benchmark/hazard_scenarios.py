"""Hazards: families of wrong readings and poses, and scenarios drawn from them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

STANDOFF_M, NEAR_M, FAR_M = 0.1, 0.0508, 0.1524
SIGMA_M, COUNT_M = 0.25e-3, 25e-6
READING_MS, TICK_MS, LATE_MS, POSE_LATE_MS = 4, 10, 30, 10
SECONDS, BEGIN_S = 4.0, 2.0
MARGIN_M, STEP_M = 0.1, 0.5e-3
TURN_SHARPNESS = 0.9  # 1: the speed changes its sign at once
LEAD_M, RING_M = 0.05, 0.03
_THIRD = 2.0 * math.pi / 3.0
ONE = ((0.0, 0.0),)
LEADING = ((0.0, 0.0), (LEAD_M, 0.0))
AHEAD = ((LEAD_M, 0.0),)
TRAILING = ((-0.03, 0.0),)
FAR_BEHIND = ((-0.075, 0.0),)
THREE = tuple((RING_M * math.cos(k * _THIRD), RING_M * math.sin(k * _THIRD)) for k in range(3))
FOUR = ((0.0, 0.0), *THREE)


@dataclass(frozen=True)
class Kind:
    """A family: ranges of `size_m` and `length_s`, uniform; where the sensors are [m].

    `signed`: the size has either sign. `passes`: 2 means there and back over the same ground.
    `slope`: of a plane under the ground, of either sign. `rises`: it begins in the middle, and rises;
    `valley`: it falls until the middle, and rises from there; `levels`: it is level from there.
    `interval_ms`: between readings, log-uniform. `factor`: of the speed from the middle on.
    `turn_s`: the tool turns back every so often. `push_mps`: velocity of wind or current beside the axis, of
    either sign, from the middle on. `heave_m`: amplitude of ground that moves up and down as a whole.
    `lag`: time constant of the axis over the configured one. `bend_hz`: natural frequency, log-uniform, of a
    flexible structure between axis and tool. The pose reported is that of the axis, or, `bend_seen`, of the
    tool.
    """

    size_m: tuple[float, float] = (0.0, 0.0)
    length_s: tuple[float, float] = (0.0, 0.0)
    signed: bool = False
    late_s: tuple[float, float] = (0.0, 0.0)
    mounts_m: tuple[tuple[float, float], ...] = ONE
    passes: int = 1
    slope: tuple[float, float] = (0.0, 0.0)
    interval_ms: tuple[int, int] = (READING_MS, READING_MS)
    rises: bool = False
    valley: bool = False
    levels: bool = False
    factor: tuple[float, float] = (1.0, 1.0)
    turn_s: tuple[float, float] | None = None
    push_mps: float = 0.0
    heave_m: float = 0.0
    lag: tuple[float, float] = (1.0, 1.0)
    bend_hz: tuple[float, float] | None = None
    bend_seen: bool = False


_FALL: dict[str, Any] = {"slope": (0.2, 1.0), "interval_ms": (READING_MS, 60), "levels": True}
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
    "constant and far": Kind((5e-3, 40e-3), (0.3, 1.5)),
    "height jump": Kind((0.02, 0.2), (2.0, 2.0), signed=True),
    "steep and slow": Kind(slope=(0.05, 0.4), interval_ms=(READING_MS, 400)),
    "all stuck": Kind((0.0, 5e-3), (0.3, 1.5), signed=True, mounts_m=FOUR),
    "all blocked": Kind((0.0, 5e-3), (0.3, 1.5), signed=True, mounts_m=FOUR),
    "one of four": Kind((0.0, 5e-3), (0.3, 1.5), signed=True, mounts_m=FOUR),
    "trailing": Kind(mounts_m=TRAILING, slope=(0.0, 0.2), interval_ms=(READING_MS, 50), rises=True),
    "begins to rise": Kind(slope=(0.05, 0.25), interval_ms=(READING_MS, 100), rises=True),
    "change of speed": Kind(slope=(0.0, 0.2), factor=(-1.0, 3.0)),
    "late stamps of four": Kind(length_s=(0.3, 1.3), late_s=(0.06, 0.15), mounts_m=FOUR),
    "clock set back": Kind(length_s=(2.0, 2.0), late_s=(0.06, 4.0)),
    "clock of four set back": Kind(length_s=(2.0, 2.0), late_s=(0.06, 4.0), mounts_m=FOUR),
    "turns": Kind(slope=(0.05, 0.35), interval_ms=(READING_MS, 250), turn_s=(0.5, 2.0)),
    "valley far behind": Kind(
        mounts_m=FAR_BEHIND, slope=(0.0, 0.3), interval_ms=(READING_MS, 50), valley=True
    ),
    "valley and slow": Kind(slope=(0.05, 0.4), interval_ms=(20, 500), valley=True),
    "stairs and slow": Kind((5e-3, 25e-3), signed=True, interval_ms=(20, 500)),
    "flank": Kind(slope=(1.0, 12.0), interval_ms=(READING_MS, 60), rises=True),
    "blocked and slow": Kind((0.0, 20e-3), (0.3, 1.5), signed=True, interval_ms=(READING_MS, 100)),
    "one of three blocked": Kind((0.0, 20e-3), (0.3, 2.0), signed=True, mounts_m=THREE, slope=(0.0, 0.3)),
    "one of four blocked": Kind((0.0, 20e-3), (0.3, 2.0), signed=True, mounts_m=FOUR, slope=(0.0, 0.3)),
    "coarse counts": Kind((0.2e-3, 10e-3), (2.0, 2.0)),
    "much noise": Kind((1e-3, 20e-3), (2.0, 2.0)),
    "overtaking": Kind(length_s=(2.0, 2.0), late_s=(0.0, 0.04)),
    "blocked on a slope": Kind((0.0, 10e-3), (0.5, 2.0), signed=True, slope=(0.05, 0.3)),
    "end of a fall": Kind(**_FALL),
    "frozen at the end of a fall": Kind((0.1 * SIGMA_M, 0.5 * SIGMA_M), (0.5, 2.0), **_FALL),
    "blocked at the end of a fall": Kind((0.0, 20e-3), (0.5, 2.0), signed=True, **_FALL),
    "gain": Kind((0.0, 0.45), (0.1, 2.0), signed=True, slope=(0.0, 0.2)),
    "pushed": Kind(slope=(0.0, 0.2), interval_ms=(READING_MS, 60), push_mps=0.1),
    "heaving": Kind(interval_ms=(READING_MS, 60), heave_m=0.03),
    "only ahead": Kind(mounts_m=AHEAD, slope=(0.0, 0.4), interval_ms=(READING_MS, 60)),
    "only ahead and pushed": Kind(
        mounts_m=AHEAD, slope=(0.0, 0.2), interval_ms=(READING_MS, 60), push_mps=0.1
    ),
    "only ahead and blocked": Kind((0.0, 20e-3), (0.3, 2.0), signed=True, mounts_m=AHEAD, slope=(0.0, 0.3)),
    "only ahead and heaving": Kind(interval_ms=(READING_MS, 60), mounts_m=AHEAD, heave_m=0.03),
    "mostly lost": Kind((0.5, 0.95), (2.0, 2.0), slope=(0.0, 0.2), interval_ms=(READING_MS, 30)),
    "near outliers": Kind((5e-3, 40e-3), (2.0, 2.0), slope=(0.0, 0.2), interval_ms=(READING_MS, 60)),
    "far outliers": Kind((5e-3, 40e-3), (2.0, 2.0), slope=(0.0, 0.2), interval_ms=(READING_MS, 60)),
    "held": Kind(length_s=(0.05, 0.5), slope=(0.0, 0.4), interval_ms=(READING_MS, 60)),
    "sluggish axis": Kind(slope=(0.0, 0.4), interval_ms=(READING_MS, 60), lag=(1.0, 5.0)),
    "sluggish axis of three": Kind(
        slope=(0.0, 0.3), interval_ms=(READING_MS, 30), lag=(1.0, 5.0), mounts_m=THREE
    ),
    "quick axis": Kind(slope=(0.0, 0.4), interval_ms=(READING_MS, 60), lag=(0.2, 1.0)),
    "controller pauses": Kind(length_s=(0.02, 0.4), slope=(0.0, 0.4), interval_ms=(READING_MS, 60)),
    "old poses": Kind(
        length_s=(2.0, 2.0), late_s=(0.0, 0.06), slope=(0.0, 0.4), interval_ms=(READING_MS, 60)
    ),
    "bending arm": Kind(slope=(0.0, 0.2), bend_hz=(2.0, 20.0)),
    "bending arm and its pose": Kind(slope=(0.0, 0.2), bend_hz=(0.5, 20.0), bend_seen=True),
}
BEND_DAMPING = (0.02, 0.1)
OUTLIER_SHARE = 0.3  # of all readings
HEAVE_S = (0.7, 3.0)  # period
MAX_CLIMB_MPS = 0.1  # over slopes of more than 1: half of what the axis can
MAX_RISE = 0.25  # between two readings, of the distance between stand-off and near limit
FAMILIES = tuple(KINDS)


@dataclass(frozen=True)
class Scenario:
    """One hazard: readings (poses) wrong by `size_m` for `length_s`, or timestamps too old by `late_s`
    (negative: in the future); "overtaking": readings that arrive up to `late_s` later; "old poses": poses
    that come `late_s` late, with the timestamp of then. "controller pauses": no pose and no new demand.

    "gain": ranges too long by the share `size_m`; "mostly lost": the share of readings that are lost. The
    tool is pushed by `push_mps` from the middle on. The ground heaves by `heave_m` with the period `heave_s`.
    The axis has `lag` times the time constant that the follower knows. The structure that it moves bends with
    the natural frequency `bend_hz` (0: it does not) and the damping ratio `bend_damping`.
    """

    family: str
    seed: int
    speed_mps: float
    size_m: float = 0.0
    length_s: float = 0.0
    late_s: float = 0.0
    slope: float = 0.0
    interval_ms: int = READING_MS
    then_mps: float | None = None
    turn_s: float | None = None
    push_mps: float = 0.0
    heave_m: float = 0.0
    heave_s: float = 1.0
    lag: float = 1.0
    bend_hz: float = 0.0
    bend_damping: float = 0.0

    def heave_at(self, t_s: float) -> float:
        """Height of the ground above that of its profile [m]."""
        return self.heave_m * math.sin(2.0 * math.pi * t_s / self.heave_s)

    def place_m(self, t_s: float) -> float:
        """Place of the tool along its way; the speed changes at once in the middle."""
        if self.turn_s is not None:
            phase = math.asin(-TURN_SHARPNESS * math.cos(math.pi * t_s / self.turn_s))
            return self.speed_mps * self.turn_s / math.pi * (phase + math.asin(TURN_SHARPNESS))
        if self.then_mps is None or t_s <= BEGIN_S:
            return self.speed_mps * t_s
        return self.speed_mps * BEGIN_S + self.then_mps * (t_s - BEGIN_S)


def draw(family: str, seed: int) -> Scenario:
    """Draw a scenario of a family; a slow sensor over steep ground moves so slowly that it can follow."""
    kind = KINDS[family]
    rng = np.random.default_rng([seed, 79, *family.encode()])
    speed = float(np.exp(rng.uniform(np.log(0.03), np.log(0.4))))
    size, length, late, slope, interval, falls = (float(v) for v in rng.random(6))
    if kind.signed:
        size = 2.0 * size - 1.0
    low, high = kind.size_m
    slope = kind.slope[0] + (kind.slope[1] - kind.slope[0]) * slope
    shortest, longest = kind.interval_ms
    interval_ms = round(shortest * (longest / shortest) ** interval)
    if slope > 0.0:
        speed = min(speed, MAX_RISE * (STANDOFF_M - NEAR_M) / (slope * interval_ms * 1e-3))
    if slope > 1.0:
        speed = min(speed, MAX_CLIMB_MPS / slope)
    then = kind.factor[0] + (kind.factor[1] - kind.factor[0]) * float(rng.random())
    return Scenario(
        family,
        seed,
        speed,
        math.copysign(low, size) + (high - low) * size,
        kind.length_s[0] + (kind.length_s[1] - kind.length_s[0]) * length,
        kind.late_s[0] + (kind.late_s[1] - kind.late_s[0]) * late,
        -slope if falls < 0.5 and not (kind.rises or kind.valley or kind.levels) else slope,
        interval_ms,
        None if kind.factor == (1.0, 1.0) else then * speed,
        None if kind.turn_s is None else float(rng.uniform(*kind.turn_s)),
        kind.push_mps * float(rng.uniform(-1.0, 1.0)),
        kind.heave_m * float(rng.random()),
        float(rng.uniform(*HEAVE_S)),
        float(rng.uniform(*kind.lag)),
        0.0 if kind.bend_hz is None else float(np.exp(rng.uniform(*np.log(kind.bend_hz)))),
        float(rng.uniform(*BEND_DAMPING)),
    )
