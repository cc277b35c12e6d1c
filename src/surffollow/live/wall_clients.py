"""The clients of the wall-following experiments: what each wants of the base, step by step.

Four clients share the base by priority: `avoid` 40, `follow-wall` 30, `follow-wall-2` 20, `go` 10 (Dekhil and
Henderson, section 3). A client sees the sensors and the odometry, and answers whether it wants the base and
for which command. Time is an argument, so the same code runs in a process of its own and in simulated time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from surffollow.sonar.belief import Belief, SonarRing
from surffollow.sonar.poses import WallPose, optimal_pair, walls

PRIORITIES = {"avoid": 40, "follow-wall": 30, "follow-wall-2": 20, "go": 10}
CRUISE_MPS = 0.2
TRIGGER_M = 0.7  # range of the front sonars at which follow-wall takes over
STOP_M = 0.2  # range of any sensor at which avoid takes over
CLEAR_M = 0.35
TURN_RADPS = 0.5
SETTLE_S = 0.35  # standstill before ranges count: three rounds of the ring


class Sensing(NamedTuple):
    """What a client sees.

    Attributes
    ----------
    t_s : float                       now
    pose : (x, y, heading)            odometry [m, m, rad]
    speed, turn_rate : float          odometry [m/s, rad/s]
    sonar_m, sonar_s : (m,) ndarray   ranges (inf: no echo, NaN: none yet) and when they were fired
    infrared_m : (8,) ndarray         distances; inf: nothing near
    """

    t_s: float
    pose: tuple[float, float, float]
    speed: float
    turn_rate: float
    sonar_m: NDArray[np.float64]
    sonar_s: NDArray[np.float64]
    infrared_m: NDArray[np.float64]


class Wish(NamedTuple):
    """Whether a client wants the base, and its command: speed [m/s], turn rate [rad/s]."""

    wanted: bool
    speed: float = 0.0
    turn_rate: float = 0.0


class BaseClient(Protocol):
    """A client of the base."""

    name: str

    def step(self, seen: Sensing, held: bool) -> Wish:
        """What it wants now; `held`: the arbiter granted it the base."""


def wrap(angle_rad: float) -> float:
    """An angle in [−π, π]."""
    return math.remainder(angle_rad, 2.0 * math.pi)


def beams_near(ring: SonarRing, direction_rad: float, count: int) -> list[int]:
    """The `count` sonars whose axes lie nearest to a direction in the robot frame."""
    away = [abs(wrap(h - direction_rad)) for h in ring.headings_rad]
    return sorted(range(len(away)), key=lambda k: away[k])[:count]


@dataclass
class Go:
    """Drive ahead at constant speed."""

    name: str = "go"

    def step(self, seen: Sensing, held: bool) -> Wish:
        """Always the same."""
        return Wish(True, CRUISE_MPS)


@dataclass
class Avoid:
    """Halt before anything nearer than the stop distance, and turn away from it."""

    ring: SonarRing
    name: str = "avoid"
    _turning: float = 0.0

    def step(self, seen: Sensing, held: bool) -> Wish:
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
        return Wish(self._turning != 0.0, 0.0, TURN_RADPS * self._turning)


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

    def step(self, seen: Sensing, held: bool) -> Wish:
        """Watch the front three sonars; stop, turn, look again."""
        if self._phase == "watch":
            front = seen.sonar_m[beams_near(self.ring, 0.0, 3)]
            if np.nan_to_num(front, nan=math.inf).min() >= TRIGGER_M:
                return Wish(False)
            self._enter("stop", seen)
        if not held:
            self._since_s = seen.t_s  # not ours yet, or taken by avoid: begin this phase anew
            return Wish(True)
        if self._phase == "turn":
            return self._turn(seen)
        if abs(seen.speed) > 0.005 or abs(seen.turn_rate) > 0.01:
            self._since_s = seen.t_s
        if seen.t_s - self._since_s < SETTLE_S:
            return Wish(True)
        return self._estimate_ahead(seen) if self._phase == "stop" else self._look(seen)

    def _enter(self, phase: Literal["watch", "stop", "turn", "look"], seen: Sensing) -> None:
        self._phase, self._since_s = phase, seen.t_s

    def _estimate_ahead(self, seen: Sensing) -> Wish:
        wall = self._pair_ahead(seen) if self.method == "pair" else self._nearest(seen, 0.0)
        if wall is None:  # this round gave no wall: take the next
            self._since_s = seen.t_s
            return Wish(True)
        # the wall ahead comes to lie on the right
        self._target = seen.pose[2] + wrap(wall.phi_rad + 0.5 * math.pi)
        self._corrections, self._belief = 0, None
        self._enter("turn", seen)
        return Wish(True)

    def _turn(self, seen: Sensing) -> Wish:
        left = self._target - seen.pose[2]
        if abs(left) < math.radians(0.15) and abs(seen.turn_rate) < 0.02:
            if self.method == "pair":
                self._enter("watch", seen)
                return Wish(False)
            self._enter("look", seen)
            return Wish(True)
        rate = math.copysign(min(TURN_RADPS, 2.0 * abs(left) + 0.01), left)
        return Wish(True, 0.0, rate)

    def _look(self, seen: Sensing) -> Wish:
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
            return Wish(False)
        wall = min(side, key=lambda w: w.phi_std_rad)
        error = wrap(wall.phi_rad + 0.5 * math.pi)
        if wall.phi_std_rad <= self.heading_bound_rad and abs(error) < math.radians(0.3):
            self._enter("watch", seen)
            return Wish(False)
        # turn onto the estimate; while it is uncertain, to either side of it, so that other beams look
        spread = 0.0 if wall.phi_std_rad <= self.heading_bound_rad else 1.5 * wall.phi_std_rad
        self._target = seen.pose[2] + error + spread * (-1.0) ** self._corrections
        self._corrections += 1
        self._enter("turn", seen)
        return Wish(True)

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


@dataclass
class FollowWall2:
    """Small heading corrections, once a second, from three sonars on the side nearer to a wall.

    The filter's state is the distance to the wall and the heading along it. Each sonar of the side gives a
    distance where its beam covers the wall's normal. The heading follows from how the distance changes along
    the way. The distance that is kept is the first one known within 15 mm after the base came to this wall.
    """

    ring: SonarRing
    period_s: float = 1.0
    most_rad: float = math.radians(4.0)
    name: str = "follow-wall-2"
    _side: float = 0.0  # +1: wall on the left, −1: on the right, 0: none
    _state: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    _cov: NDArray[np.float64] = field(default_factory=lambda: np.eye(2))
    _at: tuple[float, float, float] | None = None
    _used_s: float = -math.inf
    _next_s: float = 0.0
    _left_rad: float = 0.0
    _until_s: float = 0.0
    _kept_m: float = math.nan

    def step(self, seen: Sensing, held: bool) -> Wish:
        """Keep the filter going; correct once a second."""
        self._predict(seen)
        self._measure(seen)
        if self._left_rad != 0.0:
            return self._correct(seen, held)
        certain = self._side != 0.0 and math.sqrt(self._cov[1, 1]) < math.radians(4.0)
        if not certain or seen.t_s < self._next_s:
            return Wish(False)
        self._next_s = seen.t_s + self.period_s
        if math.isnan(self._kept_m) and math.sqrt(self._cov[0, 0]) < 0.015:
            self._kept_m = float(self._state[0])
        # a heading toward the wall is positive; aim 0.8 m ahead at the wanted distance
        aim = 0.0 if math.isnan(self._kept_m) else math.atan2(self._state[0] - self._kept_m, 0.8)
        aim = max(-self.most_rad, min(self.most_rad, aim))
        turn = self._side * (aim - self._state[1])
        turn = max(-self.most_rad, min(self.most_rad, turn))
        if abs(turn) < math.radians(0.2):
            return Wish(False)
        self._left_rad, self._until_s = turn, seen.t_s + 0.8
        return self._correct(seen, held)

    def _correct(self, seen: Sensing, held: bool) -> Wish:
        if seen.t_s > self._until_s:
            self._left_rad = 0.0
            return Wish(False)
        rate = math.copysign(min(0.2, 3.0 * abs(self._left_rad) + 0.02), self._left_rad)
        return Wish(True, CRUISE_MPS, rate)

    def _predict(self, seen: Sensing) -> None:
        if self._at is None:
            self._at = seen.pose
        way = math.hypot(seen.pose[0] - self._at[0], seen.pose[1] - self._at[1])
        turn = wrap(seen.pose[2] - self._at[2])
        self._at = seen.pose
        if abs(self._left_rad) > 0.0:
            before = self._left_rad
            self._left_rad -= turn
            if before * self._left_rad <= 0.0 or abs(self._left_rad) < math.radians(0.1):
                self._left_rad = 0.0
                self._until_s = 0.0
        if self._side == 0.0:
            return
        d, theta = self._state
        self._state[:] = d - way * math.sin(theta), theta + self._side * turn
        step = np.array([[1.0, -way * math.cos(theta)], [0.0, 1.0]])
        slip = (0.02 * abs(turn)) ** 2 + (math.radians(0.2) ** 2) * way
        self._cov = step @ self._cov @ step.T + np.diag([(0.01 * way) ** 2, slip])
        if abs(theta) > math.radians(35) or abs(turn) > math.radians(20):
            self._side = 0.0

    def _measure(self, seen: Sensing) -> None:
        ring = self.ring
        if self._side == 0.0:
            ranges = {s: seen.sonar_m[beams_near(ring, s * 0.5 * math.pi, 3)] for s in (1.0, -1.0)}
            nearest = {s: float(np.nan_to_num(r, nan=math.inf).min()) for s, r in ranges.items()}
            side = min(nearest, key=lambda s: nearest[s])
            if abs(seen.turn_rate) > 0.05 or nearest[side] > 2.0:
                return
            self._side, self._kept_m = side, math.nan
            self._state[:] = nearest[side] + 0.35, 0.0
            self._cov = np.diag([0.05**2, math.radians(6.0) ** 2])
            self._used_s = seen.t_s
            return
        newest = self._used_s
        for k in beams_near(ring, self._side * 0.5 * math.pi, 3):
            if seen.sonar_s[k] <= self._used_s or not math.isfinite(seen.sonar_m[k]):
                continue
            newest = max(newest, float(seen.sonar_s[k]))
            self._update(k, float(seen.sonar_m[k]), seen)
        self._used_s = newest

    def _update(self, k: int, range_m: float, seen: Sensing) -> None:
        ring = self.ring
        # the wall's normal in the robot frame, as the filter has it
        phi = self._side * (0.5 * math.pi - self._state[1])
        x, y = ring.positions_m[k]
        off = wrap(phi - ring.headings_rad[k])
        edge = max(0.0, abs(off) - ring.half_beam_rad)
        if abs(off) > ring.max_incidence_rad:
            return
        along = math.cos(phi) * x + math.sin(phi) * y
        expected = (self._state[0] - along) / math.cos(edge)
        # d(expected)/d(d) and /d(theta); dphi/dtheta = −side
        by_phi = (math.sin(phi) * x - math.cos(phi) * y) / math.cos(edge)
        if edge > 0.0:
            by_phi += expected * math.tan(edge) * math.copysign(1.0, off)
        gradient = np.array([1.0 / math.cos(edge), -self._side * by_phi])
        sigma = range_m * ring.range_sigma * (1.0 + 5.0 * abs(seen.speed) + 5.0 * abs(seen.turn_rate))
        variance = float(gradient @ self._cov @ gradient) + sigma * sigma
        innovation = range_m - expected
        if innovation * innovation > 25.0 * variance:
            return
        gain = self._cov @ gradient / variance
        self._state += gain * innovation
        self._cov = self._cov - np.outer(gain, gradient @ self._cov)


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
