"""Inputs and outputs of the clients of the wall-following experiments."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from surffollow.sonar.ring import SonarRing

CRUISE_MPS = 0.2


class Sensing(NamedTuple):
    """Inputs of a client.

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


class BaseRequest(NamedTuple):
    """Whether a client requests the base, and its command: speed [m/s], turn rate [rad/s]."""

    desired: bool
    speed: float = 0.0
    turn_rate: float = 0.0


class BaseClient(Protocol):
    """A client of the base."""

    name: str

    def step(self, seen: Sensing, held: bool) -> BaseRequest:
        """Its present request; `held`: the arbiter granted it the base."""


def wrap(angle_rad: float) -> float:
    """An angle in [−π, π]."""
    return math.remainder(angle_rad, 2.0 * math.pi)


def beams_near(ring: SonarRing, direction_rad: float, count: int) -> list[int]:
    """The `count` sonars whose axes lie nearest to a direction in the robot frame."""
    away = [abs(wrap(h - direction_rad)) for h in ring.headings_rad]
    return sorted(range(len(away)), key=lambda k: away[k])[:count]
