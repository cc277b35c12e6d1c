"""A job of any scale in a closed loop: an axis with a lag and limits, moving ground, and a range sensor."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from surffollow import Follower

P_GAIN = 0.7


@dataclass(frozen=True)
class Job:
    """Stand-off and noise [m], τ, intervals of readings and poses [s], limits of the axis, window [m].

    `damping`: damping ratio of an axis of second order with the natural frequency 1/τ; 0: one with a lag τ.
    """

    standoff_m: float
    tau_s: float
    reading_s: float
    pose_s: float
    v_max_mps: float
    a_max_mps2: float
    sigma_m: float
    window_m: tuple[float, float]
    damping: float = 0.0


CELL = Job(0.1, 0.04, 0.004, 0.004, 0.5, 5.0, 0.25e-3, (0.03, 0.3))
BOOM = Job(0.7, 0.2, 0.05, 0.02, 1.0, 5.0, 0.01, (0.2, 2.0))


@dataclass(frozen=True)
class Run:
    """Clearance [m] and states of the follower per pose."""

    clearance_m: np.ndarray
    states: list[dict[str, Any]]

    def rms_m(self, job: Job) -> float:
        return float(np.sqrt(np.mean((self.clearance_m - job.standoff_m) ** 2)))


def follow(
    job: Job,
    ground_m: Callable[[float, float], float],
    seconds: float,
    speed_mps: float = 0.0,
    plain: bool = False,
    misread: Callable[[float, float, np.random.Generator], float] | None = None,
    seed: int = 1,
    latest_s: float = 0.0,
    live: tuple[float, dict[str, Any]] | None = None,
    drift: float = 0.0,
    place_m: Callable[[float], float] | None = None,
    height_noise_m: float = 0.0,
    place_noise_m: float = 0.0,
    older_s: float = 0.0,
    pose_older_s: float = 0.0,
    ahead_m: float = 0.0,
    height_sign: float = 1.0,
    above_m: float = 0.0,
    push_mps: Callable[[float], float] | None = None,
    takes_each_s: float = 0.0,
) -> Run:
    """Follow the ground h(x, t) with the default follower, or with a P loop on the newest reading.

    `misread(t, range, generator)` gives the reading in place of a range [m]. Each reading arrives up to
    `latest_s` after its time, at random; readings may overtake each other. The first tenth is left out.
    `live`: parameters that are set at a time [s]. `drift`: rate by which the sensor's clock is fast.
    `place_m`: place of the tool along its way at a time, in place of a constant speed.
    `height_noise_m`, `place_noise_m`: standard deviation of the height, of x and of y in a pose [m].
    `older_s`, `pose_older_s`: by which timestamps of readings and of poses are set back [s].
    `ahead_m`: distance of the sensor ahead of the tool [m].
    `height_sign`: −1: heights of poses are negated, and demands are applied to these. `above_m`: height above
    the stand-off at which the tool begins [m]. `push_mps`: velocity of wind, current or load at a time.
    `takes_each_s`: until then the axis takes the answer to each reading, and there are no steps without
    one; poses time out behind three intervals.
    """
    rng = np.random.default_rng(seed)
    plant = {"tau_s": job.tau_s, "v_max_mps": job.v_max_mps, "a_max_mps2": job.a_max_mps2}
    near_m, far_m = job.window_m
    sensors = [{"near_m": near_m, "far_m": far_m, "position_m": (ahead_m, 0.0, 0.0)}]
    config: dict[str, Any] = {"plant": plant, "sensors": sensors}
    if takes_each_s > 0.0:
        config["pose_timeout_ns"] = round(3e9 * job.pose_s)
    f = Follower(config, offset_m=job.standoff_m)
    z = z_plain = ground_m(0.0, 0.0) + job.standoff_m + above_m
    v, target, dt, clearance, states, coming = 0.0, z, 1e-3, [], [], []
    pose_ms, reading_ms = round(1e3 * job.pose_s), round(1e3 * job.reading_s)
    for ms in range(round(1e3 * seconds)):
        t = ms * dt
        x = speed_mps * t if place_m is None else place_m(t)
        t_ns = 10**9 + ms * 1_000_000
        ground = ground_m(x, t)
        if live is not None and ms == round(1e3 * live[0]):
            f.set_params(**live[1])
        if ms % pose_ms == 0:
            z_plain = z + (height_noise_m * float(rng.standard_normal()) if height_noise_m else 0.0)
            aside = place_noise_m * rng.standard_normal(2) if place_noise_m else (0.0, 0.0)
            pose = (x + aside[0], aside[1], height_sign * z_plain, 0.0, 0.0, 0.0, 1.0)
            f.pose(t_ns - round(1e9 * pose_older_s), pose)
        if ms % reading_ms == 0:
            seen = ground_m(x + ahead_m, t) if ahead_m else ground
            r = z - seen + job.sigma_m * float(rng.standard_normal())
            r = misread(t, r, rng) if misread else r
            r = r if near_m < r < far_m else math.nan
            stamp_ns = t_ns + round(drift * ms * 1_000_000) - round(1e9 * older_s)
            coming.append((ms + round(1e3 * latest_s * float(rng.random())) if latest_s else ms, stamp_ns, r))
        for arrival in [a for a in coming if a[0] <= ms]:
            coming.remove(arrival)
            demand = float(f.step(arrival[1], [arrival[2]])[2])
            if t < takes_each_s and not plain:
                target = z_plain + height_sign * demand
            if plain and math.isfinite(arrival[2]):
                target = z_plain - P_GAIN * (arrival[2] - job.standoff_m)
        if ms % pose_ms == 0:
            if t >= takes_each_s:
                demand = float(f.step(t_ns, [math.nan])[2])
                target = target if plain else z_plain + height_sign * demand
            if ms > 100 * seconds:
                clearance.append(z - ground)
                states.append(f.state())
        wanted = (target - z) / job.tau_s
        if job.damping > 0.0:
            wanted = v + (wanted - 2.0 * job.damping * v) * dt / job.tau_s
        wanted = min(max(wanted, -job.v_max_mps), job.v_max_mps)
        v += min(max(wanted - v, -job.a_max_mps2 * dt), job.a_max_mps2 * dt)
        z += (v + (push_mps(t) if push_mps else 0.0)) * dt
    return Run(np.array(clearance), states)
