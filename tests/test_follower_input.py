"""Input of the follower in process: odd poses, ranges and configurations are refused, and change nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import surffollow
from follower_poses import MS, T0, at
from surffollow.errors import ConfigError, PoseError, UsageError


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


def test_step_takes_one_to_eight_ranges():
    f = surffollow.Follower()
    for ranges in ([], [0.1] * 9):
        with pytest.raises(UsageError):
            f.step(T0, ranges)


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
        "/no/such/file.toml",
    ],
)
def test_a_wrong_configuration_is_named(config):
    with pytest.raises(ConfigError):
        surffollow.Follower(config)


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
    for what, ms, x, z, ranges in calls:
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
