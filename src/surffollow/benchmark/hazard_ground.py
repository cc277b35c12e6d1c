"""Ground of a hazard scenario, and the true distance along a beam."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.benchmark.families import hull, lap_joints, terrain
from surffollow.benchmark.hazard_scenarios import (
    BEGIN_S,
    KINDS,
    MARGIN_M,
    SECONDS,
    STEP_M,
    Scenario,
)


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
    begin_m, turn_m = s.place_m(BEGIN_S), s.place_m(SECONDS if s.turn_s is None else s.turn_s)
    x = -MARGIN_M + STEP_M * np.arange(int((max(begin_m, turn_m) + 2.0 * MARGIN_M) / STEP_M))
    make: Any = (hull, lap_joints, terrain)[s.seed % 3]
    kind = KINDS[s.family]
    rise = x
    if kind.rises:
        rise = np.maximum(x - begin_m, 0.0)
    elif kind.valley:
        rise = np.abs(x - begin_m)
    elif kind.levels:
        rise = np.maximum(begin_m - x, 0.0)
    later = make(rng, x) + s.slope * rise
    first = later.copy()
    if s.family == "slots":  # groups of five, 2 to 6 mm wide
        for begin in np.arange(0.1, float(x[-1]), 0.15):
            for at, width in zip(begin + np.cumsum(rng.uniform(8e-3, 20e-3, 5)), rng.uniform(2e-3, 6e-3, 5)):
                first[(x > at) & (x < at + width)] -= s.size_m
    if s.family == "stairs and slow":  # up, or down, by the size every 0.1 to 0.4 m
        places = np.cumsum(rng.uniform(0.1, 0.4, 1 + int(10.0 * float(x[-1]))))
        first += s.size_m * np.searchsorted(places, x)
    if s.family == "filled slot":  # 20 to 60 mm wide; all or every other one is filled before the second pass
        for k, begin in enumerate(np.arange(0.02, float(x[-1]), 0.15)):
            slot = (x > begin) & (x < begin + rng.uniform(20e-3, 60e-3))
            first[slot] -= s.size_m
            if k % 2 == 0 and s.seed % 2 == 0:
                later[slot] -= s.size_m
    return Ground(float(x[0]), first, later if s.family == "filled slot" else first)


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
    """Distance along a beam to ground that does not vary with y [m].

    Parameters
    ----------
    ground : Ground
    later : bool                the ground of the second pass
    x, z : float [m]            place of the tool
    q : (4,) float64            attitude of the tool, x y z w
    mount : (float, float) [m]  x, y of the sensor in the tool's frame
    """
    if q[3] == 1.0:
        return z - ground.height_m(x + mount[0], later)
    at, beam = rotate(q, (*mount, 0.0)), rotate(q, (0.0, 0.0, -1.0))
    r = z + at[2] - ground.height_m(x + at[0], later)
    for _ in range(4):
        r = (z + at[2] - ground.height_m(x + at[0] + r * beam[0], later)) / -beam[2]
    return float(r)
