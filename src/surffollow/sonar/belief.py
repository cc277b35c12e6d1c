"""Hypotheses on the walls of an enclosure from the readings so far, over several poses of the robot.

Readings of earlier poses stay: they are sonars at other places in the belief's frame, so one sonar that
moves (1W1S with motion) is handled like a ring. The odometry between the poses is taken as exact. The two
sides of a partition are two walls: φ points from the robot to each when it was seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.errors import UsageError
from surffollow.sonar.agreement import CONTRADICTION, INLIER, count_agreement
from surffollow.sonar.fused_poses import walls
from surffollow.sonar.pair_poses import wall_pose
from surffollow.sonar.ring import Pose, SonarRing
from surffollow.sonar.wall import WallPose


@dataclass(frozen=True)
class Hypothesis:
    """A supposed wall and what later readings said of it.

    Attributes
    ----------
    wall : WallPose
        in the belief's frame
    corroborated : int
        later readings that it predicted
    refuted : int
        later readings that it forbids
    """

    wall: WallPose
    corroborated: int = 0
    refuted: int = 0

    @property
    def state(self) -> Literal["supposed", "corroborated", "refuted"]:
        """Evaluate it with the later readings."""
        if self.refuted > self.corroborated:
            return "refuted"
        return "corroborated" if self.corroborated else "supposed"


class Belief:
    """Hypotheses about k walls from all readings so far.

    Parameters
    ----------
    ring : SonarRing
    k : int
        walls to find
    phi_bound_rad, distance_bound_m : float
        standard deviations under which a wall counts as known, d taken from the robot's place
    """

    def __init__(
        self,
        ring: SonarRing,
        k: int = 4,
        *,
        phi_bound_rad: float = math.radians(1.5),
        distance_bound_m: float = 0.03,
    ) -> None:
        if k < 1:
            raise UsageError(f"a belief about {k} walls says nothing; k must be at least 1")
        if not (0.0 < phi_bound_rad < math.inf and 0.0 < distance_bound_m < math.inf):
            raise UsageError(
                f"the bounds are {phi_bound_rad} rad and {distance_bound_m} m; expected positive numbers"
            )
        self.ring, self.k = ring, k
        self.phi_bound_rad, self.distance_bound_m = phi_bound_rad, distance_bound_m
        self.pose: Pose = (0.0, 0.0, 0.0)
        self.positions_m, self.headings_rad = np.empty((0, 2)), np.empty(0)
        self.ranges_m = np.empty(0)
        self.hypotheses: list[Hypothesis] = []
        self.refuted: list[Hypothesis] = []
        self._fired: set[int] = set()

    @property
    def walls(self) -> list[WallPose]:
        """The walls of the hypotheses, in the belief's frame."""
        return [h.wall for h in self.hypotheses]

    @property
    def ambiguous(self) -> bool:
        """Whether several hypotheses compete for one wall."""
        return self.k == 1 and len(self.hypotheses) > 1

    def is_known(self, wall: WallPose) -> bool:
        """Whether both standard deviations of a wall, seen from the robot, are within the bounds."""
        seen = self._from_here(wall)
        return seen.phi_std_rad <= self.phi_bound_rad and seen.distance_std_m <= self.distance_bound_m

    def _from_here(self, wall: WallPose) -> WallPose:
        """A wall with its distance from the robot: its error does not depend on where the belief began."""
        return wall.moved(self.pose[0], self.pose[1], 0.0)

    @property
    def settled(self) -> bool:
        """Whether k walls are known and nothing is ambiguous."""
        return not self.ambiguous and sum(self.is_known(w) for w in self.walls) >= self.k

    def unfired(self) -> tuple[int, ...]:
        """Sonars that have not been read at the present pose."""
        return tuple(i for i in range(self.ring.headings_rad.size) if i not in self._fired)

    def move(self, turn_rad: float = 0.0, drive_m: float = 0.0) -> None:
        """The robot turned, then drove straight ahead; sonars may be read anew.

        Raises
        ------
        UsageError
            a number is not finite
        """
        if not (math.isfinite(turn_rad) and math.isfinite(drive_m)):
            raise UsageError(f"a move of {turn_rad} rad and {drive_m} m cannot be")
        x, y, heading = self.pose
        heading += turn_rad
        self.pose = (x + drive_m * math.cos(heading), y + drive_m * math.sin(heading), heading)
        self._fired.clear()

    def add(self, ranges_m: ArrayLike, sensors: tuple[int, ...] | None = None) -> None:
        """Take readings at the present pose and score the hypotheses by them.

        Parameters
        ----------
        ranges_m : (n,) array
            readings; inf: no echo, NaN: not measured
        sensors : tuple of int
            their sonars; all of the ring when None

        Raises
        ------
        UsageError
            the numbers of readings and sonars differ, there is no such sonar, or as `walls`; the
            belief stays as it was
        """
        size = self.ring.headings_rad.size
        chosen = tuple(range(size)) if sensors is None else tuple(sensors)
        ranges = np.array(ranges_m, np.float64)
        if ranges.shape != (len(chosen),):
            raise UsageError(f"{ranges.size} readings for {len(chosen)} sonars")
        if not all(0 <= i < size for i in chosen):
            raise UsageError(f"sensors are {chosen}; the ring has sonars 0 to {size - 1}")
        positions, headings = self.ring.at(self.pose)
        index = list(chosen)
        readings = (
            np.vstack([self.positions_m, positions[index]]),
            np.append(self.headings_rad, headings[index]),
            np.append(self.ranges_m, ranges),
        )
        found = self._found(*readings)
        before = [self._scored(h, positions[index], headings[index], ranges) for h in self.hypotheses]
        self.positions_m, self.headings_rad, self.ranges_m = readings
        self._fired.update(chosen)
        self._match(before, found)

    def _scored(
        self,
        hypothesis: Hypothesis,
        positions: NDArray[np.float64],
        headings: NDArray[np.float64],
        ranges: NDArray[np.float64],
    ) -> Hypothesis:
        wall, verdicts = hypothesis.wall, np.empty(ranges.size, np.int64)
        row = np.array([wall.phi_rad, wall.distance_m, *wall.covariance[0], wall.covariance[1, 1]])
        readings = self.ring.readings(positions, headings, ranges)
        count_agreement(readings, row, np.isfinite(ranges), verdicts)
        against = verdicts == CONTRADICTION
        if self.k == 1:  # one wall has to explain every echo
            against |= np.isfinite(ranges) & (verdicts != INLIER)
        return replace(
            hypothesis,
            corroborated=hypothesis.corroborated + int((verdicts == INLIER).sum()),
            refuted=hypothesis.refuted + int(against.sum()),
        )

    def _found(
        self,
        positions_m: NDArray[np.float64],
        headings_rad: NDArray[np.float64],
        ranges_m: NDArray[np.float64],
    ) -> list[WallPose]:
        options: dict[str, Any] = {
            "max_incidence_rad": self.ring.max_incidence_rad,
            "sigma_m": self.ring.sigmas(ranges_m),
            "max_range_m": self.ring.max_range_m,
        }
        readings = (positions_m, headings_rad, ranges_m, self.ring.half_beam_rad)
        found = walls(*readings, self.k, min_sensors=1, **options)
        if self.k == 1:
            # alternatives of one wall: a pair may allow a mirrored one
            allowed = [w for w in wall_pose(*readings, **options) if w.favoured]
            if np.isfinite(ranges_m).sum() <= 2:
                return allowed if len(allowed) > 1 else found
            for wall in allowed:
                if not any(self._same(wall, other, wall.phi_std_rad) for other in found):
                    found.append(wall)
        return found

    def _match(self, before: list[Hypothesis], found: list[WallPose]) -> None:
        matched: list[Hypothesis] = []
        left = list(before)
        for wall in found:
            own = [h for h in left if self._same(h.wall, wall)]
            if own:
                left.remove(own[0])
                matched.append(replace(own[0], wall=wall))
            else:
                matched.append(Hypothesis(wall))
        self.hypotheses = matched
        self.refuted += [h for h in left if h.state == "refuted"]

    def _same(self, a: WallPose, b: WallPose, phi_std_rad: float = 0.0) -> bool:
        """Whether two walls are one, within their distances and a standard deviation of φ."""
        a, b = self._from_here(a), self._from_here(b)
        turn = abs(math.remainder(a.phi_rad - b.phi_rad, 2.0 * math.pi))
        margin_m = 3.0 * math.hypot(a.distance_std_m, b.distance_std_m)
        return (
            turn <= max(self.ring.half_beam_rad, 3.0 * phi_std_rad)
            and abs(a.distance_m - b.distance_m) <= margin_m
        )
