"""A simulated mobile base: differential drive behind a serial line, sonars fired in turn, infrared, odometry.

Modelled on the TRC Labmate of Dekhil and Henderson, section 3: 24 sonars on a ring, eight infrared sensors, a
serial line to the drive. The range model is written here once more, apart from the estimator's, so that an
error in one of them shows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import ConfigError
from surffollow.shm.jit import jit

(
    X, Y, HEADING, SPEED, TURN_RATE, ODOMETRY_X, ODOMETRY_Y, ODOMETRY_HEADING, NEXT_SONAR, NEXT_FIRE_S,
    NEXT_INFRARED_S, TIME_S, DRAWN, ODOMETRY_SPEED, ODOMETRY_TURN_RATE,
) = range(15)  # fmt: skip
STATE = 15
BUMPER_M = 0.001  # so far the rim can be pressed into a wall
N_INFRARED = 8
ROUND_HZ, INFRARED_HZ = 9.0, 20.0
STEP_S = 0.005


@dataclass(frozen=True)
class BaseConfig:
    """The simulated base and its enclosure.

    Attributes
    ----------
    room_m : (float, float)        inner size of the rectangular enclosure
    start : (x, y, heading)        m, m, rad
    radius_m : float               of the ring of sonars
    sonars : int                   fired in turn, 9 rounds a second
    half_beam_rad, max_incidence_rad : float   α and δ_max of the sonars
    range_noise : float            share of the range while the base stands
    motion_noise : float           further shares per m/s, and per rad/s
    max_range_m, infrared_max_m, infrared_noise_m : float
    acceleration, turn_acceleration : float    m/s², rad/s²
    max_speed, max_turn_rate : float           m/s, rad/s
    slip : float                   share by which odometry errs: a constant of each run, and noise
    serial_s : float               delay of commands
    """

    room_m: tuple[float, float] = (6.0, 4.0)
    start: tuple[float, float, float] = (1.5, 1.05, 0.0)
    radius_m: float = 0.35
    sonars: int = 24
    half_beam_rad: float = math.radians(11.25)
    max_incidence_rad: float = math.radians(30.0)
    range_noise: float = 0.01
    motion_noise: float = 0.05
    max_range_m: float = 8.0
    infrared_max_m: float = 0.8
    infrared_noise_m: float = 0.01
    acceleration: float = 0.5
    turn_acceleration: float = 2.0
    max_speed: float = 0.5
    max_turn_rate: float = 1.0
    slip: float = 0.01
    serial_s: float = 0.02

    def __post_init__(self) -> None:
        if min(self.room_m) < 4.0 * self.radius_m:
            raise ConfigError(
                f"a room of {self.room_m} m leaves no way for a base of radius {self.radius_m} m"
            )
        if not all(self.radius_m <= a <= b - self.radius_m for a, b in zip(self.start, self.room_m)):
            raise ConfigError(
                f"a start at {self.start[:2]} m is not inside a room of {self.room_m} m; a base of radius "
                f"{self.radius_m} m has its centre at least so far from every wall"
            )
        if not 1 <= self.sonars <= 64:
            raise ConfigError(f"{self.sonars} sonars; choose 1 to 64")


@jit
def echo_m(x: Any, y: Any, heading: Any, half_beam: Any, max_incidence: Any, width: Any, depth: Any) -> Any:
    """Range of the nearest wall of a room [0, width] × [0, depth] for one sonar; inf: no echo.

    Parameters
    ----------
    x, y, heading : float     place of the sonar and axis of its beam [m, m, rad]
    half_beam, max_incidence : float [rad]  α and δ_max
    width, depth : float [m]  size of the room
    """
    nearest = math.inf
    for wall in range(4):
        # normals 0°, 90°, 180°, 270°; distances from the sonar itself
        away = width - x if wall == 0 else depth - y if wall == 1 else x if wall == 2 else y
        off = heading - 0.5 * math.pi * wall
        off = abs(off - 2.0 * math.pi * math.floor((off + math.pi) / (2.0 * math.pi)))
        if off > max_incidence or away <= 0.0:
            continue
        slant = math.cos(max(0.0, off - half_beam))
        if slant > 1e-6:
            nearest = min(nearest, away / slant)
    return nearest


@jit
def ray_m(x: Any, y: Any, heading: Any, width: Any, depth: Any) -> Any:
    """Distance along one ray to the wall of the room.

    Parameters
    ----------
    x, y, heading : float     begin and direction of the ray [m, m, rad]
    width, depth : float [m]  size of the room
    """
    c, s = math.cos(heading), math.sin(heading)
    nearest = math.inf
    if c > 1e-9:
        nearest = min(nearest, (width - x) / c)
    if c < -1e-9:
        nearest = min(nearest, -x / c)
    if s > 1e-9:
        nearest = min(nearest, (depth - y) / s)
    if s < -1e-9:
        nearest = min(nearest, -y / s)
    return nearest


@jit
def advance(
    state: Any, command: Any, until_s: Any, constants: Any, slip: Any, noise: Any, sonar_m: Any, sonar_s: Any,
    infrared_m: Any,
) -> None:  # fmt: skip
    """Move the base to a time, firing the sensors that are due on the way.

    Walls are rigid: a base that is driven against one slides along it while its wheels slip, so that odometry
    goes on.

    Parameters
    ----------
    state : (15,) float64          see the indices of this module; updated
    command : (2,) float64         speed [m/s] and turn rate [rad/s] that arrived
    constants : (14,) float64      of `SimulatedBase`
    slip : (3,) float64            shares by which odometry errs: left, right, noise per √s
    noise : (n,) float64           standard normal numbers, used in turn
    sonar_m, sonar_s : (m,) float64     ranges (inf: no echo) and when they were fired; updated
    infrared_m : (8,) float64      updated; inf: nothing near
    """
    width, depth, radius, half_beam, max_incidence = constants[0:5]
    still, moving, max_range, infrared_max, infrared_noise = constants[5:10]
    acceleration, turn_acceleration, max_speed, max_turn_rate = constants[10:14]
    m = sonar_m.size
    while state[TIME_S] < until_s - 1e-9:
        dt = min(STEP_S, until_s - state[TIME_S])
        desired_v = min(max(command[0], -max_speed), max_speed)
        desired_w = min(max(command[1], -max_turn_rate), max_turn_rate)
        state[SPEED] += min(max(desired_v - state[SPEED], -acceleration * dt), acceleration * dt)
        change = turn_acceleration * dt
        state[TURN_RATE] += min(max(desired_w - state[TURN_RATE], -change), change)
        v, w = state[SPEED], state[TURN_RATE]
        middle = state[HEADING] + 0.5 * w * dt
        nearest = radius - BUMPER_M
        state[X] = min(max(state[X] + v * dt * math.cos(middle), nearest), width - nearest)
        state[Y] = min(max(state[Y] + v * dt * math.sin(middle), nearest), depth - nearest)
        state[HEADING] += w * dt
        # wheels slip: odometry differs by a constant and by noise that grows with the distance travelled
        drawn = int(state[DRAWN])
        rough = slip[2] * math.sqrt(dt)
        seen_v = v * (1.0 + slip[0]) + rough * abs(v) / math.sqrt(dt + 1e-12) * noise[drawn % noise.size]
        seen_w = (
            w * (1.0 + slip[1]) + rough * abs(w) / math.sqrt(dt + 1e-12) * noise[(drawn + 1) % noise.size]
        )
        drawn += 2
        middle = state[ODOMETRY_HEADING] + 0.5 * seen_w * dt
        state[ODOMETRY_X] += seen_v * dt * math.cos(middle)
        state[ODOMETRY_Y] += seen_v * dt * math.sin(middle)
        state[ODOMETRY_HEADING] += seen_w * dt
        state[ODOMETRY_SPEED], state[ODOMETRY_TURN_RATE] = seen_v, seen_w
        state[TIME_S] += dt
        while state[NEXT_FIRE_S] <= state[TIME_S]:
            k = int(state[NEXT_SONAR])
            axis = state[HEADING] + 2.0 * math.pi * k / m
            x, y = state[X] + radius * math.cos(axis), state[Y] + radius * math.sin(axis)
            r = echo_m(x, y, axis, half_beam, max_incidence, width, depth)
            share = still + moving * still / 0.01 * (abs(v) + abs(w))
            r *= 1.0 + share * noise[drawn % noise.size]
            drawn += 1
            sonar_m[k] = r if 0.0 < r <= max_range else math.inf
            sonar_s[k] = state[NEXT_FIRE_S]
            state[NEXT_SONAR] = (k + 1) % m
            state[NEXT_FIRE_S] += 1.0 / (ROUND_HZ * m)
        if state[NEXT_INFRARED_S] <= state[TIME_S]:
            state[NEXT_INFRARED_S] += 1.0 / INFRARED_HZ
            for k in range(infrared_m.size):
                axis = state[HEADING] + 2.0 * math.pi * k / infrared_m.size
                x, y = state[X] + radius * math.cos(axis), state[Y] + radius * math.sin(axis)
                r = ray_m(x, y, axis, width, depth) + infrared_noise * noise[drawn % noise.size]
                drawn += 1
                infrared_m[k] = max(r, 0.0) if r <= infrared_max else math.inf
        state[DRAWN] = drawn


class SimulatedBase:
    """The base with its state; time is an argument.

    Parameters
    ----------
    config : BaseConfig
    seed : int             of range noise and slip

    Attributes
    ----------
    state : (15,) ndarray          see the indices of this module
    sonar_m, sonar_s : (m,) ndarray    newest ranges [m] (inf: no echo, NaN: none yet) and their times [s]
    infrared_m : (8,) ndarray      newest distances [m]; inf: nothing near
    """

    def __init__(self, config: BaseConfig | None = None, seed: int = 1) -> None:
        self.config = config or BaseConfig()
        c, rng = self.config, np.random.default_rng(seed)
        self.state = np.zeros(STATE)
        self.state[[X, Y, HEADING]] = self.state[[ODOMETRY_X, ODOMETRY_Y, ODOMETRY_HEADING]] = c.start
        self.sonar_m, self.sonar_s = np.full(c.sonars, math.nan), np.full(c.sonars, -math.inf)
        self.infrared_m = np.full(N_INFRARED, math.inf)
        self._noise = rng.standard_normal(1 << 16)
        self._slip = np.array([*(c.slip * rng.standard_normal(2)), c.slip])
        self._constants = np.array(
            [
                *c.room_m, c.radius_m, c.half_beam_rad, c.max_incidence_rad, c.range_noise, c.motion_noise,
                c.max_range_m, c.infrared_max_m, c.infrared_noise_m, c.acceleration, c.turn_acceleration,
                c.max_speed, c.max_turn_rate,
            ]
        )  # fmt: skip
        self._queue: list[tuple[float, float, float]] = []
        self._command: NDArray[np.float64] = np.zeros(2)

    @property
    def time_s(self) -> float:
        """How far the simulation is [s]."""
        return float(self.state[TIME_S])

    @property
    def wall_gap_m(self) -> float:
        """True distance of the base's rim from the nearest wall [m]; down to −`BUMPER_M` in contact."""
        x, y = self.state[X], self.state[Y]
        return float(min(x, y, self.config.room_m[0] - x, self.config.room_m[1] - y) - self.config.radius_m)

    def command(self, speed: float, turn_rate: float) -> None:
        """Send speed [m/s] and turn rate [rad/s] down the serial line; they arrive after its delay."""
        self._queue.append((self.time_s + self.config.serial_s, speed, turn_rate))

    def run(self, until_s: float) -> None:
        """Advance to a time [s]."""
        while self._queue and self._queue[0][0] <= until_s:
            at, speed, turn_rate = self._queue.pop(0)
            self._advance(max(at, self.time_s))
            self._command[:] = speed, turn_rate
        self._advance(until_s)

    def _advance(self, until_s: float) -> None:
        advance(
            self.state, self._command, until_s, self._constants, self._slip, self._noise, self.sonar_m,
            self.sonar_s, self.infrared_m,
        )  # fmt: skip
