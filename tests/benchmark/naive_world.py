"""The benchmark's world, said slowly: plain Python, one millisecond after the other."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surffollow.benchmark.conditions import STANDOFF_M, Conditions


def naive_run(scene: Any, conditions: Conditions, gain: float) -> np.ndarray:
    """Height of the tool at every millisecond under `D = −gain·(range − stand-off)`."""
    c, w, v = conditions, scene.world, scene.speed_mps
    profile = scene.profile
    z, speed, target = float(w.z[0]), 0.0, float(w.z[0])
    reported: dict[int, float] = {}
    read: dict[int, float] = {}
    newest_report, newest_reading, newest_stamp = None, None, None
    heights = []
    reports, readings = w.reports.tolist(), w.readings.tolist()  # (stamp, arrival, noise…)
    for ms in range(len(w.z)):
        if ms:
            desired = naive_velocity(target - z, c)
            speed += max(-c.plant.a_max_mps2 * 1e-3, min(c.plant.a_max_mps2 * 1e-3, desired - speed))
            z += speed * 1e-3
        heights.append(z)
        x = profile.start_m + v * ms * 1e-3
        for stamp, arrival, _, noise_z, *_ in reports:
            if stamp == ms:
                reported[arrival] = z + noise_z
        for stamp, arrival, noise, *_ in readings:
            if stamp == ms:
                ground = float(profile.height_m(np.array([x + c.lead_m]))[0])
                r = z - ground + noise
                step = (c.sensor.far_m - c.sensor.near_m) / 2**c.sensor.bits
                inside = c.sensor.near_m <= r <= c.sensor.far_m
                steps = math.floor((r - c.sensor.near_m) / step + 0.5) if inside else 0
                read[arrival] = c.sensor.near_m + step * steps if inside else math.nan
                delay = arrival - stamp
        newest_report = reported.get(ms, newest_report)
        if not math.isnan(read.get(ms, math.nan)):
            newest_reading, newest_stamp = read[ms], ms - delay
        if ms % 10 == 0 and newest_report is not None:
            demand = 0.0
            if newest_reading is not None and ms - newest_stamp <= 100 + 1e3 * c.sensor.latency_s:
                demand = -gain * (newest_reading - STANDOFF_M)
            target = newest_report + demand
    return np.array(heights)


def naive_velocity(e: float, c: Conditions) -> float:
    """Sqrt controller with the axis's speed limit."""
    p, a = 1.0 / c.plant.tau_s, c.plant.a_max_mps2
    v = p * e if abs(e) <= a / p**2 else math.copysign(math.sqrt(2 * a * (abs(e) - a / (2 * p**2))), e)
    for limit in (abs(e) / 1e-3, c.plant.v_max_mps):
        v = max(-limit, min(limit, v))
    return v


class PythonP:
    """The `p` baseline, written against the benchmark's public interface."""

    def __init__(self, conditions: Conditions, gain: float = 0.5) -> None:
        self.gain, self.error, self.stamp = gain, math.nan, 0
        self.timeout_ns = 100_000_000 + round(conditions.sensor.latency_s * 1e9)
        self.calls: list[tuple[str, int, float]] = []

    def pose(self, t_ns: int, pose: Any) -> None:
        """Note the call."""
        self.calls.append(("pose", t_ns, float(pose[0])))

    def step(self, t_ns: int, ranges_m: Any) -> list[float]:
        """Proportional demand on the newest reading."""
        r = float(ranges_m[0])
        self.calls.append(("step", t_ns, r))
        if not math.isnan(r):
            self.error, self.stamp = r - STANDOFF_M, t_ns
        known = not math.isnan(self.error) and t_ns - self.stamp <= self.timeout_ns
        return [0.0, 0.0, -self.gain * self.error if known else 0.0, 0.0, 0.0, 0.0]


def make_python_p(conditions: Conditions) -> PythonP:
    """Factory for `--methods`."""
    return PythonP(conditions)
