"""The clients of the wall-following experiments: their requests for the base, step by step.

Four clients share the base by priority: `avoid` 40, `follow-wall` 30, `follow-wall-2` 20, `go` 10 (Dekhil and
Henderson, section 3). A client sees the sensors and the odometry, and answers whether it requests the base
and for which command. Time is an argument: the same code runs in its own process and in simulated time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from surffollow.apps.wall_sensing import CRUISE_MPS, BaseClient, BaseRequest, Sensing, beams_near, wrap
from surffollow.apps.wall_side import FollowWall2
from surffollow.sonar.belief import Belief
from surffollow.sonar.fused_poses import walls
from surffollow.sonar.pair_poses import optimal_pair
from surffollow.sonar.ring import SonarRing
from surffollow.sonar.wall import WallPose

PRIORITIES = {"avoid": 40, "follow-wall": 30, "follow-wall-2": 20, "go": 10}
TRIGGER_M = 0.7  # range of the front sonars at which follow-wall takes over
STOP_M = 0.2  # range of any sensor at which avoid takes over
CLEAR_M = 0.35
TURN_RADPS = 0.5
SETTLE_S = 0.35  # standstill before ranges count: three rounds of the ring


@dataclass
class Go:
    """Drive ahead at constant speed."""

    name: str = "go"

    def step(self, seen: Sensing, held: bool) -> BaseRequest:
        """Always the same."""
        return BaseRequest(True, CRUISE_MPS)


@dataclass
class Avoid:
    """Halt before anything nearer than the stop distance, and turn away from it."""

    ring: SonarRing
    name: str = "avoid"
    _turning: float = 0.0

    def step(self, seen: Sensing, held: bool) -> BaseRequest:
        """Halt and turn until the way ahead is clear."""
        ahead = [
            k for k in range(len(seen.sonar_m)) if abs(wrap(self.ring.headings_rad[k])) < math.radians(50)
        ]
        sonar = np.nan_to_num(seen.sonar_m[ahead], nan=math.inf)
        infrared = seen.infrared_m[[-1, 0, 1]]  # 45° to both sides of ahead
        near = float(min(sonar.min(), infrared.min()))
        if near < STOP_M and self._turning == 0.0:
            left, right = seen.infrared_m[1], seen.infrared_m[-1]
            self._turning = 1.0 if left >= right else -1.0
        elif near > CLEAR_M:
            self._turning = 0.0
        return BaseRequest(self._turning != 0.0, 0.0, TURN_RADPS * self._turning)


@dataclass
class FollowWall:
    """Stop before a wall ahead, estimate its pose, turn parallel to it, and give the base back.

    Parameters
    ----------
    ring : SonarRing
    method : "pair" or "fused"
        "pair": the paper's way: two of the front three sonars, one reading each. "fused": all sonars, and
        after the turn small corrections until the heading is known within `heading_bound_rad`.
    """

    ring: SonarRing
    method: Literal["pair", "fused"] = "fused"
    heading_bound_rad: float = math.radians(0.7)
    most_corrections: int = 6
    name: str = "follow-wall"
    _phase: Literal["watch", "stop", "turn", "look"] = "watch"
    _since_s: float = 0.0
    _target: float = 0.0
    _corrections: int = 0
    _belief: Belief | None = field(default=None)

    def step(self, seen: Sensing, held: bool) -> BaseRequest:
        """Watch the front three sonars; stop, turn, look again."""
        if self._phase == "watch":
            front = seen.sonar_m[beams_near(self.ring, 0.0, 3)]
            if np.nan_to_num(front, nan=math.inf).min() >= TRIGGER_M:
                return BaseRequest(False)
            self._enter("stop", seen)
        if not held:
            self._since_s = seen.t_s  # not ours yet, or taken by avoid: begin this phase anew
            return BaseRequest(True)
        if self._phase == "turn":
            return self._turn(seen)
        if abs(seen.speed) > 0.005 or abs(seen.turn_rate) > 0.01:
            self._since_s = seen.t_s
        if seen.t_s - self._since_s < SETTLE_S:
            return BaseRequest(True)
        return self._estimate_ahead(seen) if self._phase == "stop" else self._look(seen)

    def _enter(self, phase: Literal["watch", "stop", "turn", "look"], seen: Sensing) -> None:
        self._phase, self._since_s = phase, seen.t_s

    def _estimate_ahead(self, seen: Sensing) -> BaseRequest:
        wall = self._pair_ahead(seen) if self.method == "pair" else self._nearest(seen, 0.0)
        if wall is None:  # this round gave no wall: take the next
            self._since_s = seen.t_s
            return BaseRequest(True)
        # the wall ahead comes to lie on the right
        self._target = seen.pose[2] + wrap(wall.phi_rad + 0.5 * math.pi)
        self._corrections, self._belief = 0, None
        self._enter("turn", seen)
        return BaseRequest(True)

    def _turn(self, seen: Sensing) -> BaseRequest:
        left = self._target - seen.pose[2]
        if abs(left) < math.radians(0.15) and abs(seen.turn_rate) < 0.02:
            if self.method == "pair":
                self._enter("watch", seen)
                return BaseRequest(False)
            self._enter("look", seen)
            return BaseRequest(True)
        rate = math.copysign(min(TURN_RADPS, 2.0 * abs(left) + 0.01), left)
        return BaseRequest(True, 0.0, rate)

    def _look(self, seen: Sensing) -> BaseRequest:
        if self._belief is None:
            self._belief = Belief(self.ring, 4, phi_bound_rad=self.heading_bound_rad)
            self._at = seen.pose
        belief = self._belief
        belief.move(wrap(seen.pose[2] - self._at[2]))
        self._at = seen.pose
        belief.add(seen.sonar_m)
        here = [w.moved(*belief.pose) for w in belief.walls]
        side = [w for w in here if abs(wrap(w.phi_rad + 0.5 * math.pi)) < math.radians(40)]
        if not side or self._corrections >= self.most_corrections:
            self._enter("watch", seen)
            return BaseRequest(False)
        wall = min(side, key=lambda w: w.phi_std_rad)
        error = wrap(wall.phi_rad + 0.5 * math.pi)
        if wall.phi_std_rad <= self.heading_bound_rad and abs(error) < math.radians(0.3):
            self._enter("watch", seen)
            return BaseRequest(False)
        # turn onto the estimate; while it is uncertain, to either side of it, so that other beams look
        spread = 0.0 if wall.phi_std_rad <= self.heading_bound_rad else 1.5 * wall.phi_std_rad
        self._target = seen.pose[2] + error + spread * (-1.0) ** self._corrections
        self._corrections += 1
        self._enter("turn", seen)
        return BaseRequest(True)

    def _pair_ahead(self, seen: Sensing) -> WallPose | None:
        front = [k for k in beams_near(self.ring, 0.0, 3) if math.isfinite(seen.sonar_m[k])]
        nearest = sorted(front, key=lambda k: seen.sonar_m[k])[:2]
        if len(nearest) < 2:
            return None
        ring, r = self.ring, seen.sonar_m[nearest]
        return optimal_pair(
            ring.positions_m[nearest],
            ring.headings_rad[nearest],
            r,
            ring.half_beam_rad,
            max_incidence_rad=ring.max_incidence_rad,
            sigma_m=ring.sigmas(r),
        )

    def _nearest(self, seen: Sensing, direction_rad: float) -> WallPose | None:
        ring = self.ring
        found = walls(
            ring.positions_m,
            ring.headings_rad,
            seen.sonar_m,
            ring.half_beam_rad,
            4,
            min_sensors=1,
            sigma_m=ring.sigmas(seen.sonar_m),
            max_incidence_rad=ring.max_incidence_rad,
            max_range_m=ring.max_range_m,
        )
        near = [w for w in found if abs(wrap(w.phi_rad - direction_rad)) < math.radians(50)]
        return min(near, key=lambda w: abs(wrap(w.phi_rad - direction_rad)), default=None)


def make_clients(experiment: str, ring: SonarRing) -> list[BaseClient]:
    """The clients of an experiment: "paper" (go and follow-wall by a pair), "1" or "2"."""
    if experiment == "paper":
        return [FollowWall(ring, "pair"), Go()]
    clients: list[BaseClient] = [Avoid(ring), FollowWall(ring, "fused")]
    if experiment == "2":
        clients.append(FollowWall2(ring))
    elif experiment == "1-pair":
        clients[1] = FollowWall(ring, "pair")
    return [*clients, Go()]
