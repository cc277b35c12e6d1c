"""The blocks of a simulated base: what its clients see, and its true motion for the log."""

from __future__ import annotations

import numpy as np

from surffollow.apps.wall_sensing import Sensing
from surffollow.blocks import F64, I64, AttachedBlock, Block
from surffollow.sim.base import (
    HEADING,
    N_INFRARED,
    ODOMETRY_HEADING,
    ODOMETRY_SPEED,
    ODOMETRY_TURN_RATE,
    ODOMETRY_X,
    ODOMETRY_Y,
    SPEED,
    TURN_RATE,
    SimulatedBase,
    X,
    Y,
)

MAX_SONARS = 64


class Base(Block):
    """Sensors and odometry of a base."""

    t_ns = I64(unit="ns", doc="CLOCK_MONOTONIC")
    t_s = F64(unit="s", doc="of the simulation")
    odometry = F64(3, unit="m, rad", doc="x y heading")
    speed = F64(unit="m/s")
    turn_rate = F64(unit="rad/s")
    n_sonars = I64()
    sonar_m = F64(MAX_SONARS, unit="m", doc="inf: no echo, NaN: none yet")
    sonar_s = F64(MAX_SONARS, unit="s", doc="when each was fired")
    infrared_m = F64(N_INFRARED, unit="m", doc="inf: nothing near")


class TrueBase(Block):
    """True motion of a simulated base: for logs, not for clients."""

    t_s = F64(unit="s")
    pose = F64(3, unit="m, rad", doc="x y heading")
    speed = F64(unit="m/s")
    turn_rate = F64(unit="rad/s")
    gap_m = F64(unit="m", doc="rim to the nearest wall; negative: contact")


def publish(base: SimulatedBase, seen: AttachedBlock, true: AttachedBlock, t_ns: int) -> None:
    """Write both blocks from the base's state.

    Parameters
    ----------
    base : SimulatedBase
    seen, true : AttachedBlock  what sensors show, and what is so
    t_ns : int [ns]
    """
    s, n = base.state, len(base.sonar_m)
    with seen.write() as slot:
        slot.t_ns, slot.t_s, slot.n_sonars = t_ns, base.time_s, n
        slot.odometry = [float(s[k]) for k in (ODOMETRY_X, ODOMETRY_Y, ODOMETRY_HEADING)]
        slot.speed, slot.turn_rate = float(s[ODOMETRY_SPEED]), float(s[ODOMETRY_TURN_RATE])
        slot.array("sonar_m")[:n], slot.array("sonar_s")[:n] = base.sonar_m, base.sonar_s
        slot.array("infrared_m")[:] = base.infrared_m
    with true.write() as slot:
        slot.t_s, slot.pose = base.time_s, [float(s[k]) for k in (X, Y, HEADING)]
        slot.speed, slot.turn_rate, slot.gap_m = float(s[SPEED]), float(s[TURN_RATE]), base.wall_gap_m


def sensing_of(block: AttachedBlock) -> tuple[Sensing, int] | None:
    """The newest sensing of a base and its timestamp [ns]; None before the first."""
    now = block.latest()
    if now.generation == 0 or now["t_ns"] == 0:
        return None
    n = int(now["n_sonars"])
    x, y, heading = now["odometry"]
    seen = Sensing(
        now["t_s"],
        (x, y, heading),
        now["speed"],
        now["turn_rate"],
        np.array(now["sonar_m"][:n]),
        np.array(now["sonar_s"][:n]),
        np.array(now["infrared_m"]),
    )
    return seen, int(now["t_ns"])
