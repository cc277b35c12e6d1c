"""A tool on an axis over ground, and a sensor that may read something else."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from surffollow import Follower
from surffollow.benchmark.hazard_scenarios import FAR_M, NEAR_M, SIGMA_M, STANDOFF_M

MS = 1_000_000
TAU_MS = 40.0


def standard() -> Follower:
    return Follower({"sensors": [{"near_m": NEAR_M, "far_m": FAR_M}]}, offset_m=STANDOFF_M)


def closed_loop(
    ground, read, seconds=4.0, seed=0, speed=0.2, led=None, run="normal", follower=None, late_ms=0
):
    """Heights above the ground [m], phases of the test and states every 10 ms of a tool on an axis.

    A reading arrives `late_ms` after its time. `led`: height of the tool at a place [m]; another controller
    leads it.
    """
    f, rng, z = follower or standard(), np.random.default_rng(seed), ground(0.0) + STANDOFF_M
    f.set_params(run=run)
    target, heights, phases, states, readings = z, [], [], [], deque()
    for ms in range(int(1e3 * seconds)):
        x = speed * ms * 1e-3
        if ms % 10 == 0:
            f.pose(ms * MS, (x, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        if ms % 4 == 0:
            readings.append((ms, read(ms * 1e-3, z - ground(x), rng)))
        if readings and readings[0][0] + late_ms <= ms:
            at, reading = readings.popleft()
            f.step(at * MS, [reading])
        if ms % 10 == 0:
            target = z + f.step(ms * MS, [math.nan])[2]
            heights.append(z - ground(x))
            phases.append(int(f._state["adaptive"][0]["response"]["phase"]))
            states.append(f.state())
        z = z + (target - z) / TAU_MS if led is None else led(x)
    return np.array(heights), phases, states


def noisy(_, r, rng):
    return r + SIGMA_M * rng.standard_normal()
