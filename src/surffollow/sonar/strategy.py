"""Which reading to take next: the smallest turn or drive after which the walls should be known.

The paper's criterion is the fewest sonars used and moves made. For each move and several normals within each
wall's posterior, the readings after the move are predicted, and the wall is fused with them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surffollow.sonar.agreement import INLIER, UNEXPLAINED
from surffollow.sonar.beam import predict_ranges
from surffollow.sonar.belief import Belief
from surffollow.sonar.pair import SOLUTION
from surffollow.sonar.posterior import N_POINTS, fuse
from surffollow.sonar.refinement import REACH_RAD
from surffollow.sonar.ring import Pose
from surffollow.sonar.wall import WallPose

# normals looked at, in half widths of a uniform distribution of the posterior's variance
QUANTILES = (-0.8, -0.4, 0.0, 0.4, 0.8)
DRIVES_M = (0.1, -0.1, 0.3, -0.3)
N_SIGMA = 3.0
WALL_MARGIN_M = 0.1  # a drive ends no nearer than the ring's radius and this to a supposed wall


@dataclass(frozen=True)
class Reading:
    """A proposed reading: turn, drive, then fire.

    Attributes
    ----------
    turn_rad, drive_m : float
    sensors : tuple of int
        sonars to fire
    expected_known : float
        walls that should be known afterwards
    separates : bool
        it distinguishes competing hypotheses
    """

    turn_rad: float
    drive_m: float
    sensors: tuple[int, ...]
    expected_known: float
    separates: bool

    @property
    def moves(self) -> int:
        """1 when the robot has to move, else 0."""
        return int(self.turn_rad != 0.0 or self.drive_m != 0.0)


def candidate_moves(belief: Belief) -> list[tuple[float, float]]:
    """Turns and drives that are looked at, smallest first: shares of the beams' spacing, then drives.

    Returns
    -------
    list of (turn_rad, drive_m)
    """
    s = belief.ring.spacing_rad
    turns = [sign * s * k / 8.0 for k in range(1, 9) for sign in (1.0, -1.0)]
    return [(t, 0.0) for t in turns] + [(0.0, d) for d in DRIVES_M if _is_clear(belief, d)]


def _is_clear(belief: Belief, drive_m: float) -> bool:
    before, after = belief.pose, _pose_after(belief, 0.0, drive_m)
    room = float(np.hypot(*belief.ring.positions_m.T).max()) + WALL_MARGIN_M
    # the robot may be on either side of a wall, and stays there
    return all(
        w.moved(*after).distance_m * math.copysign(1.0, w.moved(*before).distance_m) > room
        for w in belief.walls
    )


def _pose_after(belief: Belief, turn_rad: float, drive_m: float) -> Pose:
    x, y, heading = belief.pose
    heading += turn_rad
    return (x + drive_m * math.cos(heading), y + drive_m * math.sin(heading), heading)


def _predicted(
    belief: Belief, pose: Pose, sensors: tuple[int, ...], rows: list[tuple[float, float]]
) -> NDArray[np.float64]:
    positions, headings = belief.ring.at(pose)
    index = list(sensors)
    ranges = np.empty(len(index))
    predict_ranges(
        np.ascontiguousarray(positions[index]),
        np.ascontiguousarray(headings[index]),
        belief.ring.half_beam_rad,
        belief.ring.max_incidence_rad,
        np.array(rows).reshape(-1, 2),
        ranges,
    )
    ranges[ranges > belief.ring.max_range_m] = math.inf
    return ranges


def _separates(belief: Belief, pose: Pose, sensors: tuple[int, ...]) -> bool:
    """Whether any two competing hypotheses predict readings that differ by more than their noise."""
    predictions = [_predicted(belief, pose, sensors, [(w.phi_rad, w.distance_m)]) for w in belief.walls]
    for i, a in enumerate(predictions):
        for b in predictions[i + 1 :]:
            both = np.isfinite(a) & np.isfinite(b)
            apart = np.abs(a[both] - b[both]) > 2.0 * N_SIGMA * belief.ring.range_sigma * a[both]
            if not apart.any() and not (np.isfinite(a) != np.isfinite(b)).any():
                return False
    return True


def _chance(belief: Belief, wall: WallPose, pose: Pose, sensors: tuple[int, ...]) -> float:
    """Share of the wall's possible normals for which the readings would make it known."""
    if belief.is_known(wall):
        return 1.0
    ring, known = belief.ring, 0
    # all about the robot's place after the move: errors of d do not depend on where the belief began
    x, y, heading = pose
    pose, seen = (0.0, 0.0, heading), [w.moved(x, y, 0.0) for w in belief.walls if w is not wall]
    wall, others = wall.moved(x, y, 0.0), [(w.phi_rad, w.distance_m) for w in seen]
    positions, headings = ring.at(pose)
    index = list(sensors)
    all_positions = np.vstack([belief.positions_m - (x, y), positions[index]])
    all_headings = np.append(belief.headings_rad, headings[index])
    verdicts = np.full(all_headings.size, UNEXPLAINED, np.int64)
    points, row = np.empty((N_POINTS, 4)), np.empty(SOLUTION)
    half_width = math.sqrt(3.0) * wall.phi_std_rad
    gain = wall.covariance[0, 1] / max(wall.covariance[0, 0], 1e-30)
    for q in QUANTILES:
        phi, distance = wall.phi_rad + q * half_width, wall.distance_m + gain * q * half_width
        fresh = _predicted(belief, pose, sensors, [(phi, distance), *others])
        alone = _predicted(belief, pose, sensors, [(phi, distance)])
        verdicts[:] = UNEXPLAINED
        verdicts[list(wall.sensors)] = INLIER
        verdicts[belief.ranges_m.size :][np.isfinite(fresh) & (fresh == alone)] = INLIER
        row[:] = phi, distance, 0.0, 0.0, 0.0
        readings = ring.readings(all_positions, all_headings, np.append(belief.ranges_m, fresh))
        fused = fuse(readings, verdicts, phi, REACH_RAD, points, row)
        known += bool(
            fused
            and math.sqrt(row[2]) <= belief.phi_bound_rad
            and math.sqrt(row[4]) <= belief.distance_bound_m
        )
    return known / len(QUANTILES)


def next_reading(belief: Belief) -> Reading | None:
    """The reading that removes an ambiguity or makes the walls known with the least effort.

    Sonars that were not fired at the present pose come first: they cost no move. Then the smallest move is
    chosen among those after which the most walls are expected to be known.

    Returns
    -------
    Reading, or None when the belief is settled
    """
    if belief.settled:
        return None
    best: tuple[tuple[float, ...], Reading] | None = None
    everything = tuple(range(belief.ring.headings_rad.size))
    unfired = belief.unfired()
    plans = [(0.0, 0.0, unfired)] if unfired else []
    plans += [(turn, drive, everything) for turn, drive in candidate_moves(belief)]
    for order, (turn, drive, sensors) in enumerate(plans):
        pose = _pose_after(belief, turn, drive)
        separates = not belief.ambiguous or _separates(belief, pose, sensors)
        known = sum(_chance(belief, w, pose, sensors) for w in belief.walls[: belief.k])
        moves = int(turn != 0.0 or drive != 0.0)
        rank = (
            float(separates),
            -float(moves) if not belief.walls else 0.0,
            known,
            -float(moves),
            -float(order),
        )
        if best is None or rank > best[0]:
            best = (rank, Reading(turn, drive, sensors, known, separates))
        if not belief.walls or (separates and known >= belief.k):
            break  # plans come in the order of their effort
    return best[1] if best else None
