"""Sensors that give the surface normal and do not respond to the tool's own rotation."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forecast.driving import default_params
from surffollow import Follower
from surffollow.benchmark.hazard_ground import quaternion
from surffollow.benchmark.hazard_scenarios import FAR_M, FOUR, NEAR_M, STANDOFF_M
from surffollow.forecast.attitude import rotation_response
from surffollow.forecast.attitude.attitude import demand_rotation
from surffollow.forecast.attitude.rotation_response import mean_beam_range, observe_rotation
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_adaptive_sensing import ROTATION_FAILED, ROTATION_RUN, ROTATION_TEST
from surffollow.shm.layout_follow import RUN_FREEZE, RUN_NORMAL, Output, Params, SenseState

MS = 1_000_000
TAU_S, SIGMA_M = 0.06, 0.25e-3
DOES_NOT_ROTATE = "readings do not respond to the tool's rotation; the tool does not rotate"


def turned(
    read, seconds: float, seed: int, mounts=FOUR, speed_mps=0.05, interval_ms=4
) -> tuple[float, set[str]]:
    """Last tilt [rad] and reasons of a tool that obeys the rotations demanded; `read(t, tilt)` in m."""
    silence = np.full(len(mounts), np.nan)
    rng = np.random.default_rng(seed)
    sensors = [{"near_m": NEAR_M, "far_m": FAR_M, "position_m": [x, y, 0.0]} for x, y in mounts]
    f = Follower({"sensors": sensors}, offset_m=STANDOFF_M)
    tilt, reasons = np.zeros(2), set()
    for ms in range(0, int(1e3 * seconds), 4):
        t_ns = (1000 + ms) * MS
        f.pose(t_ns, (speed_mps * 1e-3 * ms, 0.0, STANDOFF_M, *quaternion(tilt)))
        ranges = read(1e-3 * ms, tilt) + SIGMA_M * rng.standard_normal(4)
        demand = f.step(t_ns, ranges if ms % interval_ms == 0 else silence)
        tilt = tilt + np.array(demand[3:5]) * (4e-3 / TAU_S)
        reasons.add(f.state()["reason"])
    return float(np.hypot(*tilt)), reasons


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_ranges_that_do_not_respond_turn_the_tool_only_a_little(seed):
    """GIVEN four blocked sensors that seem to see a slope WHEN the tool turns THEN it stops, and says why."""
    slope_m = 0.05 * np.array([x for x, _ in FOUR])
    last, reasons = turned(lambda t, tilt: STANDOFF_M - (slope_m if t > 1.0 else 0.0), 4.0, seed)
    assert last < 0.4  # half of `max_tilt_rad`, which it reaches without the test
    assert DOES_NOT_ROTATE in reasons


@pytest.mark.parametrize("interval_ms", [40, 72])
def test_a_slow_ring_that_does_not_respond_turns_the_tool_only_a_little(interval_ms):
    """GIVEN the same fault with readings at 25 and 14 Hz THEN the tool stops, too."""
    slope_m = 0.05 * np.array([x for x, _ in FOUR])
    last, reasons = turned(
        lambda t, tilt: STANDOFF_M - (slope_m if t > 2.0 else 0.0), 20.0, 1, interval_ms=interval_ms
    )
    assert last < 0.4
    assert DOES_NOT_ROTATE in reasons


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("slope", [0.05, 0.3])
def test_ranges_that_respond_pass_the_test(seed, slope):
    """GIVEN a plane WHEN the tool turns to its normal THEN the response is never called missing."""
    lever_x, lever_y = np.array(FOUR).T

    def read(t, tilt):
        rise = (slope if t > 1.0 else 0.0) + np.tan(tilt[1])
        return STANDOFF_M + lever_y * np.tan(tilt[0]) - lever_x * rise

    last, reasons = turned(read, 4.0, seed)
    assert last == pytest.approx(np.arctan(slope), abs=0.02)
    assert DOES_NOT_ROTATE not in reasons


@pytest.mark.parametrize("seed", [1, 2])
def test_ground_that_turns_steadily_is_followed(seed):
    """GIVEN a normal that turns by 0.2 rad/s WHEN the tool follows it with a lag THEN it is not stopped."""
    lever_x, lever_y = np.array(FOUR).T

    def read(t, tilt):
        turned_ground = np.tan(0.2 * max(t - 1.0, 0.0))
        return STANDOFF_M + lever_y * np.tan(tilt[0]) - lever_x * (turned_ground + np.tan(tilt[1]))

    last, _ = turned(read, 4.0, seed)
    assert last == pytest.approx(0.6, abs=0.03)


class Bench:
    """The kernel alone: a tool tilted about y, over a plane that deviates from its axis by `deviation`."""

    def __init__(self) -> None:
        self.params, self.a = zeros(Params)[0], zeros(AdaptiveState)[0]
        self.params["max_tilt_rad"] = 0.8
        self.a["plant"]["tau_s"], self.a["noise"]["sigma_m"] = TAU_S, SIGMA_M
        self.a["attitude"]["t_ns"] = 1  # rotations are demanded
        self.a["plane"]["rank"], self.a["plane"]["count"], self.a["plane"]["spread_m2"] = 2, 9, 1.35e-3
        self.tilt, self.t_ns = 0.0, 10**9

    def run(self, samples: int, rate_radps: float, deviation: float) -> int:
        """The phase after so many samples at 250 Hz while the tool turns."""
        for _ in range(samples):
            self.t_ns += 4 * MS
            self.tilt += 4e-3 * rate_radps
            self.a["plane"]["fitted_x"] = -np.tan(self.tilt + deviation)
            pose = np.array([0.0, 0.0, 0.1, *quaternion(np.array([0.0, self.tilt]))])
            observe_rotation(self.params, self.a, self.t_ns, pose)
        return int(self.a["rotation"]["phase"])

    def turned_by(self, wanted_rad: float) -> float:
        """How far the test lets the axis turn of what is wanted [rad]."""
        wanted = (np.sin(self.tilt + wanted_rad), 0.0, np.cos(self.tilt + wanted_rad))
        x, _, _ = rotation_response.tested_direction(self.a["rotation"], wanted)
        return float(np.arcsin(x)) - self.tilt


def test_a_deviation_that_ignores_the_rotation_is_tested_and_failed_until_it_changes():
    bench = Bench()
    assert bench.turned_by(0.5) == pytest.approx(0.5)
    assert bench.run(80, 0.3, 0.03) == ROTATION_TEST
    back = bench.turned_by(0.5)
    assert -0.1 < back < 0.0
    assert bench.run(200, 0.0, 0.03) == ROTATION_TEST, "without a rotation nothing is learned"
    assert bench.run(40, back / 0.16, 0.03) == ROTATION_TEST, "the mean needs some samples"
    assert bench.run(80, 0.0, 0.03) == ROTATION_FAILED
    assert bench.turned_by(0.5) == pytest.approx(0.0, abs=2e-3), "no farther than where it failed"
    assert bench.run(200, 0.0, 0.03) == ROTATION_FAILED
    assert bench.run(30, 0.0, 0.08) == ROTATION_RUN


@pytest.mark.parametrize("goes_on_radps", [0.0, 0.3])
def test_ground_answers_the_test_whether_it_goes_on_to_turn_or_not(goes_on_radps):
    bench = Bench()
    assert bench.run(80, 0.3, 0.03) == ROTATION_TEST
    deviation, turn = 0.03, bench.turned_by(0.5) / 0.12
    for _ in range(30):  # what the tool turns back the deviation grows by
        deviation += (goes_on_radps - turn) * 4e-3
        phase = bench.run(1, turn, deviation)
    assert phase == ROTATION_RUN


@pytest.mark.parametrize("responds", [True, False])
def test_a_tool_that_stops_before_the_target_of_the_test_is_judged_by_how_far_it_has_turned(responds):
    """It stopped `permitted_turn_rad` from the target, more than half of the test: that lasted for ever."""
    bench, permitted = Bench(), 0.02
    bench.params["permitted_turn_rad"] = permitted
    assert bench.run(80, 0.3, 0.03) == ROTATION_TEST
    deviation, turn = 0.03, bench.turned_by(0.5) + permitted
    assert turn < -0.02
    for _ in range(40):
        deviation -= turn / 40 if responds else 0.0
        bench.run(1, turn / 0.16, deviation)
    assert bench.run(80, 0.0, deviation) == (ROTATION_RUN if responds else ROTATION_FAILED)


@pytest.mark.parametrize("reason", ["", "FREEZE", "not demanded", "inconsistent beams"])
def test_a_tool_that_does_not_turn_back_fails_in_time_where_rotations_are_applied(reason):
    bench, applied = Bench(), reason == ""
    bench.params["max_turn_speed_radps"] = 1.0
    bench.params["run"] = RUN_FREEZE if reason == "FREEZE" else RUN_NORMAL
    bench.a["attitude"]["t_ns"] = 0 if reason == "not demanded" else 1
    bench.a["beams"]["inconsistent"] = 1 if reason == "inconsistent beams" else 0
    assert bench.run(80, 0.3, 0.03) == ROTATION_TEST
    assert bench.run(120, 0.0, 0.03) == ROTATION_TEST
    assert bench.run(80, 0.0, 0.03) == (ROTATION_FAILED if applied else ROTATION_TEST)


def test_a_lag_explains_a_small_deviation_but_not_a_long_rotation():
    bench = Bench()
    assert bench.run(60, 0.9, 0.012) == ROTATION_RUN  # 0.2 rad; 0.3 tau times the rate is 0.016
    assert bench.run(20, 0.9, 0.012) == ROTATION_TEST  # 0.3 of the greatest tilt


def test_too_few_beams_end_a_test():
    bench = Bench()
    assert bench.run(80, 0.3, 0.03) == ROTATION_TEST
    bench.a["plane"]["rank"] = 1
    assert bench.run(5, 0.0, 0.03) == ROTATION_TEST
    assert bench.run(20, 0.0, 0.03) == ROTATION_RUN


def ring_params(places_m, orientations):
    """Parameters of a ring with a stand-off of 0.1 m."""
    params = default_params()[0]
    params["offset_m"], params["n_channels"] = 0.1, len(places_m)
    mounts = params["tool_from_sensor"].reshape(-1, 7)
    mounts[: len(places_m), :3], mounts[: len(places_m), 3:] = places_m, orientations
    return params


def test_the_mean_range_is_of_all_beams_that_are_new():
    params = ring_params(4 * [(0.0, 0.0, 0.0)], 4 * [(0.0, 0.0, 0.0, 1.0)])
    beams, sense = zeros(AdaptiveState)[0]["beams"], zeros(SenseState)[0]
    assert mean_beam_range(params, beams, sense, 10**9, 0.2) == 0.2
    beams["t_ns"][:3], sense["range_m"][:3] = 10**9 - MS, (0.1, 0.2, 0.6)
    beams["t_ns"][2] -= 100 * MS
    assert mean_beam_range(params, beams, sense, 10**9, 0.5) == pytest.approx(0.15)


def test_at_the_stand_off_the_mean_range_is_the_stand_off_whatever_the_mounts():
    """GIVEN a beam inclined by 20 degrees and one mounted 5 mm higher THEN the mean is 0.1 m, and follows."""
    angle = math.radians(20.0)
    inclined = (0.0, math.sin(angle / 2.0), 0.0, math.cos(angle / 2.0))
    upright = (0.0, 0.0, 0.0, 1.0)
    params = ring_params([(0, 0, 0), (0.03, 0, 0), (-0.03, 0, 0.005)], [upright, inclined, upright])
    beams, sense = zeros(AdaptiveState)[0]["beams"], zeros(SenseState)[0]
    for lift_m in (0.0, 0.02):
        ranges = np.array([0.1, 0.1 / math.cos(angle), 0.105]) + lift_m
        beams["t_ns"][:3], sense["range_m"][:3] = 10**9, ranges
        assert mean_beam_range(params, beams, sense, 10**9, 0.5) == pytest.approx(0.1 + lift_m)


@pytest.mark.parametrize("seed", [1, 2])
def test_one_blocked_reference_does_not_stop_a_follower_with_three_good_sensors(seed):
    """GIVEN channel 0 constant WHEN the ground falls and the tool follows it THEN it is not called stuck."""
    rng = np.random.default_rng(seed)
    sensors = [{"near_m": NEAR_M, "far_m": FAR_M, "position_m": [x, y, 0.0]} for x, y in FOUR]
    f = Follower({"sensors": sensors}, offset_m=STANDOFF_M)
    z, tilt = STANDOFF_M, np.zeros(2)
    for ms in range(0, 6000, 4):
        t_ns, ground = (1000 + ms) * MS, -0.02e-3 * max(ms - 1000, 0)
        f.pose(t_ns, (0.05e-3 * ms, 0.0, z, *quaternion(tilt)))
        r = z - ground + SIGMA_M * rng.standard_normal(4)
        if ms > 1000:
            r[0] = STANDOFF_M + SIGMA_M * rng.standard_normal()
        demand = f.step(t_ns, r)
        z += float(demand[2]) * (4e-3 / TAU_S)
        assert f.state()["health"] != "STUCK"
    assert "VALID" in f.state()["status"]


def test_a_tool_whose_sensors_are_all_stuck_does_not_rotate():
    sensors = [{"near_m": NEAR_M, "far_m": FAR_M, "position_m": [x, y, 0.0]} for x, y in FOUR]
    f, rng, stuck = Follower({"sensors": sensors}, offset_m=STANDOFF_M), np.random.default_rng(3), 0
    r = STANDOFF_M - 0.1 * np.array([x for x, _ in FOUR])
    for ms in range(0, 2400, 4):
        t_ns = (1000 + ms) * MS
        rise = 0.03e-3 * max(ms - 1000, 0)
        f.pose(t_ns, (0.05e-3 * ms, 0.0, STANDOFF_M + rise, 0.0, 0.0, 0.0, 1.0))
        noise = SIGMA_M * rng.standard_normal(4) if ms < 1000 else 0.0
        demand = f.step(t_ns, r + noise)
        if "STUCK" in f.state()["faults"]:
            stuck += 1
            assert (np.array(demand[3:]) == 0.0).all()
    assert stuck > 40


@pytest.mark.parametrize("radius_m", [0.025, 0.035])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_ring_follows_the_normal_behind_a_kink(radius_m, seed):
    """GIVEN level ground that becomes a slope WHEN a ring is over it THEN the tool turns to the slope.

    Over the kink its beams lie on no plane, behind it they do.
    """
    angles = 0.3 + 0.5 * np.pi * np.arange(4)
    lever_x, lever_y = radius_m * np.cos(angles), radius_m * np.sin(angles)

    def read(t, tilt):
        rise = 0.3 * np.maximum(0.2 * t - 0.3 + lever_x, 0.0) - 0.3 * max(0.2 * t - 0.3, 0.0)
        return STANDOFF_M + lever_y * np.tan(tilt[0]) - lever_x * np.tan(tilt[1]) - rise

    last, _ = turned(read, 3.5, seed, mounts=list(zip(lever_x, lever_y)), speed_mps=0.2)
    assert last == pytest.approx(np.arctan(0.3), abs=0.03)


@pytest.mark.parametrize(("inconsistent", "turns"), [(0, True), (1, False)])
def test_inconsistent_beams_hold_the_direction(inconsistent, turns):
    """GIVEN a plane of before that is steep WHEN the beams are inconsistent THEN it is no target."""
    params, a = default_params(orient=1)[0], zeros(AdaptiveState)[0]
    sense, output = zeros(SenseState)[0], zeros(Output)[0]
    a["plane"]["slope_x"], a["plane"]["count"] = -0.9, 9
    a["beams"]["inconsistent"] = inconsistent
    sense["pose_count"], sense["pose"][6] = 1, 1.0
    for ms in range(0, 200, 10):
        a["clock"]["now_ns"] = (1000 + ms) * MS
        demand_rotation(params, a, sense, output)
    assert (np.linalg.norm(output["demand"][3:]) > 0.05) == turns
    assert turns or not output["demand"][3:].any()
