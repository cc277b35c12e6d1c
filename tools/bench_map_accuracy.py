"""Accuracy of the map made by the service's own kernels under the simulated sensor with its default noise.

A tool scans a ground in lanes and follows it (its axis heeds the demands); conversions, follower and map
are those of the live service, stepped at 1 kHz of simulated time. Truth of a grid is the mean height of
the ground within it. Grounds: the FY91 field over 2 m², and measured surfaces scaled to the same 2 m²
and to its 30 mm peak to peak. `--quick`: a fifth of the lanes.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from map_scans import area_means, measured_surfaces
from report import criterion, finish, result
from surffollow.config.params import PARAMS
from surffollow.forecast.step import follow_step, sf_reset
from surffollow.hw.driver import ConversionQueue
from surffollow.hw.simulation.led_config import physics
from surffollow.hw.simulation.pose_history import PoseHistory, add_pose
from surffollow.hw.simulation.sensor_rig import SimulatedConfig, make_rig, produce
from surffollow.hw.simulation.simulated import SimulatedDriver
from surffollow.map import HeightMap
from surffollow.map.kernels.grids import update_map
from surffollow.shm import atomics as at
from surffollow.shm.conversion import ITEM_WORDS
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_follow import FollowState, Inputs, Output, Params
from surffollow.shm.ring import ITEMS, ring_drop, ring_length
from surffollow.sim.plant import axis_step
from surffollow.sim.surface_fy91 import fy91_field
from surffollow.sim.surfaces import HeightField, field_height

REGION = (0.0, 0.0, 2.0, 1.0)
GRID_M, SPEED_MPS, STANDOFF_M = 2.54e-3, 0.05, 0.1
TAU_S, V_MAX_MPS, A_MAX_MPS2 = 0.05, 0.2, 4.0
LANE_M = 10e-3
STEP_NS = 1_000_000
PEAK_TO_PEAK_M = 0.03
LIMIT_M = 1e-3


@njit(nogil=True)  # not kept: numba would not see a change of the package's kernels
def scan_lane(
    follower: Any,
    rig: Any,
    led: Any,
    history: Any,
    field: Any,
    frame: Any,
    tool: Any,
    axis: Any,
    the_map: Any,
) -> Any:
    """Drive one lane: `tool` is y, x from, x to, time [ns]; returns the target points mapped."""
    params, state, inputs, output, scratch = follower
    header, pairs = the_map
    y, x0, x1 = tool[0], tool[1], tool[2]
    ring, capacity = rig[0].ring, rig[0].capacity
    pose, velocity = np.zeros(7), np.zeros(6)
    pose[6] = 1.0
    ahead = 1.0 if x1 > x0 else -1.0
    velocity[0] = ahead * SPEED_MPS
    t0, x, mapped = np.int64(tool[3]), x0, 0
    axis[0], axis[1] = field_height(field, frame[0], frame[1], frame[2], x0, y) + STANDOFF_M, 0.0
    target = axis[0]
    i = inputs[0]
    for k in range(np.int64(abs(x1 - x0) / SPEED_MPS * 1e9 / STEP_NS)):
        t = t0 + k * STEP_NS
        x = x0 + ahead * SPEED_MPS * k * STEP_NS * 1e-9
        axis_step(axis, target, TAU_S, V_MAX_MPS, A_MAX_MPS2, STEP_NS * 1e-9)
        pose[0], pose[1], pose[2] = x, y, axis[0]
        velocity[2] = axis[1]
        add_pose(history, t, pose, velocity)
        produce(rig, led, history, field, frame, t)
        waiting = ring_length(ring)
        tail = at.load_relaxed_i64(ring + 64)
        for n in range(waiting):
            slot = ring + ITEMS + ((tail + n) & (capacity - 1)) * ITEM_WORDS * 8
            word = at.load_relaxed_i64(slot + 8) & 0xFFFFFFFF
            i.conversion[n] = ((at.load_relaxed_i64(slot) - t) << 32) | word
        ring_drop(ring, waiting)
        i.n_conversions, i.t_ns, i.n_poses, i.pose_t_ns[0] = waiting, t, 1, t
        for n in range(7):
            i.pose[n] = pose[n]
        follow_step(params, state, inputs, output, scratch)
        o = output[0]
        target = axis[0] + o.demand[2]
        if o.fresh & 1:
            update_map(header, pairs, o.target_m[0], o.target_m[1], o.target_m[2])
            mapped += 1
    return mapped


def parameters(info: Any, **given: float) -> NDArray[Any]:
    """The service's default parameters with a driver's calibration."""
    params = zeros(Params)
    p = params[0]
    for name, spec in PARAMS.items():
        p[name] = spec.default
    p["n_channels"], p["scale_m"], p["zero_m"] = info.n_channels, info.scale_m, info.zero_m
    p["range_min_m"], p["range_max_m"] = info.range_min_m, info.range_max_m
    p["sensor_latency_ns"] = info.latency_ns
    p["tool_from_sensor"] = np.array(info.mounts, np.float64).reshape(-1)
    p["offset_m"] = STANDOFF_M
    for name, value in given.items():
        p[name] = value
    return params


def scan(field: HeightField, lane_m: float, **given: float) -> HeightMap:
    """Map a ground in lanes along x, there and back."""
    config = SimulatedConfig()
    params = parameters(SimulatedDriver("bench", config, field).info, **given)
    state = zeros(FollowState)
    sf_reset(params, state, STANDOFF_M)
    follower = (params, state, zeros(Inputs), zeros(Output), np.zeros(7))
    queue = ConversionQueue(1 << 12)
    rig, led, history = make_rig(config, queue, 10**9), physics(config.led, config.seed), zeros(PoseHistory)
    made = HeightMap.over(REGION, grids=400_000, finest_m=GRID_M)
    frame = np.array([field.x0_m, field.y0_m, field.grid_m])
    axis, t_ns = np.zeros(2), 10**9
    x0, y0, x1, y1 = REGION
    lane_ns = int((x1 - x0) / SPEED_MPS * 1e9)
    for n, y in enumerate(np.arange(y0 + lane_m / 2, y1, lane_m)):
        ends = (x0, x1) if n % 2 == 0 else (x1, x0)
        tool = np.array([y, *ends, float(t_ns)])
        scan_lane(follower, rig, led, history, field.heights_m, frame, tool, axis, (made.header, made.pairs))
        t_ns += lane_ns + 10**9
        rig["next_number"] = t_ns // 40_000
    return made


def scaled(z: NDArray[np.float64]) -> HeightField:
    """A measured surface stretched over the region, 30 mm peak to peak."""
    z = (z - z.min()) / np.ptp(z) * PEAK_TO_PEAK_M
    grid = 2e-3
    y = np.linspace(0, z.shape[0] - 1, round((REGION[3] - REGION[1]) / grid) + 1)
    x = np.linspace(0, z.shape[1] - 1, round((REGION[2] - REGION[0]) / grid) + 1)
    fine = map_coordinates(z, np.meshgrid(y, x, indexing="ij"), order=1)
    return HeightField(np.ascontiguousarray(fine), REGION[0], REGION[1], grid)


def grounds() -> dict[str, HeightField]:
    """All grounds; the measured ones only where the data is."""
    measured = {f"measured: {name}": scaled(z) for name, z in measured_surfaces().items()}
    return {"FY91 field": fy91_field(91, REGION, 1e-3), **measured}


def main() -> dict[str, Any]:
    """Scan all grounds, hold their errors against the criterion."""
    lane_m = LANE_M * (5 if "--quick" in sys.argv[1:] else 1)
    criteria, notes = [], []
    for name, field in grounds().items():
        for setting, given in (("default", {}), ("pose_interpolate = 1", {"pose_interpolate": 1.0})):
            made = scan(field, lane_m, **given)
            truth = area_means(field.heights_m, field.grid_m, made, field.x0_m, field.y0_m)
            error = made.heights_m - truth
            known = np.isfinite(error)
            error = error[known]
            mae = float(np.mean(np.abs(error))) if error.size else float("nan")
            criteria.append(criterion(f"{name}, {setting}: MAE", mae * 1e3, LIMIT_M * 1e3, "mm"))
            p = np.percentile(np.abs(error), (50, 95, 99)) * 1e3
            notes.append(
                f"{name}, {setting}: {error.size} of {known.size} grids, {made.samples} samples, bias "
                f"{error.mean() * 1e3:+.3f} mm, rms {error.std() * 1e3:.3f}, p50/95/99 "
                f"{p[0]:.3f}/{p[1]:.3f}/{p[2]:.3f} mm, clipped {made.clipped}"
            )
    what = f"map accuracy, lanes of {lane_m * 1e3:g} mm at {SPEED_MPS:g} m/s, {GRID_M * 1e3:g} mm grids"
    return result(what, criteria, notes)


if __name__ == "__main__":
    sys.exit(finish(main()))
