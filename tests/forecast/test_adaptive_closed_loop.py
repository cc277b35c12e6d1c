"""Closed loops that lost the tool once: steep ground under slow sensors, jumps of z, ranges far too great."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from surffollow import Follower
from surffollow.sim.plant import axis_step

MS = 1_000_000
P_GAIN = 0.7


@dataclass(frozen=True)
class Job:
    """A tool over ground that rises by `slope` from `flat_m` on; SI units."""

    standoff_m: float = 0.1
    window_m: tuple[float, float] = (0.0508, 0.1524)
    tau_s: float = 0.04
    v_max_mps: float = 0.2
    a_max_mps2: float = 2.0
    sensor_hz: float = 250.0
    sigma_m: float = 0.25e-3
    speed_mps: float = 0.1
    slope: float = 0.0
    flat_m: float = 0.0
    seconds: float = 5.0

    def follower(self) -> Follower:
        near, far = self.window_m
        plant = {"tau_s": self.tau_s, "v_max_mps": self.v_max_mps, "a_max_mps2": self.a_max_mps2}
        return Follower(
            {"sensors": [{"near_m": near, "far_m": far}], "plant": plant}, offset_m=self.standoff_m
        )

    def ground_m(self, t_s: float) -> float:
        return self.slope * max(self.speed_mps * t_s - self.flat_m, 0.0)

    def clearances_m(self, follower=None, seed=0, misread=None, frame_z_m=None) -> np.ndarray:
        """Clearance in every millisecond; a plain P loop drives without a follower."""
        rng = np.random.default_rng(seed)
        axis = np.array([self.ground_m(0.0) + self.standoff_m, 0.0])
        target, error, out = axis[0], 0.0, []
        for ms in range(int(1e3 * self.seconds)):
            t, now = 1e-3 * ms, (1000 + ms) * MS
            clearance = axis[0] - self.ground_m(t)
            out.append(clearance)
            off = frame_z_m(t) if frame_z_m else 0.0
            if ms % 10 == 0 and follower:
                follower.pose(now, (self.speed_mps * t, 0.0, axis[0] + off, 0.0, 0.0, 0.0, 1.0))
            if ms % int(1e3 / self.sensor_hz) == 0:
                read = clearance + self.sigma_m * rng.standard_normal()
                read = misread(t, read, rng) if misread else read
                if follower:
                    follower.step(now, [read])
                elif self.window_m[0] < read < self.window_m[1]:
                    error = read - self.standoff_m
            if ms % 10 == 0:
                demand = follower.step(now, [math.nan])[2] if follower else -P_GAIN * error
                target = axis[0] + demand
            axis_step(axis, target, self.tau_s, self.v_max_mps, self.a_max_mps2, 1e-3)
        return np.array(out)


CELL = Job()
SLOPES = {
    "10 Hz, slope 0.25": Job(sensor_hz=10, speed_mps=0.2, slope=0.25, flat_m=0.4),
    "10 Hz, slope 0.6": Job(sensor_hz=10, slope=0.6, flat_m=0.2),
    "5 Hz, slope 0.4": Job(sensor_hz=5, slope=0.4, flat_m=0.2),
    "20 Hz, slope 0.4, from the start on": Job(sensor_hz=20, speed_mps=0.2, slope=0.4),
    "torch, 100 Hz, slope 0.5, from the start on": Job(
        0.004, (0.0005, 0.012), sensor_hz=100, sigma_m=1e-5, speed_mps=0.05, slope=0.5
    ),
    "drone, slope 0.3, from the start on": Job(
        2.0, (0.4, 6.0), 0.25, 2.0, 4.0, 10.0, 0.01, speed_mps=3.0, slope=0.3, seconds=8.0
    ),
    "drone, slope 0.5, from the start on": Job(
        2.0, (0.4, 6.0), 0.25, 2.0, 4.0, 10.0, 0.01, speed_mps=2.0, slope=0.5, seconds=8.0
    ),
}


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("name", SLOPES)
def test_a_slow_sensor_follows_a_steep_slope(name, seed):
    """GIVEN readings that are all right WHEN the ground rises steeply between two THEN the tool rises, too.

    Consecutive heights differ by more than the innovation gate then.
    """
    job = SLOPES[name]
    plain = job.clearances_m(seed=seed).min()
    assert job.clearances_m(job.follower(), seed).min() > plain - 0.2 * job.standoff_m


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(("speed_mps", "slope"), [(0.08, 0.32), (0.057, 0.37)])
def test_nearer_ground_counts_at_once_while_the_slope_is_not_known(speed_mps, slope, seed):
    """GIVEN a sensor of 4 Hz WHEN its first samples show rising ground THEN the tool rises with each."""
    job = Job(sensor_hz=4, speed_mps=speed_mps, slope=slope)
    plain = job.clearances_m(seed=seed).min()
    assert job.clearances_m(job.follower(), seed).min() > plain + 5e-3  # 3 mm more if it does


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("jump_m", [-0.05, 0.05, 0.1])
@pytest.mark.parametrize("sensor_hz", [1, 20, 250])
def test_a_jump_of_the_reported_height_moves_the_tool_hardly(sensor_hz, jump_m, seed):
    """GIVEN level ground WHEN the reported z jumps THEN the tool stays until samples show the ground anew."""
    job = Job(sensor_hz=sensor_hz)
    found = job.clearances_m(job.follower(), seed, frame_z_m=lambda t: jump_m * (t > 2.5))
    assert np.abs(found - job.standoff_m).max() < 5e-3


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("size_m", [0.006, 0.015, 0.03])
def test_a_constant_range_far_beyond_the_standoff_is_found(size_m, seed):
    """GIVEN something that moves with the sensor WHEN it reads far too much THEN the tool descends little."""
    job = CELL
    found = job.clearances_m(
        job.follower(),
        seed,
        lambda t, read, rng: 0.1 + size_m + 0.25e-3 * rng.standard_normal() if 2.5 < t < 4.0 else read,
    )
    # two means of 8 samples at full speed, and the way to stop: 64 ms + τ
    assert found.min() > job.standoff_m - job.v_max_mps * (0.064 + 1.5 * job.tau_s)


TORCH = Job(0.004, (0.0005, 0.012), sigma_m=1e-5)


def driven_m(job, xs_m, ground_m, pose_ms=10, follower=None, seed=0, frame=None, pose_late_ms=0):
    """Least clearance over `ground_m(x)` with x(t) given per millisecond; a P loop without a follower."""
    rng, least, error = np.random.default_rng(seed), math.inf, 0.0
    axis = np.array([ground_m(xs_m[0]) + job.standoff_m, 0.0])
    target = reported = axis[0]
    reports = []
    for ms, x in enumerate(xs_m):
        now, clearance = (1000 + ms) * MS, axis[0] - ground_m(x)
        least = min(least, clearance)
        if ms % pose_ms == 0:
            reports.append((ms, axis[0]))
        while reports and reports[0][0] + pose_late_ms <= ms:
            at, reported = reports.pop(0)
            off = frame(at) if frame else 0.0
            if follower:
                follower.pose((1000 + at) * MS, (xs_m[at], 0.0, reported + off, 0.0, 0.0, 0.0, 1.0))
        if ms % 4 == 0:
            read = clearance + job.sigma_m * rng.standard_normal()
            if follower:
                follower.step(now, [read])
            error = read - job.standoff_m
        if ms % 10 == 0:
            target = reported + (follower.step(now, [math.nan])[2] if follower else -P_GAIN * error)
        axis_step(axis, target, job.tau_s, job.v_max_mps, job.a_max_mps2, 1e-3)
    return least


def way_m(speeds_mps, acceleration_mps2, seconds=3.0):
    """Places in every millisecond: the first speed for a second, then the second one."""
    v, x, places = speeds_mps[0], 0.0, []
    for ms in range(int(1e3 * seconds)):
        wanted = speeds_mps[0] if ms < 1000 else speeds_mps[1]
        step = acceleration_mps2 * 1e-3
        v += min(max(wanted - v, -step), step)
        x += v * 1e-3
        places.append(x)
    return places


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(
    ("job", "speeds", "acceleration", "pose_ms"),
    [
        (TORCH, (0.0, 0.15), 5.0, 10),
        (TORCH, (0.1, -0.1), 5.0, 10),
        (CELL, (0.1, 1.2), 1e6, 20),
        (CELL, (0.25, -0.25), 1e6, 50),
        (CELL, (0.0, 0.4), 5.0, 90),
    ],
)
def test_a_change_of_speed_is_no_jump_of_the_position(job, speeds, acceleration, pose_ms, seed):
    places = way_m(speeds, acceleration)
    turn, sign = places[1000], 1.0 if speeds[1] > 0 else -1.0

    def ground_m(x):
        return 0.02 * job.standoff_m * math.sin(3.0 / job.standoff_m * x) + 0.1 * max(sign * (x - turn), 0.0)

    follower = job.follower()
    least = driven_m(job, places, ground_m, pose_ms, follower, seed)
    plain = driven_m(job, places, ground_m, pose_ms, None, seed)
    print(1e3 * least, 1e3 * plain)
    assert least > plain - 0.1 * job.standoff_m


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("pose_late_ms", [0, 5, 10])
@pytest.mark.parametrize("jump_m", [0.03, 0.15])
def test_a_jump_of_the_height_that_is_reported_after_readings_from_behind_it(jump_m, pose_late_ms, seed):
    places = way_m((0.1, 0.1), 1.0)
    least = driven_m(
        CELL,
        places,
        lambda x: 0.002 * math.sin(30.0 * x),
        follower=CELL.follower(),
        seed=seed,
        frame=lambda ms: jump_m if ms >= 1500 else 0.0,
        pose_late_ms=pose_late_ms,
    )
    assert least > CELL.standoff_m - 0.005


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_latency_that_is_set_while_following_counts(seed):
    """Ranges that are 60 ms old when they come, over waves of 0.25 m at 0.3 m/s."""
    worst = {}
    for set_at_s in (0.0, 2.0):
        rng, follower = np.random.default_rng(seed), CELL.follower()
        axis, target, ranges, errors = np.array([0.1, 0.0]), 0.1, [], []
        for ms in range(6000):
            x, now = 0.3e-3 * ms, (1000 + ms) * MS
            clearance = axis[0] - 0.01 * math.sin(2 * math.pi * x / 0.25)
            ranges.append(clearance + CELL.sigma_m * rng.standard_normal())
            if ms == int(1e3 * set_at_s):
                follower.set_params(sensor_latency="60 ms")
            if ms % 10 == 0:
                follower.pose(now, (x, 0.0, axis[0], 0.0, 0.0, 0.0, 1.0))
            if ms % 4 == 0:
                follower.step(now, [ranges[max(ms - 60, 0)]])
            if ms % 10 == 0:
                target = axis[0] + follower.step(now, [math.nan])[2]
            axis_step(axis, target, CELL.tau_s, CELL.v_max_mps, CELL.a_max_mps2, 1e-3)
            if ms > 4000:
                errors.append(abs(clearance - CELL.standoff_m))
        assert follower.state()["health"] == "OK"
        worst[set_at_s] = max(errors)
    assert worst[2.0] < 1.5 * worst[0.0]
