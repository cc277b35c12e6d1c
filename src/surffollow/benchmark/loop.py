"""The simulated world of one run: 1 ms steps from event to event, in one resumable kernel.

`advance` stops whenever a pose or a reading arrives at the follower and whenever the controller needs
a demand. Jitted baselines and Python followers are driven by the same kernel, so they meet the same world.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surffollow.shm.jit import jit
from surffollow.sim.plant import axis_step, setpoint_for
from surffollow.sim.profiles import profile_height

MS_NS = 1_000_000
STEP_S = 1e-3

END, POSE, SAMPLE, TICK = 0, 1, 2, 3  # events
_ARRIVE, _POSES, _SAMPLES, _TICK, _DEMAND, _MOVE = 0, 1, 2, 3, 4, 5  # where in a millisecond the run stands

RUN = np.dtype(
    [
        (name, np.int64)
        for name in ("ms", "phase", "end_ms", "tick_ms", "newest", "poses_made", "samples_made")
        + ("poses", "samples", "ticks", "bad_demands")
    ]
    + [
        (name, np.float64)
        for name in ("speed_mps", "start_m", "lead_m", "profile_x0_m", "profile_dx_m")
        + ("tau_s", "v_max_mps", "a_max_mps2", "near_m", "far_m", "quantum_m", "standoff_m")
        + ("setpoint_m", "demand_m")
    ]
    + [("axis", np.float64, (2,))]
)
"""State of a run; `poses` and `samples` count what has arrived, `…_made` what exists."""

REPORT = np.dtype(
    [("ms", np.int64), ("arrival_ms", np.int64)] + [(n, np.float64) for n in ("noise_x", "noise_z", "x", "z")]
)
"""A pose report: timestamp and arrival [ms], noise [m], and what is reported [m]."""

READING = np.dtype(
    [("ms", np.int64), ("arrival_ms", np.int64), ("noise", np.float64), ("range", np.float64)]
    + [(n, np.float64) for n in ("early_ms", "timestamp_ms")]
)
"""A reading: when it is made and arrives [ms], noise [m] (NaN: lost), range [m] or NaN.

It is true `early_ms` (below 1) before `ms`, so a sensor may be faster than the steps of the simulation.
`timestamp_ms` is the timestamp that a method gets.
"""

ORDER = np.dtype([("setpoint", np.float64), ("demand", np.float64)])
"""Record of the controller at one period: demand as given and the setpoint made of it [m]."""


class World(NamedTuple):
    """Arrays of a run: profile heights, `REPORT`s, `READING`s, `ORDER`s and z (ms,) of the tool [m]."""

    heights: NDArray[Any]
    reports: NDArray[Any]
    readings: NDArray[Any]
    orders: NDArray[Any]
    z: NDArray[Any]


@jit
def read_range(s: Any, range_m: float, noise_m: float) -> float:
    """Range as the sensor gives it: noise, window, A/D steps; NaN when there is no reading."""
    r = range_m + noise_m
    if not (s.near_m <= r <= s.far_m):
        return math.nan
    return float(s.near_m + s.quantum_m * math.floor((r - s.near_m) / s.quantum_m + 0.5))


@jit
def _make_reports(
    s: Any, heights: NDArray[Any], reports: NDArray[Any], readings: NDArray[Any], z: NDArray[Any]
) -> None:
    """Write the pose report and the readings of this millisecond, if any."""
    x = s.start_m + s.speed_mps * s.ms * STEP_S
    i = s.poses_made
    while i < reports.shape[0] and reports[i].ms <= s.ms:
        reports[i].x = x + reports[i].noise_x
        reports[i].z = s.axis[0] + reports[i].noise_z
        i += 1
    s.poses_made = i
    i = s.samples_made
    while i < readings.shape[0] and readings[i].ms <= s.ms:
        at_x, at_z = x, s.axis[0]
        early_ms = readings[i].early_ms
        if early_ms > 0.0:
            at_x -= s.speed_mps * early_ms * STEP_S
            at_z += early_ms * (z[s.ms - 1] - at_z)
        ground = profile_height(heights, s.profile_x0_m, s.profile_dx_m, at_x + s.lead_m)
        readings[i].range = read_range(s, at_z - ground, readings[i].noise)
        i += 1
    s.samples_made = i


@jit
def _move(s: Any, reports: NDArray[Any], readings: NDArray[Any], z: NDArray[Any]) -> None:
    """Step the axis to the next millisecond in which anything but motion happens."""
    until = min(s.end_ms, (s.ms // s.tick_ms + 1) * s.tick_ms)
    if s.poses_made < reports.shape[0]:
        until = min(until, reports[s.poses_made].ms)
    if s.poses < s.poses_made:
        until = min(until, reports[s.poses].arrival_ms)
    if s.samples_made < readings.shape[0]:
        until = min(until, readings[s.samples_made].ms)
    if s.samples < s.samples_made:
        until = min(until, readings[s.samples].arrival_ms)
    axis = s.axis
    ms = s.ms
    target, tau_s, v_max, a_max = s.setpoint_m, s.tau_s, s.v_max_mps, s.a_max_mps2
    while ms < until:
        ms += 1
        axis_step(axis, target, tau_s, v_max, a_max, STEP_S)
        if ms < s.end_ms:
            z[ms] = axis[0]
    s.ms = ms


@jit
def _apply_demand(s: Any, reports: NDArray[Any], orders: NDArray[Any]) -> None:
    """Let the controller add the demand to the report that it refers to."""
    if not math.isfinite(s.demand_m):
        s.bad_demands += 1
    report = s.poses_made if s.newest else s.poses
    if report > 0:
        s.setpoint_m = setpoint_for(reports[report - 1].z, s.demand_m)
    orders[s.ticks].setpoint = s.setpoint_m
    orders[s.ticks].demand = s.demand_m
    s.ticks += 1


@jit
def advance(s: Any, w: World) -> int:
    """Run the world until something concerns the follower.

    Parameters
    ----------
    s : one record of dtype `RUN`, updated in place; on `TICK` the caller puts the demand into `demand_m`
    w : World

    Returns
    -------
    int64 event
        `POSE` (report `poses` − 1 arrived), `SAMPLE` (reading `samples` − 1 arrived), `TICK` or `END`
    """
    while True:
        if s.phase == _MOVE:
            _move(s, w.reports, w.readings, w.z)
            s.phase = _ARRIVE
        if s.phase == _ARRIVE:
            if s.ms >= s.end_ms:
                return END
            _make_reports(s, w.heights, w.reports, w.readings, w.z)
            s.phase = _POSES
        if s.phase == _POSES:
            if s.poses < s.poses_made and w.reports[s.poses].arrival_ms <= s.ms:
                s.poses += 1
                return POSE
            s.phase = _SAMPLES
        if s.phase == _SAMPLES:
            if s.samples < s.samples_made and w.readings[s.samples].arrival_ms <= s.ms:
                s.samples += 1
                return SAMPLE
            s.phase = _TICK
        if s.phase == _TICK and s.ms % s.tick_ms == 0:
            s.phase = _DEMAND
            return TICK
        if s.phase == _DEMAND:
            _apply_demand(s, w.reports, w.orders)
        s.phase = _MOVE


@jit
def advance_to_tick(run: NDArray[Any], w: World) -> int:
    """Run to the next `TICK` or to the `END`, past arrivals: `poses` and `samples` say what came meanwhile.

    Input of a follower between controller periods has no effect before the next one, so it is given then.
    `run` is (1,) of `RUN`.
    """
    while True:
        event: int = advance(run[0], w)
        if event in (TICK, END):
            return event
