"""Input of the follower in process: odd poses, ranges and configurations are refused, and change nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import surffollow
from follower_poses import MS, T0, at
from surffollow.errors import ConfigError, InputFileError, PoseError, UsageError


def test_poses_that_are_not_newer_are_refused_and_counted():
    f = surffollow.Follower(offset_m=0.1)
    assert f.pose(T0, at(0.0, 0.1))
    assert not f.pose(T0, at(0.0, 0.1))
    assert not f.pose(T0 - MS, at(0.0, 0.1))
    assert f.state()["poses_refused"] == 2


@pytest.mark.parametrize(
    "pose", [(1.0,) * 6, (math.nan,) * 7, (0, 0, 0, 0, 0, 0, 1.01), (0, math.inf, 0, 0, 0, 0, 1), "pose"]
)
def test_a_pose_that_cannot_be_one_is_an_error(pose):
    with pytest.raises(PoseError):
        surffollow.Follower().pose(T0, pose)


@pytest.mark.parametrize(("sensors", "count"), [(1, 0), (1, 2), (1, 9), (3, 0), (3, 2), (3, 4)])
def test_step_takes_one_range_per_sensor(sensors, count):
    f = surffollow.Follower({"sensors": [{}] * sensors})
    with pytest.raises(
        UsageError, match=f"{sensors} range.*one per sensor of the configuration, not {count}"
    ):
        f.step(T0, [0.1] * count)


def test_one_range_is_not_enough_for_three_sensors_but_no_reading_is():
    f = surffollow.Follower({"sensors": [{}] * 3})
    for none in ([math.nan], [None], np.full(1, math.nan)):
        f.step(T0, none)
    with pytest.raises(UsageError, match="one per sensor"):
        f.step(T0, [0.1])


def test_none_is_no_reading():
    f = surffollow.Follower({"sensors": [{}] * 2}, offset_m=0.1)
    f.step(T0, [None, 0.1])
    assert math.isnan(f.state()["range_m"][0])
    assert f.state()["range_m"][1] == pytest.approx(0.1)


@pytest.mark.parametrize(
    "t_ns", [1.0, 1.5, 1e9, np.float64(1e9), math.nan, math.inf, "1", None, 1j, True, np.True_]
)
def test_a_time_that_is_no_whole_number_is_refused_and_the_unit_is_named(t_ns):
    f = surffollow.Follower()
    for error, call in (
        (PoseError, lambda: f.pose(t_ns, at(0.0, 0.1))),
        (UsageError, lambda: f.step(t_ns, [0.1])),
    ):
        with pytest.raises(error, match="t_ns must be a whole number of ns"):
            call()


@pytest.mark.parametrize("kind", [np.int64, np.uint64, np.int32])
def test_times_may_be_whole_numbers_of_numpy(kind):
    f = surffollow.Follower()
    assert f.pose(kind(10**9), at(0.0, 0.1))
    f.step(kind(10**9), [0.1])
    assert f.state()["pose_t_ns"] == 10**9


def test_poses_with_times_in_ms_are_refused_after_a_while():
    f = surffollow.Follower(offset_m=0.1)
    for k in range(100):
        f.pose(4 * k, at(0.0, 0.1))
    with pytest.raises(PoseError, match=r"times are in ns.* this one after 4 ns"):
        f.pose(400, at(0.0, 0.1))


def test_poses_as_often_as_any_sensor_measures_are_taken():
    f = surffollow.Follower(offset_m=0.1)
    assert all(f.pose(T0 + k * 2_500, at(0.0, 0.1)) for k in range(1000))


@pytest.mark.parametrize(
    "config",
    [
        {"no_such_thing": 1},
        {"offset": "5 kg"},
        {"offset_m": -1.0},
        {"mode": "clever"},
        {"sensors": []},
        {"sensors": [{"position_m": [0, 0]}]},
        {"sensors": [{"orientation": [0, 0, 0, 2]}]},
        {"sensors": [{"colour": "red"}]},
        {"plant": {"mass": 3}},
        {"memory": "much"},
    ],
)
def test_a_wrong_configuration_is_named(config):
    with pytest.raises(ConfigError):
        surffollow.Follower(config)


def test_a_configuration_that_is_not_there_is_named():
    with pytest.raises(InputFileError, match=r"cannot read configuration /no/such/file\.toml"):
        surffollow.Follower("/no/such/file.toml")


@pytest.mark.parametrize(("key", "meant"), [("sensor", "sensors"), ("plants", "plant"), ("memry", "memory")])
def test_a_mistyped_table_of_the_configuration_brings_its_name(key, meant):
    with pytest.raises(ConfigError, match=f"unknown parameter '{key}'; did you mean {meant}"):
        surffollow.Follower({key: 1})
    with pytest.raises(ConfigError, match="known: sensors, plant, memory, mode"):
        surffollow.Follower({"qqqq": 1})


def test_a_refused_change_of_parameters_changes_nothing():
    f = surffollow.Follower(offset_m=0.1)
    with pytest.raises(ConfigError):
        f.set_params(offset="0.12 m", max_demand="-1 m")
    assert f.state()["offset_m"] == 0.1


numbers = st.one_of(st.floats(), st.floats(0.0, 0.3), st.sampled_from([math.nan, math.inf, 0.0]))


moves = st.tuples(
    st.sampled_from(["pose", "step", "late"]),
    st.integers(0, 200),
    st.floats(-1e3, 1e3),
    st.floats(-10.0, 10.0),
    st.lists(numbers, min_size=1, max_size=8),
)


@settings(max_examples=150, deadline=None)
@given(st.sampled_from([1, 3, 8]), st.floats(1e-4, 0.2), st.lists(moves, max_size=60))
def test_no_input_makes_a_demand_that_is_not_finite_or_beyond_its_limits(n, most, calls):
    sensors = [{"position_m": [0.03 * math.cos(k), 0.03 * math.sin(k), 0.0]} for k in range(n)]
    f = surffollow.Follower({"sensors": sensors, "max_demand_m": most, "memory": False}, offset_m=0.1)
    t = T0
    for what, ms, x, z, numbers in calls:
        ranges = (numbers * n)[:n]
        t += ms * MS // 10
        if what == "pose":
            f.pose(t, at(x, z, 0.3 * x))
            continue
        demand = f.step(t - 30 * MS if what == "late" else t, ranges)
        assert np.isfinite(demand).all()
        assert abs(demand[2]) <= most
        assert np.linalg.norm(demand[3:]) <= 0.35 + 1e-12
        reported = f.state()
        assert all(math.isfinite(reported[k]) for k in ("height_m", "slope", "sigma_m", "noise_m", "tau_s"))


@pytest.mark.parametrize(
    "pose",
    [
        0.5,
        [0.5],
        "0000001",
        [[0, 0, 0, 0, 0, 0, 1]],
        [1e154, 0, 0, 0, 0, 0, 1],
        [0, 0, 0, 0, 0, 0, 1j],
        [True] * 7,
    ],
)
def test_what_is_no_pose_is_refused(pose):
    with pytest.raises(PoseError):
        surffollow.Follower().pose(1, pose)


@pytest.mark.parametrize("ranges", [None, 0.1, ["0.1"], "1", [[0.1]], [], [0.1] * 9, [1j]])
def test_what_is_no_range_is_refused(ranges):
    with pytest.raises(UsageError):
        surffollow.Follower().step(1, ranges)


@pytest.mark.parametrize(
    "config",
    [
        5,
        b"x",
        {1: 2},
        {"range_min_m": 1, "range_max_m": 0.5},
        {"sensors": [{"near_m": 0.2, "far_m": 0.1}]},
        {"sensors": [{"position_m": [1e300, 0, 0]}]},
        {"follow": {"offset": 0.1}, "sensors": [{}]},
        {"loss_timeout": 2},
        {"sensor_latency": 0.03},
        {"too_close_exit": "0.16 m"},
        {"too_close": "0.06 m"},
        {"too_close": "0.04 m"},
    ],
)
def test_contradictory_or_odd_configurations_are_refused(config):
    with pytest.raises(ConfigError):
        surffollow.Follower(config)


def test_live_parameters_are_checked_together():
    f = surffollow.Follower()
    with pytest.raises(ConfigError):
        f.set_params(range_min="1 m", range_max="1 mm")
    with pytest.raises(ConfigError, match="twice"):
        f.set_params(offset=0.1, offset_m=0.2)


@pytest.mark.parametrize(
    ("config", "names"),
    [
        ({"offset": 0.1, "offset_m": 0.1}, ("offset", "offset_m")),
        ({"plant_tau_s": 0.04, "plant": {"tau_s": 0.2}}, ("plant_tau_s", "plant.tau_s")),
        ({"plant_v_max": 0.1, "plant": {"v_max_mps": 0.2}}, ("plant_v_max", "plant.v_max_mps")),
        ({"range_min": 0.05, "sensors": [{"near_m": 0.05}]}, ("range_min", "sensors[0].near_m")),
        ({"range_max_m": 0.2, "sensors": [{}, {"far_m": 0.2}]}, ("range_max_m", "sensors[1].far_m")),
        ({"score_way": 0.25, "score_travel": 0.25}, ("score_way", "score_travel")),
    ],
)
@pytest.mark.parametrize("offset_m", [None, 0.1])
def test_a_value_that_is_given_in_two_ways_is_refused_and_both_are_named(config, names, offset_m):
    with pytest.raises(ConfigError, match="given twice") as e:
        surffollow.Follower(config, offset_m=offset_m)
    for name in names:
        assert name in str(e.value)


@pytest.mark.parametrize("mode", ["paper", "adaptive"])
def test_too_close_follows_from_a_window_given_either_way(mode):
    by_name = surffollow.Follower({"mode": mode, "range_min": "60 mm"}, offset_m=0.1)
    by_sensor = surffollow.Follower({"mode": mode, "sensors": [{"near_m": 0.06}]}, offset_m=0.1)
    for f in (by_name, by_sensor):
        f.pose(T0, at(0.0, 0.1))
        for k in range(60):
            f.pose(T0 + k * MS, at(0.0, 0.1))
            f.step(T0 + k * MS, [0.061])  # 55 mm, the default threshold, no reading can have
        assert "TOO_CLOSE" in f.state()["status"]


def test_sensors_with_different_windows_are_refused():
    windows = [{"near_m": 0.05, "far_m": 0.15}, {"near_m": 0.05, "far_m": 0.3}]
    with pytest.raises(ConfigError, match=r"sensors\[0\].far_m is 0.15 m and sensors\[1\].far_m 0.3 m"):
        surffollow.Follower({"sensors": windows})
    surffollow.Follower({"sensors": [{"near_m": 0.05, "far_m": "0.15 m"}, {"far_m": 0.15}, {}]})


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"loss_timeout": 2}, "has no unit"),
        ({"too_close_exit": 0.1524}, "not below range_max_m"),
        ({"range_max": "0.11 m", "too_close_exit": "0.12 m"}, "not below range_max_m"),
        ({"too_close": "60 mm"}, "above too_close_exit_m"),
        ({"range_min": "60 mm"}, "too_close_m 0.05461 m is below range_min_m"),
        ({"offset": "54 mm"}, "not below offset_m"),
    ],
)
def test_a_live_change_at_odds_with_the_window_is_refused_and_changes_nothing(change, says):
    f = surffollow.Follower()
    before = f._params.copy()
    with pytest.raises(ConfigError, match=says):
        f.set_params(**change)
    assert f._params.tobytes() == before.tobytes()
    f.set_params(range_min="60 mm", too_close="63 mm", too_close_exit="66 mm")


@pytest.mark.parametrize("horizon", ["a", None, "0.1", math.nan, math.inf, [0.1], 1j])
def test_a_forecast_over_no_time_is_refused(horizon):
    with pytest.raises(UsageError, match=r"horizon_s is .*; it must be (a number|finite)"):
        surffollow.Follower().forecast_range_m(horizon)


def _with_reading(f, t_ns, k):
    """One period of a tool that moves over level ground: a pose and a reading that changed."""
    f.pose(t_ns, at(1e-4 * k, 0.1))
    return f.step(t_ns, [0.1 + 1e-5 * (k % 7)])


@pytest.mark.parametrize("mode", ["adaptive", "paper"])
def test_a_pose_that_changes_while_its_time_stands_still_is_an_error_after_a_while(mode):
    """GIVEN a clock that stops WHEN robot and sensor go on THEN no demand stays valid for good."""
    f = surffollow.Follower({"mode": mode}, offset_m=0.1)
    for k in range(200):
        _with_reading(f, T0 + k * 5 * MS, k)
    stopped_ns = T0 + 199 * 5 * MS
    for k in range(200, 299):
        _with_reading(f, stopped_ns, k)
    with pytest.raises(PoseError, match=f"all have the time {stopped_ns} ns; the clock stands still.*coarse"):
        f.pose(stopped_ns, at(0.0299, 0.1))
    assert f.pose(stopped_ns + 5 * MS, at(0.03, 0.1)), "a clock that goes on is taken again"


def test_a_clock_of_a_second_is_refused():
    f = surffollow.Follower(offset_m=0.1)

    def follow():
        for k in range(400):
            _with_reading(f, (1 + k // 200) * 10**9, k)

    with pytest.raises(PoseError, match="too coarse"):
        follow()


def test_the_same_pose_may_be_given_again_for_ever():
    """GIVEN a loop at 10 kHz and poses at 20 Hz WHEN each pose is given 500 times THEN that is no error."""
    f = surffollow.Follower(offset_m=0.1)
    for k in range(2000):
        report = k // 500
        f.pose(T0 + report * 50 * MS, at(1e-3 * report, 0.1))
        f.step(T0 + k * MS // 10, [0.1 + 1e-5 * (k % 7)])
    assert "VALID" in f.state()["status"]


def test_poses_that_are_given_again_do_not_hide_a_clock_that_stands_still():
    f = surffollow.Follower(offset_m=0.1)

    def report():
        for k in range(1100):
            f.pose(T0, at(1e-4 * (k // 10), 0.1))

    with pytest.raises(PoseError, match="stands still"):
        report()


def test_readings_that_change_while_all_times_stand_still_are_an_error_after_a_while():
    """GIVEN the last pose again and again WHEN readings go on with its time THEN no demand stays valid."""
    f = surffollow.Follower(offset_m=0.1)
    for k in range(100):
        _with_reading(f, T0 + k * 5 * MS, k)
    stopped_ns = T0 + 99 * 5 * MS

    def go_on():
        for k in range(101):
            f.pose(stopped_ns, at(99e-4, 0.1))
            f.step(stopped_ns, [0.1 + 1e-4 * k])

    with pytest.raises(UsageError, match=f"all have the time {stopped_ns} ns, and no pose is newer"):
        go_on()


def test_readings_whose_time_stands_still_have_no_valid_demand_while_poses_go_on():
    f = surffollow.Follower(offset_m=0.1)
    for k in range(600):
        f.pose(T0 + k * 5 * MS, at(1e-4 * k, 0.1))
        f.step(T0 + min(k, 200) * 5 * MS, [0.1 + 1e-5 * (k % 7)])
    assert "VALID" not in f.state()["status"]
    assert "behind those of poses" in f.state()["reason"]


@pytest.mark.parametrize("alone", [True, False])
def test_the_same_readings_may_be_given_again_for_ever(alone):
    """GIVEN one time WHEN two channels are read by turns, or nothing is THEN that is no error."""
    f = surffollow.Follower({"sensors": [{}, {}]}, offset_m=0.1)
    f.pose(T0, at(0.0, 0.1))
    for k in range(500):
        f.step(T0, [math.nan] if alone else [0.1, None] if k % 2 else [None, 0.1])
