"""Heading of a base along a wall, with and without follow-wall-2, still and moving.

Sonar noise grows with motion, so corrections of the heading may scatter it more than they mend it (Dekhil and
Henderson, section 3).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from surffollow.apps.wall_clients import Go
from surffollow.apps.wall_following import TICK_S, Arbitration, ring_of, tick
from surffollow.apps.wall_sensing import CRUISE_MPS, BaseClient
from surffollow.apps.wall_side import FollowWall2
from surffollow.sim.base import HEADING, BaseConfig, SimulatedBase

BESIDE_M = 0.7  # of the base's centre from the wall on its right
START_STD_RAD = math.radians(2.0)  # of the heading at the start
BURN_IN_S, LASTS_S = 6.0, 18.0  # corrections come once a second


def heading_along_wall(seed: int, *, moving: bool, corrected: bool) -> dict[str, float]:
    """Let a base stand beside a wall, or drive along it, and look at its true heading.

    Parameters
    ----------
    seed : int         of noise, slip and the start's heading
    moving : bool      `go` drives it
    corrected : bool   `follow-wall-2` corrects it; on the spot while it stands

    Returns
    -------
    dict
        variance_rad2: of the heading about its mean, after the burn-in;
        error_rad: mean heading less the wall's
    """
    rng = np.random.default_rng([seed, 11])
    config = BaseConfig()
    start = (0.8, BESIDE_M, START_STD_RAD * float(rng.standard_normal()))
    base = SimulatedBase(replace(config, start=start), seed)
    clients: list[BaseClient] = []
    if corrected:
        clients.append(FollowWall2(ring_of(config), cruise_mps=CRUISE_MPS if moving else 0.0))
    if moving:
        clients.append(Go())
    arbitration = Arbitration([c.name for c in clients])
    headings = []
    base.run(0.15)  # one round of the ring
    while base.time_s < LASTS_S:
        tick(base, clients, arbitration)
        base.run(base.time_s + TICK_S)
        if base.time_s > BURN_IN_S:
            headings.append(float(base.state[HEADING]))
    return {"variance_rad2": float(np.var(headings)), "error_rad": float(np.mean(headings))}


def heading_table(seeds: range) -> dict[str, dict[str, float]]:
    """The four cases over many seeds.

    Returns
    -------
    dict of dict
        By "still", "still, corrected", "moving", "moving, corrected": the mean of `variance_rad2`, and
        `error_rms_rad`, the RMS of `error_rad`
    """
    table = {}
    for moving in (False, True):
        for corrected in (False, True):
            runs = [heading_along_wall(s, moving=moving, corrected=corrected) for s in seeds]
            case = ("moving" if moving else "still") + (", corrected" if corrected else "")
            table[case] = {
                "variance_rad2": float(np.mean([r["variance_rad2"] for r in runs])),
                "error_rms_rad": float(np.sqrt(np.mean([r["error_rad"] ** 2 for r in runs]))),
            }
    return table
