"""The client `follow-wall-2`: a filter of distance and heading along a wall, and corrections from it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from surffollow.apps.wall_sensing import CRUISE_MPS, BaseRequest, Sensing, beams_near, wrap
from surffollow.sonar.ring import SonarRing


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
    cruise_mps: float = CRUISE_MPS  # 0: turn on the spot
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

    def step(self, seen: Sensing, held: bool) -> BaseRequest:
        """Keep the filter going; correct once a second."""
        self._predict(seen)
        self._measure(seen)
        if self._left_rad != 0.0:
            return self._correct(seen, held)
        certain = self._side != 0.0 and math.sqrt(self._cov[1, 1]) < math.radians(4.0)
        if not certain or seen.t_s < self._next_s:
            return BaseRequest(False)
        self._next_s = seen.t_s + self.period_s
        if math.isnan(self._kept_m) and math.sqrt(self._cov[0, 0]) < 0.015:
            self._kept_m = float(self._state[0])
        # a heading toward the wall is positive; aim 0.8 m ahead at the desired distance
        aim = 0.0 if math.isnan(self._kept_m) else math.atan2(self._state[0] - self._kept_m, 0.8)
        aim = max(-self.most_rad, min(self.most_rad, aim))
        turn = self._side * (aim - self._state[1])
        turn = max(-self.most_rad, min(self.most_rad, turn))
        if abs(turn) < math.radians(0.2):
            return BaseRequest(False)
        self._left_rad, self._until_s = turn, seen.t_s + 0.8
        return self._correct(seen, held)

    def _correct(self, seen: Sensing, held: bool) -> BaseRequest:
        if seen.t_s > self._until_s:
            self._left_rad = 0.0
            return BaseRequest(False)
        rate = math.copysign(min(0.2, 3.0 * abs(self._left_rad) + 0.02), self._left_rad)
        return BaseRequest(True, self.cruise_mps, rate)

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
