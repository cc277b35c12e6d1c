"""Faults around the default follower: clock jumps, FREEZE and DRYRUN, slow callers, stuck sensors."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow.config.params import PARAMS
from surffollow.follower import Follower
from surffollow.forecast.setpoint.setpoint_limits import limit_setpoint
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_follow import Params

MS = 1_000_000
NAN = float("nan")


class Bench:
    """A follower over ground at 0, its tool held wherever a test puts it."""

    def __init__(self, sigma_m: float = 2e-5, **config: object) -> None:
        self.f = Follower({"memory": False, **config}, offset_m=0.1)
        self.a = self.f._state["adaptive"][0]
        self.rng = np.random.default_rng(1)
        self.t_ns, self.x_m, self.sigma_m = 10**10, 0.0, sigma_m

    def go(self, count: int, z_m: float, period_ns: int = MS, speed_mps: float = 0.0, every: int = 1):
        """Step `count` times, with a reading in each `every`th (0: none); the vertical demands [m]."""
        demands = []
        for k in range(count):
            self.t_ns += period_ns
            self.x_m += speed_mps * period_ns * 1e-9
            self.f.pose(self.t_ns, (self.x_m, 0.0, z_m, 0.0, 0.0, 0.0, 1.0))
            r = z_m + self.sigma_m * self.rng.standard_normal() if every and k % every == 0 else NAN
            demands.append(float(self.f.step(self.t_ns, [r])[2]))
        return np.array(demands)


@pytest.mark.parametrize("back_s", [2, 10, 36_000])
def test_a_clock_that_jumps_back_is_followed(back_s):
    b = Bench()
    b.t_ns = 10**14
    b.go(500, 0.1, speed_mps=0.1)
    b.t_ns -= back_s * 10**9
    b.go(10, 0.1, speed_mps=0.1)
    demands = b.go(140, 0.102, speed_mps=0.1)
    state = b.f.state()
    assert "CLOCK" in state["faults"]
    assert "VALID" in state["status"]
    assert state["health"] == "OK"
    assert demands[-1] == pytest.approx(-2e-3, abs=2e-4)


def test_a_clock_that_jumps_back_is_followed_with_several_sensors():
    ring = [{"position_m": [0.03 * math.cos(k), 0.03 * math.sin(k), 0.0]} for k in (0.0, 2.1, 4.2)]
    b = Bench(sensors=ring)
    for back in (0, 1):
        b.t_ns -= back * 10 * 10**9
        for _ in range(200):
            b.t_ns += 4 * MS
            b.f.pose(b.t_ns, (0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
            b.f.step(b.t_ns, 0.1 + 2e-5 * b.rng.standard_normal(3))
        assert b.f.state()["health"] == "OK"
        assert b.f.state()["beams"] == 7


@pytest.mark.parametrize("run", ["freeze", "dryrun"])
def test_after_freeze_and_dryrun_the_setpoint_begins_at_the_tool(run):
    b = Bench()
    b.go(500, 0.1)
    b.f.set_params(run=run)
    shown = b.go(1000, 0.13)
    assert shown[-1] == pytest.approx(0.0 if run == "freeze" else -0.03, abs=1e-4)
    b.f.set_params(run="normal")
    demands = b.go(200, 0.13)  # a tool that stays looks pushed, by a little
    # what the axis can use and 4e5 m/s³ allow, half of it toward the surface
    assert -0.5e-3 < demands[0] < 0.0
    assert np.abs(np.diff(demands)).max() <= 0.2 * 1e-3 + 1e-9
    assert demands[-1] == pytest.approx(-0.03, abs=2e-4)


def test_after_dryrun_with_four_sensors_the_attitude_begins_at_the_tool():
    ring = [{"position_m": [0.03 * math.cos(k), 0.03 * math.sin(k), 0.0]} for k in (0.0, 2.1, 4.2)]
    b, turns = Bench(sensors=ring), []
    for k in range(600):
        if k in (100, 500):
            b.f.set_params(run="dryrun" if k == 100 else "normal")
        slope = 0.1 if k >= 100 else 0.0
        b.t_ns += 4 * MS
        b.f.pose(b.t_ns, (0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
        ranges = [0.1 - slope * m["position_m"][0] + 2e-5 * b.rng.standard_normal() for m in ring]
        turns.append(float(np.linalg.norm(b.f.step(b.t_ns, ranges)[3:])))
    assert turns[499] == pytest.approx(math.atan(0.1), abs=5e-3), "shown"
    assert turns[500] < 1e-3, "begins at the tool"


def test_another_assumed_time_constant_counts_from_the_next_reset_on():
    """It counted at once: a tool whose axis seemed ten times slower oscillated through the ground."""
    b = Bench()
    b.go(300, 0.1, speed_mps=0.1)
    b.f.set_params(plant_tau_s=0.07, adapt=0)
    b.go(20, 0.1, speed_mps=0.1)
    assert b.f.state()["tau_s"] == pytest.approx(0.04, rel=0.2)
    b.f.reset()
    b.go(20, 0.1, speed_mps=0.1)
    assert b.f.state()["tau_s"] == 0.07


def test_the_published_weights_are_those_of_all_models():
    b = Bench()
    b.go(300, 0.1, speed_mps=0.1)
    assert sum(b.f.state()["weights"]) == pytest.approx(1.0)


@pytest.mark.parametrize("rate_hz", [5, 10, 15, 25])
def test_a_slow_sensor_is_healthy_until_it_stops(rate_hz):
    b, every = Bench(), 1000 // rate_hz
    b.go(20 * every, 0.1, every=every)
    for k in range(20 * every):
        b.go(1, 0.1, every=1 if k % every == 0 else 0)
        assert b.f.state()["health"] == "OK"
    b.go(1100, 0.1, every=0)
    assert b.f.state()["health"] == "DROPOUT"


def remembering(passes: int = 1) -> Bench:
    """A bench whose follower has seen 0.2 m of ground and stands at its begin."""
    b = Bench(memory=True)
    for _ in range(passes):
        b.x_m = 0.0
        b.go(2000, 0.1, speed_mps=0.1)
        b.t_ns += 2 * 10**9
    b.x_m = 0.0
    return b


def test_a_reset_forgets_remembered_ground_unless_it_is_to_be_kept():
    for keep, most, least in ((False, 0.0, 0.0), (True, 1.0, 0.9)):
        b = remembering()
        b.f.reset(keep_memory=keep)
        b.go(1000, 0.1, speed_mps=0.1)
        assert least <= b.f.state()["preview_share"] <= most


def test_ground_remembered_in_another_reference_time_is_forgotten():
    b = remembering()
    b.f.set_params(plant_tau_s=0.1)  # twice the reference time: timestamps in memory are of another clock
    b.f.reset(keep_memory=True)
    assert not np.any(b.f._memory["n"])


def test_a_plan_over_lost_ground_leaves_no_share_behind():
    b = remembering()
    b.go(1000, 0.1, speed_mps=0.1)
    assert b.f.state()["preview_share"] > 0.9
    b.f.reset(keep_memory=True)
    b.go(1, 0.1, speed_mps=0.1)
    assert b.f.state()["preview_share"] <= 0.2
    b.go(500, 0.1, speed_mps=0.1)
    b.t_ns += 3 * 10**9
    b.go(1, 0.1, every=0)
    assert "SENSOR_LOST" in b.f.state()["status"]
    assert b.f.state()["preview_share"] == 0.0


@pytest.mark.parametrize("rate_hz", [1, 2, 5, 9])
def test_a_slow_caller_is_followed_within_the_limits_of_the_elapsed_time(rate_hz):
    dt_s = 1.0 / rate_hz
    b = Bench(max_speed_mps=0.02, max_accel_mps2=0.1)
    z, zs = 0.12, []
    for _ in range(20 + 3 * rate_hz):
        for k in range(5):  # poses come more often
            b.f.pose(b.t_ns + round((k + 1) * dt_s * 2e8), (0.0, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        b.t_ns += round(dt_s * 1e9)
        z += float(b.f.step(b.t_ns, [z + 2e-5 * b.rng.standard_normal()])[2])
        zs.append(z)
    assert abs(z - 0.1) < 1e-4
    assert np.diff(zs).min() >= -0.01 * dt_s - 1e-9, "half of max_speed toward the surface"


def test_after_a_pause_the_setpoint_starts_at_the_tool():
    for period_ns, pause_ns in ((MS, 110 * MS), (200 * MS, 900 * MS)):
        b = Bench()
        b.go(60, 0.1, period_ns=period_ns)
        b.t_ns += pause_ns
        demand = b.go(1, 0.13, period_ns=MS)[0]
        assert -0.5e-3 < demand < 0.0


@pytest.mark.parametrize("intervals_ms", [(1, 20), (2, 4), (0.05, 3, 30), (0.1, 20)])
def test_a_setpoint_in_irregular_cycles_does_not_overshoot(intervals_ms):
    params, a, rng = zeros(Params), zeros(AdaptiveState)[0], np.random.default_rng(0)
    for name, spec in PARAMS.items():
        params[name] = spec.default
    t, z, over = 10**10, 0.0, []
    for _ in range(100):
        to = z + float(rng.choice([-0.02, -5e-3, -5e-4, 5e-4, 5e-3, 0.02]))
        most = 0.0
        for _ in range(60):
            t += int(rng.choice(intervals_ms) * MS)
            limit_setpoint(params[0], a, t, to, z)
            most = max(most, (a["setpoint"]["position_m"] - to) * np.sign(to - z))
        z = to
        over.append(most)
    assert max(over[2:]) < 0.15e-3


class Robot:
    """A follower whose demands a robot of τ = 40 ms takes 100 times a second; 100 poses per second."""

    def __init__(self, ground, speed_mps: float, rate_hz: int = 250, mounts=(0.0,), config=None) -> None:
        sensors = [{"position_m": [m, 0.0, 0.0]} for m in mounts]
        self.f = Follower({"memory": False, "sensors": sensors, **(config or {})}, offset_m=0.1)
        self.ground, self.speed_mps, self.every, self.mounts = ground, speed_mps, 1000 // rate_hz, mounts
        self.rng, self.k, self.z_m, self.v_mps = np.random.default_rng(3), 0, 0.1 + ground(0.0), 0.0
        self.goal_m, self.demand_m, self.reported_m = self.z_m, 0.0, self.z_m

    def run(self, seconds: float, sigma_m: float = 5e-5, lsb_m: float = 0.0, held_m=None):
        """Stand-off of every millisecond [m]; `held_m`: the readings that the sensors repeat."""
        out = []
        for _ in range(round(seconds * 1000)):
            t_ns, x_m = 10**10 + self.k * MS, self.k * 1e-3 * self.speed_mps
            if self.k % 10 == 0:
                self.reported_m = self.z_m
                self.f.pose(t_ns, (x_m, 0.0, self.z_m, 0.0, 0.0, 0.0, 1.0))
            if self.k % self.every == 0:
                ranges = held_m or [
                    self.z_m - self.ground(x_m + m) + sigma_m * self.rng.standard_normal()
                    for m in self.mounts
                ]
                if lsb_m > 0.0:
                    ranges = [round(r / lsb_m) * lsb_m for r in ranges]
                self.demand_m = self.reported_m + float(self.f.step(t_ns, ranges)[2])
            if self.k % 10 == 0:
                self.goal_m = self.demand_m
            wish = min(max((self.goal_m - self.z_m) / 0.04, -0.2), 0.2)
            self.v_mps += min(max(wish - self.v_mps, -2e-3), 2e-3)
            self.z_m += 1e-3 * self.v_mps
            self.k += 1
            out.append(self.z_m - self.ground(x_m))
        return np.array(out)


@pytest.mark.parametrize("rate_hz", [50, 250, 1000])
@pytest.mark.parametrize("held_m", [0.1002, 0.1008, 0.103])
def test_a_stuck_sensor_does_not_drive_the_tool_to_the_surface(rate_hz, held_m):
    robot = Robot(lambda x: 0.0, 0.1, rate_hz)
    robot.run(3.0)
    assert robot.run(5.0, held_m=[held_m]).min() > 0.092
    state = robot.f.state()
    assert state["health"] == "STUCK"
    assert "STUCK" in state["faults"]
    assert "VALID" not in state["status"]
    robot.run(1.0)
    assert robot.f.state()["health"] == "OK"
    assert np.abs(robot.run(1.0) - 0.1).max() < 5e-4


def test_a_sensor_that_reads_again_what_it_was_stuck_at_is_believed_when_the_ground_changes():
    """GIVEN a blocked sensor that reads the same later THEN there is no demand until it changes by 1.5 b."""
    robot = Robot(lambda x: 0.0, 0.1, 50)
    robot.run(3.0)
    robot.ground = lambda x: robot.z_m - 0.1005  # something that moves with the sensor blocks it
    robot.run(5.0)
    level_m = robot.z_m - 0.1005
    robot.ground = lambda x: level_m + (1e-3 if x > 0.95 else 0.0)
    robot.run(1.0)
    assert robot.f.state()["health"] == "STUCK"
    assert "VALID" not in robot.f.state()["status"]
    robot.run(1.5)
    assert robot.f.state()["health"] == "OK"
    assert np.abs(robot.run(1.0) - 0.1).max() < 5e-4


@pytest.mark.parametrize("rate_hz", [20, 50, 100])
@pytest.mark.parametrize("after_s", [0.3, 0.5, 0.9])
def test_a_slow_sensor_that_sticks_at_once_is_found_in_time(rate_hz, after_s):
    for slope in (0.0, -0.1, -0.2):
        robot = Robot(lambda x, slope=slope: slope * x, 0.1, rate_hz)
        robot.run(after_s, sigma_m=2.5e-4)
        assert robot.run(5.0, held_m=[0.1004]).min() > 0.094, f"slope {slope}"
        assert robot.f.state()["health"] == "STUCK"


def test_four_stuck_sensors_do_not_drive_the_tool_to_the_surface():
    robot = Robot(lambda x: 0.0, 0.1, mounts=(0.0, 0.03, -0.015, 0.01))
    robot.run(2.0)
    assert robot.run(4.0, held_m=[0.1007, 0.1006, 0.1008, 0.1007]).min() > 0.095
    assert robot.f.state()["health"] == "STUCK"


@pytest.mark.parametrize(
    ("slope", "speed_mps", "lsb_m"), [(0.2, 0.4, 1e-4), (0.3, 0.1, 1e-4), (0.2, 0.4, 2.5e-4)]
)
def test_a_coarse_sensor_on_a_ramp_is_not_taken_for_stuck(slope, speed_mps, lsb_m):
    robot = Robot(lambda x: slope * x, speed_mps)
    robot.run(1.0, sigma_m=1e-6, lsb_m=lsb_m)
    stuck = 0
    for _ in range(50):
        robot.run(0.1, sigma_m=1e-6, lsb_m=lsb_m)
        stuck += robot.f.state()["health"] == "STUCK"
    assert stuck <= 2
    assert abs(robot.run(0.5, sigma_m=1e-6, lsb_m=lsb_m) - 0.1).max() < 2e-3


@pytest.mark.parametrize(
    ("record", "name"),
    [
        ("weights", "recent_m2"),
        ("weights", "longer_m2"),
        ("bank", "height_m"),
        ("bank", "wave_number"),
        ("bank", "p00"),
        ("noise", "sigma_m"),
        ("shadow", "effort"),
    ],
)
def test_a_state_that_is_not_finite_is_reset_and_following_continues(record, name):
    """No input is known to make it so; should one be found, it must not be for good."""
    robot = Robot(lambda x: 0.0, 0.1)
    robot.run(1.5)
    inside = robot.f._state["adaptive"][record][name]
    inside[...] = np.nan
    robot.run(0.04)
    state = robot.f.state()
    assert (state["health"], state["reason"]) == ("FAULT", "estimate was not finite and began anew")
    robot.run(0.96)
    state = robot.f.state()
    assert state["health"] == "OK"
    assert "VALID" in state["status"]
    assert "NOT_FINITE" in state["faults"]
    assert np.abs(robot.run(0.5) - 0.1).max() < 5e-4


def test_a_follower_whose_readings_never_confirm_each_other_is_not_valid_and_says_why():
    """Ground that differs by metres between slow readings: each one starts anew, and none is an estimate."""
    f = Follower({"sensors": [{"near_m": 0.01, "far_m": 60.0}]}, offset_m=0.1)
    rng = np.random.default_rng(3)
    valid_s, reasons = 0.0, set()
    for k in range(6000):
        t = k * 10 * MS
        f.pose(t, (0.01 * k, 0.0, 30.0, 0.0, 0.0, 0.0, 1.0))
        demand = f.step(t, [20.0 + 5.0 * rng.standard_normal() if k % 100 == 0 else math.nan])
        reported = f.state()
        if t > 10_000 * MS and "VALID" in reported["status"] and demand[2] == 0.0:
            valid_s += 0.01
        reasons.add((reported["health"], reported["reason"]))
    assert valid_s < 2.5, "a demand of zero is not VALID for longer than the loss time-out"
    assert ("DROPOUT", "no sample entered the estimate within the loss time-out") in reasons
    assert "LOST" in reported["faults"]


@pytest.mark.parametrize("slope", [-0.2, -0.1])
@pytest.mark.parametrize("forward_s", [0.0, 0.2])
def test_a_tool_that_turns_back_in_a_loss_goes_no_deeper(slope, forward_s):
    """The slope ahead says nothing about the way back over ground that was just measured."""
    f = Follower({"memory": False}, offset_m=0.1)
    rng, x_m, z_m, v_mps, goal_m, turn_z_m = np.random.default_rng(3), 0.0, 0.1, 0.0, 0.1, math.inf
    for ms in range(5400):
        lost, back = ms >= 3000, ms >= 3000 + 1000 * forward_s
        x_m += -1e-4 if back else 1e-4
        if back and turn_z_m == math.inf:
            turn_z_m = z_m
        if ms % 10 == 0:
            f.pose(10**10 + ms * MS, (x_m, 0.0, z_m, 0.0, 0.0, 0.0, 1.0))
        reading = z_m - slope * x_m + 1e-4 * rng.standard_normal()
        demand = f.step(10**10 + ms * MS, [math.nan if lost or ms % 4 else reading])
        if ms % 10 == 0:
            goal_m = z_m + float(demand[2])
        wish = min(max((goal_m - z_m) / 0.04, -0.2), 0.2)
        v_mps += min(max(wish - v_mps, -2e-3), 2e-3)
        z_m += 1e-3 * v_mps
        assert z_m > turn_z_m - 4e-3 or not back, f"{ms - 3000} ms after the loss"


@pytest.mark.parametrize(
    ("record", "name"),
    [("plane", "slope_x"), ("plane", "curvature"), ("beams", "weight"), ("attitude", "axis")],
)
def test_an_attitude_that_is_not_finite_is_reset_and_following_continues(record, name):
    ring = [{"position_m": [0.03 * math.cos(k), 0.03 * math.sin(k), 0.0]} for k in (0.0, 2.1, 4.2)]
    b = Bench(sensors=ring)
    for k in range(600):
        if k == 300:
            b.f._state["adaptive"][record][name][...] = np.nan
        b.t_ns += 4 * MS
        b.f.pose(b.t_ns, (0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
        slope = 0.1 * np.array([s["position_m"][0] for s in ring])
        demand = b.f.step(b.t_ns, 0.1 - slope + 2e-5 * b.rng.standard_normal(3))
    assert "VALID" in b.f.state()["status"]
    assert float(demand[4]) == pytest.approx(-math.atan(0.1), abs=3e-3)
