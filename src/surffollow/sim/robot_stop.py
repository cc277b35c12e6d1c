"""Behaviour of a robot without a valid demand, and its time to rest (docs/reference/protocol.md, "Stop")."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from surffollow.sim.step_clock import STEP_NS

if TYPE_CHECKING:
    from surffollow.sim.robot_config import RobotConfig

REST_MPS = 1e-3  # slower is rest: speed that the noise of reports gives to a held height
SETTLING = 6.0  # time constants of the vertical axis until what is left of its speed is no motion


def time_to_rest_s(config: RobotConfig) -> float:
    """Time from the period in which the demand is missed until the tool is at rest, or retracts [s].

    The controller reacts in its next period. Then the speed along the path falls with `accel_mps2`, while the
    vertical axis brakes with its own limit and settles with its time constant on the held height.

    Parameters
    ----------
    config : RobotConfig
    """
    tick_s, plant = 1.0 / config.plant.tick_hz, config.plant
    along_s = config.speed_mps / config.accel_mps2
    brake_s = plant.v_max_mps / plant.a_max_mps2
    return tick_s + STEP_NS * 1e-9 + max(along_s, brake_s + SETTLING * plant.tau_s)


def stopping_distance_m(config: RobotConfig, reaction_s: float) -> float:
    """Way along the path from the last valid demand to rest [m].

    Parameters
    ----------
    config : RobotConfig
    reaction_s : until the controller begins to brake: age limit of the demand and one period [s]
    """
    v = config.speed_mps
    return v * reaction_s + v * v / (2.0 * config.accel_mps2)


def clearance_m(config: RobotConfig, reaction_s: float, steepest_rad: float) -> float:
    """Least stand-off with which a held height clears ground that rises all the way to rest [m].

    Where it is more than the stand-off, the robot has to retract (`RobotConfig.retract_m`).

    Parameters
    ----------
    config : RobotConfig
    reaction_s : see `stopping_distance_m` [s]
    steepest_rad : steepest rise of the ground along the path [rad]
    """
    return stopping_distance_m(config, reaction_s) * math.tan(steepest_rad)
