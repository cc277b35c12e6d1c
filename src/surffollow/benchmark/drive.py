"""Drive a follower through its one interface: poses and readings as they arrive, a demand per period."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surffollow.benchmark.followers import FollowerLike
from surffollow.benchmark.loop import END, MS_NS, STEP_S, World, advance_to_tick
from surffollow.benchmark.scene import START_NS, Scene

RETURN_SPEED_MPS = 0.5  # between two passes the tool travels back, lifted, at this speed
RETURN_LIFT_M = 0.05
PAUSE_MS = 200


def drive(follower: FollowerLike, s: Any, w: World, start_ns: int = START_NS) -> None:
    """Run a follower to the end of the path.

    Each pose report and each reading is handed over when it arrives, with its timestamp;
    in each controller period `step` is called with the time and no reading, and its answer is the demand.

    Parameters
    ----------
    follower : see `FollowerLike`
    s, w : a fresh run
    start_ns : the run's first moment in the follower's time
    """
    nothing = np.array([math.nan])
    step, pose = follower.step, follower.pose
    reports, readings = w.reports, w.readings
    run = s.base  # the array whose record this is: numba takes it sooner
    now_ms, poses_sent, samples_sent, demand_m = (
        run["ms"],
        run["poses"],
        run["samples"],
        run["demand_m"],
    )
    pose_ns = (start_ns + reports["ms"] * MS_NS).tolist()
    sample_ns = (start_ns + np.round(readings["timestamp_ms"] * MS_NS).astype(np.int64)).tolist()
    ranges, x, z = readings["range"], reports["x"], reports["z"]
    # everything in the order of its arrival, poses before readings of the same millisecond
    arrivals = np.concatenate([2 * reports["arrival_ms"], 2 * readings["arrival_ms"] + 1])
    order = np.argsort(arrivals, kind="stable").tolist()
    delivered, poses = 0, len(reports)
    while True:
        event = advance_to_tick(run, w)
        arrived = int(poses_sent[0] + samples_sent[0])
        for k in order[delivered:arrived]:
            if k < poses:
                pose(pose_ns[k], np.array([x[k], 0.0, z[k], 0.0, 0.0, 0.0, 1.0]))
            else:
                i = k - poses
                step(sample_ns[i], ranges[i : i + 1].copy())
        delivered = arrived
        if event == END:
            return
        demand_m[0] = step(start_ns + int(now_ms[0]) * MS_NS, nothing)[2]


def travel_back(follower: FollowerLike, scene: Scene, z_m: float, start_ns: int) -> int:
    """Carry the lifted tool back to the start of the path: poses go on, readings do not.

    Parameters
    ----------
    follower, scene : who is carried along which path
    z_m : height of the tool at the end of the pass [m]
    start_ns : when the journey begins

    Returns
    -------
    int64 when the next pass may begin [ns]
    """
    p = scene.profile
    begin_z = float(scene.world.z[0])
    duration_ms = int(p.length_m / RETURN_SPEED_MPS * 1e3)
    nothing = np.array([math.nan])
    for ms in range(0, duration_ms + PAUSE_MS, 10):
        f = min(1.0, ms / duration_ms)
        x = p.start_m + p.length_m * (1.0 - f)
        lift = RETURN_LIFT_M * min(1.0, 10.0 * f, 10.0 * (1.0 - f))
        z = z_m + f * (begin_z - z_m) + lift
        follower.pose(start_ns + ms * MS_NS, np.array([x, 0.0, z, 0.0, 0.0, 0.0, 1.0]))
        follower.step(start_ns + ms * MS_NS, nothing)
    return start_ns + (duration_ms + PAUSE_MS) * MS_NS


def two_passes(
    follower: FollowerLike, first: Scene, second: Scene
) -> tuple[tuple[Any, World], tuple[Any, World]]:
    """Let one follower go over the same ground twice, with other noise the second time.

    Returns
    -------
    the run (record and world) of either pass
    """
    run_1, world_1 = first.fresh()
    drive(follower, run_1, world_1)
    end_ns = START_NS + round(len(world_1.z) * STEP_S * 1e9)
    begin_ns = travel_back(follower, first, float(world_1.z[-1]), end_ns)
    run_2, world_2 = second.fresh()
    drive(follower, run_2, world_2, begin_ns)
    return (run_1, world_1), (run_2, world_2)
