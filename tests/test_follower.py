"""The follower in process: what an embedder relies on, in both modes."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest

import surffollow
from follower_poses import MS, T0, at
from surffollow.errors import UsageError
from surffollow.sim.plant import axis_step


def travel(follower, ground, speed=0.1, seconds=2.0, offset=0.1, sigma=0.0, seed=0, start_ns=T0, lag=True):
    """Lead a tool over the ground; its axis is the benchmark's, or without any lag. Its stand-off errors."""
    rng = np.random.default_rng(seed)
    axis = np.array([ground(0.0) + offset, 0.0])
    target = axis[0]
    errors = []
    for ms in range(int(1e3 * seconds)):
        t, x = start_ns + ms * MS, speed * ms * 1e-3
        errors.append(axis[0] - ground(x) - offset)
        if ms % 4 == 0:
            follower.step(t, [errors[-1] + offset + sigma * rng.standard_normal()])
        if ms % 10 == 0:
            follower.pose(t, at(x, axis[0]))
            target = axis[0] + follower.step(t, [math.nan])[2]
        if lag:
            axis_step(axis, target, 0.04, 0.2, 2.0, 1e-3)
        else:
            axis[0] = target
    return np.array(errors)


@pytest.mark.parametrize("mode", ["paper", "adaptive"])
def test_a_clock_that_begins_at_zero_follows_as_any_other(mode):
    def run(start_ns):
        f = surffollow.Follower({"mode": mode}, offset_m=0.1)
        demands = []
        for k in range(400):
            t = start_ns + k * MS
            if k % 10 == 0:
                f.pose(t, at(1e-4 * k, 0.2))
            demands.append(f.step(t, [0.11 + 1e-5 * k if k % 4 == 0 else math.nan]))
        return np.array(demands), f.state()

    (late, reported), (zero, reported_zero) = run(T0), run(0)
    assert zero[0 if mode == "paper" else 20, 2] != 0.0
    assert np.array_equal(late, zero)
    assert (reported_zero["t_ns"], reported_zero["pose_t_ns"]) == (399 * MS, 390 * MS)
    assert (reported["t_ns"], reported["pose_t_ns"]) == (T0 + 399 * MS, T0 + 390 * MS)


@pytest.mark.parametrize("mode", ["paper", "adaptive"])
def test_the_surface_is_that_of_the_state_at_every_step(mode):
    f = surffollow.Follower({"mode": mode}, offset_m=0.1)
    slopes = set()
    for k in range(400):
        if k % 10 == 0:
            f.pose(T0 + k * MS, at(1e-4 * k, 0.2))
        f.step(T0 + k * MS, [0.11 + 1e-4 * k if k % 4 == 0 else math.nan])
        state = f.state()
        assert f.surface() == (state["height_m"], state["slope"])
        slopes.add(state["slope"])
    assert len(slopes) > 10  # the estimate moved


def test_times_before_the_clocks_beginning_or_beyond_its_end_are_refused():
    f = surffollow.Follower()
    for t_ns in (-7200 * 1_000_000_000, 1 << 62):
        with pytest.raises(UsageError, match="hour"):
            f.step(t_ns, [0.1])
        with pytest.raises(UsageError, match="hour"):
            f.pose(t_ns, at(0.0, 0.2))


def test_importing_the_package_does_not_load_numba():
    code = "import sys, surffollow; assert 'numba' not in sys.modules; surffollow.Follower"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("mode", ["paper", "adaptive"])
def test_without_a_pose_nothing_is_demanded(mode):
    f = surffollow.Follower({"mode": mode}, offset_m=0.1)
    assert not f.step(T0, [0.12]).any()
    assert f.state()["status"] == ["NO_POSE"]


@pytest.mark.parametrize("mode", ["paper", "adaptive"])
def test_a_tool_that_is_too_high_is_sent_down(mode):
    f = surffollow.Follower({"mode": mode}, offset_m=0.1)
    demand = np.zeros(6)
    for k in range(20):
        f.pose(T0 + 10 * k * MS, at(0.0, 0.2))
        demand = f.step(T0 + 10 * k * MS, [0.11])
    assert demand.shape == (6,)
    assert demand[2] == pytest.approx(-0.01, abs=1e-3)


@pytest.mark.parametrize("mode", ["paper", "adaptive"])
def test_a_stale_pose_stops_every_demand(mode):
    f = surffollow.Follower({"mode": mode}, offset_m=0.1)
    f.pose(T0, at(0.0, 0.2))
    for ms in (0, 4, 8):
        f.step(T0 + ms * MS, [0.12])
    assert f.step(T0 + 50 * MS, [0.12])[2] < 0.0
    assert not f.step(T0 + 101 * MS, [0.12]).any()
    assert "POSE_STALE" in f.state()["status"]


@pytest.mark.parametrize("mode", ["paper", "adaptive"])
def test_no_reading_for_the_loss_timeout_stops_the_demand(mode):
    f = surffollow.Follower({"mode": mode, "loss_timeout": "0.5 s"}, offset_m=0.1)
    travel(f, lambda x: 0.1 * x, seconds=1.0)
    for k in range(70):
        f.pose(T0 + (1000 + 10 * k) * MS, at(0.1 + 0.001 * k, 0.11))
        demand = f.step(T0 + (1000 + 10 * k) * MS, [math.nan])
    assert not demand.any()
    assert "SENSOR_LOST" in f.state()["status"]


@pytest.mark.parametrize("mode", ["paper", "adaptive"])
def test_freeze_demands_nothing_and_dryrun_is_marked(mode):
    f = surffollow.Follower({"mode": mode}, offset_m=0.1)
    travel(f, lambda x: 0.05, seconds=0.5)
    f.set_params(run="dryrun")
    f.pose(T0 + 600 * MS, at(0.06, 0.2))
    f.step(T0 + 600 * MS, [0.14])
    assert "DRYRUN" in f.state()["status"]
    assert "VALID" not in f.state()["status"]
    f.set_params(run="freeze")
    f.pose(T0 + 610 * MS, at(0.061, 0.2))
    assert not f.step(T0 + 610 * MS, [0.14]).any()
    assert "FROZEN" in f.state()["status"]


def test_a_file_configures_like_a_dictionary(tmp_path):
    file = tmp_path / "follow.toml"
    file.write_text('[follow]\nmode = "paper"\noffset = "4 in"\n')
    f = surffollow.Follower(file)
    assert f.state()["mode"] == "paper"
    assert f.state()["offset_m"] == pytest.approx(0.1016)


def test_the_default_follower_learns_a_slope_and_stays_on_it():
    f = surffollow.Follower(offset_m=0.1)
    errors = travel(f, lambda x: 0.15 * x, seconds=3.0, sigma=0.25e-3)
    assert np.abs(errors[1000:]).max() < 1e-3
    reported = f.state()
    assert reported["slope"] == pytest.approx(0.15, abs=0.02)
    assert reported["speed_mps"] == pytest.approx(0.1, abs=1e-6)
    assert reported["noise_m"] == pytest.approx(0.25e-3, rel=0.4)
    assert reported["health"] == "OK"


def test_the_same_calls_give_the_same_bits():
    def ground(x):
        return 0.005 * math.sin(20 * x)

    runs = [travel(surffollow.Follower(offset_m=0.1), ground, seconds=1.5, sigma=2e-4) for _ in range(2)]
    assert runs[0].tobytes() == runs[1].tobytes()


def test_a_second_pass_over_known_ground_follows_better():
    def ground(x):
        return 0.006 * math.sin(60 * x) * math.cos(23 * x)

    f = surffollow.Follower(offset_m=0.1)
    first = travel(f, ground, speed=0.2, seconds=3.0, sigma=2e-4)
    second = travel(f, ground, speed=0.2, seconds=2.5, sigma=2e-4, seed=1, start_ns=T0 + 10_000 * MS)
    assert second[1000:].std() < 0.8 * first[1000:].std()
    assert f.state()["preview_share"] == 1.0


def test_preview_for_a_robot_that_is_not_as_assumed_is_given_up():
    def ground(x):
        return 0.006 * math.sin(60 * x) * math.cos(23 * x)

    f = surffollow.Follower(offset_m=0.1)
    first = travel(f, ground, seconds=3.0, sigma=2e-4, lag=False)
    second = travel(f, ground, seconds=3.0, sigma=2e-4, seed=1, start_ns=T0 + 10_000 * MS, lag=False)
    assert np.abs(first[1000:]).max() < 2e-3
    assert np.abs(second).max() < 8e-3


def test_three_sensors_find_the_normal_and_losing_them_moves_nothing():
    mounts = [(0.04, 0.0), (-0.02, 0.035), (-0.02, -0.035)]
    sensors = [{"position_m": [x, y, 0.0]} for x, y in mounts]
    f = surffollow.Follower({"sensors": sensors}, offset_m=0.1)
    ranges = np.array([0.1 - 0.05 * x + 0.03 * y for x, y in mounts])
    before = None
    for k in range(400):
        seen = ranges.copy()
        if k >= 250:
            seen[2] = math.nan
        if k >= 320:
            seen[0] = math.nan
        if k == 100:
            seen[1] += 0.02  # one glitch of one beam
        f.pose(T0 + 4 * k * MS, at(0.0, 0.2))
        demand = f.step(T0 + 4 * k * MS, seen)
        if before is not None and k > 50:
            assert np.abs(demand - before).max() < 1e-3, f"jump at {k}"
        before = demand
    normal = np.array(f.state()["normal"])
    expected = np.array([-0.05, 0.03, 1.0])
    assert normal == pytest.approx(expected / np.linalg.norm(expected), abs=1e-3)
    assert demand[3:] == pytest.approx([-0.03, -0.05, 0.0], abs=2e-3)


def test_paper_mode_forecasts_the_range_by_its_slope():
    f = surffollow.Follower({"mode": "paper"}, offset_m=0.1)
    assert math.isnan(f.forecast_range_m(0.1))
    f.set_params(ee_readings=1, permitted_variance="0 m")
    travel(f, lambda x: 0.1 * x, seconds=2.0)
    now = f.forecast_range_m(0.0)
    assert f.forecast_range_m(1.0) - now == pytest.approx(-0.01, rel=0.1)


def test_the_adaptive_forecast_follows_a_moving_range_and_passes_over_a_spike():
    f = surffollow.Follower({"range_max_m": 10.0}, offset_m=1.0)
    for k in range(300):
        t = T0 + 100 * k * MS
        f.pose(t, at(0.0, 5.0))
        f.step(t, [2.0 + 0.02 * 0.1 * k + (3.0 if k == 290 else 0.0)])
    # the trend decays: of the 20 mm over the horizon half may be missing
    assert f.forecast_range_m(1.0) == pytest.approx(2.0 + 0.02 * 0.1 * 299 + 0.02, abs=1e-2)


def test_one_pose_stamped_far_ahead_does_not_lock_the_follower():
    f = surffollow.Follower(offset_m=0.1)
    level = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0)
    f.step(10**9, [0.1])
    assert f.pose(2**61, level)
    assert f.pose(10**9 + 10**7, level)
    assert not f.pose(10**9, level)
    for k in range(10):
        t = 10**9 + (k + 2) * 10**7
        f.pose(t, level)
        f.step(t, [0.1])
    assert f.state()["status"] == ["VALID"]


def test_readings_that_come_later_than_the_pose_timeout_are_used():
    f = surffollow.Follower(offset_m=0.1)
    rng = np.random.default_rng(0)
    for ms in range(3000):
        if ms % 10 == 0:
            f.pose(T0 + (ms - 10) * MS, at(1e-4 * (ms - 10), 0.12))
        if ms % 4 == 0 and ms > 320:
            f.step(T0 + (ms - 300) * MS, [0.12 + 1e-4 * rng.standard_normal()])
        if ms % 10 == 0:
            demand = f.step(T0 + ms * MS, [math.nan])
    assert f.state()["status"] == ["VALID"]
    assert demand[2] == pytest.approx(-0.02, abs=5e-4)


@pytest.mark.parametrize(("config", "expected"), [({}, 0.0), ({"pose_interpolate": "interpolated"}, 0.005)])
def test_paper_mode_takes_the_latest_pose_unless_it_is_configured_to_interpolate(config, expected):
    f = surffollow.Follower({"mode": "paper", "permitted_variance": "0 m", **config}, offset_m=0.1)
    f.pose(T0, at(0.0, 0.2))
    f.pose(T0 + 10 * MS, at(0.0, 0.21))
    # read half way between the two poses: interpolation knows that the tool has risen by 5 mm since
    assert f.step(T0 + 5 * MS, [0.1])[2] == pytest.approx(-expected)


@pytest.mark.parametrize("mode", ["paper", "adaptive"])
def test_sensor_readings_averages_so_many_ranges_and_no_reading_between_them_matters(mode):
    f = surffollow.Follower({"mode": mode, "sensor_readings": 3}, offset_m=0.1)
    f.pose(T0, at(0.0, 0.2))
    ranges = [0.110, math.nan, 0.111, 0.115, 0.118]
    reported = []
    for k, r in enumerate(ranges):
        f.step(T0 + k * MS, [r])
        reported.append(f.state()["range_m"][0])
    # the adaptive mode begins with means of fewer
    paper = mode == "paper"
    assert reported[:3] == pytest.approx(
        [math.nan if paper else 0.11, math.nan, math.nan if paper else 0.1105], nan_ok=True
    )
    assert reported[3:] == pytest.approx([0.112, (0.111 + 0.115 + 0.118) / 3])
    f.step(T0 + 5 * MS, [9.0])
    f.step(T0 + 6 * MS, [0.118])
    found = f.state()["range_m"][0]
    assert math.isnan(found) if paper else found == 0.118, "a mean does not span a loss"


def test_without_sensor_readings_every_range_is_a_reading():
    f = surffollow.Follower({"mode": "paper"}, offset_m=0.1)
    f.pose(T0, at(0.0, 0.2))
    f.step(T0, [0.11])
    assert f.state()["range_m"] == [0.11]
