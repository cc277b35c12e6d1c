"""Limits of the demand, stale poses, the fold-back, and values that are not finite."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from forecast.driving import MS, Kernel, names_of
from forecast.driving import default_params as conversion_params
from surffollow.forecast.fold_back import limit

T = 10_000 * MS
LEVEL = (0.0, 0.0, 0.0, 1.0)


def default_params(**changes):
    """Parameters for ready-made ranges, one to a reading."""
    return conversion_params(**({"sensor_readings": 1} | changes))


def pose(z, x=0.0):
    return (x, 0.0, z, *LEVEL)


def follow(kernel, t_ns, range_m, z=0.2, x=0.0):
    return kernel.step(t_ns, [(t_ns, pose(z, x))], ranges=[range_m], given_t_ns=t_ns)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 0.0, 0.01, -3.0, 1e308, -0.05])
@pytest.mark.parametrize("most", [0.0, 0.05, 1e3])
def test_limit_never_lets_more_through(value, most):
    assert abs(limit(value, most)) <= most


def test_without_any_pose_there_is_no_demand():
    o = Kernel(default_params()).step(T, ranges=[0.12], given_t_ns=T)
    assert names_of(o["status"]) == {"NO_POSE"}
    assert not o["demand"].any()
    assert int(o["fresh"]) == 0


def test_a_pose_older_than_its_timeout_gives_zero_and_no_sample_for_the_map():
    k = Kernel(default_params())
    assert follow(k, T, 0.12)["demand"][2] != 0.0
    o = k.step(T + 100 * MS, ranges=[0.12], given_t_ns=T)
    assert "VALID" in names_of(o["status"])
    o = k.step(T + 100 * MS + 1, ranges=[0.12], given_t_ns=T)
    assert names_of(o["status"]) == {"POSE_STALE"}
    assert o["demand"][2] == 0.0
    assert int(o["fresh"]) == 0
    assert "VALID" in names_of(follow(k, T + 200 * MS, 0.12)["status"])


def test_a_pose_from_the_future_is_as_stale_as_an_old_one():
    k = Kernel(default_params())
    o = k.step(T, [(T + 100 * MS, pose(0.2))], ranges=[0.12], given_t_ns=T)
    assert "VALID" in names_of(o["status"])
    k = Kernel(default_params())
    o = k.step(T, [(T + 100 * MS + 1, pose(0.2))], ranges=[0.12], given_t_ns=T)
    assert names_of(o["status"]) == {"POSE_STALE"}
    assert not o["demand"].any()
    assert int(o["fresh"]) == 0


def test_a_lost_sensor_is_extrapolated_for_loss_timeout_and_then_gives_zero():
    k = Kernel(default_params(loss_timeout_ns=500 * MS))
    follow(k, T, 0.12)
    for after in range(50, 501, 50):
        o = follow(k, T + after * MS, math.nan)
        assert names_of(o["status"]) == {"VALID", "NO_SENSOR"}, after
    o = follow(k, T + 501 * MS, math.nan)
    assert names_of(o["status"]) == {"NO_SENSOR", "SENSOR_LOST"}
    assert o["demand"][2] == 0.0


def test_nothing_is_demanded_before_the_first_reading():
    o = follow(Kernel(default_params()), T, math.nan)
    assert names_of(o["status"]) == {"NO_SENSOR", "SENSOR_LOST"}
    assert o["demand"][2] == 0.0


@pytest.mark.parametrize("range_m", [0.051, 0.15])
def test_the_demand_stays_within_max_demand_and_says_so(range_m):
    k = Kernel(default_params(max_demand_m=0.01))
    o = follow(k, T, range_m)
    assert abs(o["demand"][2]) == 0.01
    assert "LIMITED" in names_of(o["status"])


def test_lowering_max_demand_holds_at_once_whatever_was_relayed_before():
    k = Kernel(default_params(permitted_variance_m=0.02))
    assert follow(k, T, 0.14)["demand"][2] == pytest.approx(-0.04)
    k.params[0]["max_demand_m"] = 0.03
    assert abs(follow(k, T + MS, 0.14)["demand"][2]) <= 0.03


def test_near_the_fold_back_only_demands_away_leave_until_the_branch_is_proven():
    k = Kernel(default_params(offset_m=0.06, permitted_variance_m=0.0))
    near = float(k.params[0]["too_close_m"]) - 1e-4
    assert "TOO_CLOSE" not in names_of(follow(k, T, 0.07, z=0.2)["status"])
    o = follow(k, T + MS, near, z=0.2)
    assert "TOO_CLOSE" in names_of(o["status"])
    assert o["demand"][2] >= 0.001
    # folded back: nearer reads farther, so moving down lets the reading grow
    o = follow(k, T + 2 * MS, near + 0.01, z=0.19)
    assert "TOO_CLOSE" in names_of(o["status"])
    assert o["demand"][2] >= 0.001
    # the true branch, but not yet far enough
    o = follow(k, T + 3 * MS, near + 0.003, z=0.183)
    o = follow(k, T + 4 * MS, near + 0.0035, z=0.186)
    assert "TOO_CLOSE" in names_of(o["status"])
    # the true branch, far enough
    o = follow(k, T + 5 * MS, near + 0.02, z=0.2025)
    assert "TOO_CLOSE" not in names_of(o["status"])


def test_too_close_survives_a_reset_and_a_lost_sensor():
    k = Kernel(default_params())
    near = float(k.params[0]["too_close_m"]) - 1e-4
    follow(k, T, near)
    k.reset(0.1)
    assert "TOO_CLOSE" in names_of(follow(k, T + MS, 0.1)["status"])
    o = follow(k, T + 2 * MS, math.nan)
    assert "TOO_CLOSE" in names_of(o["status"])
    assert o["demand"][2] >= 0.001


@pytest.mark.parametrize("mode", [0, 1], ids=["paper", "adaptive"])
def test_too_close_is_reported_while_no_demand_is_valid_for_want_of_readings(mode):
    k = Kernel(default_params(mode=mode, loss_timeout_ns=200 * MS))
    near = float(k.params[0]["too_close_m"]) - 1e-4
    for n in range(200):
        o = follow(k, T + 4 * n * MS, 0.1 if n < 50 else near if n < 60 else math.nan)
    assert names_of(o["status"]) == {"NO_SENSOR", "SENSOR_LOST", "TOO_CLOSE"}
    assert not o["demand"].any()


@pytest.mark.parametrize(("run", "name"), [(1, "DRYRUN"), (2, "FROZEN")])
def test_dryrun_and_freeze_are_never_valid(run, name):
    k = Kernel(default_params(run=run))
    o = follow(k, T, 0.12)
    assert name in names_of(o["status"])
    assert "VALID" not in names_of(o["status"])
    assert (o["demand"][2] == 0.0) == (run == 2)


wild = st.one_of(st.floats(), st.sampled_from([math.nan, math.inf, -math.inf, 0.1, 0.12, 0.054, 1e308]))
ticks = st.one_of(st.integers(0, 50 * MS), st.integers(-(2**62), 2**62))
coordinate = st.floats(-1e6, 1e6)
pieces = st.tuples(
    ticks,
    st.lists(st.tuples(ticks, coordinate, coordinate, coordinate), max_size=4),
    st.one_of(
        st.lists(wild, min_size=1, max_size=8),
        st.lists(
            st.tuples(
                st.integers(-(2**31), 2**31 - 1),
                st.integers(0, 7),
                st.integers(0, 31),
                st.integers(-(2**23), 2**23 - 1),
            ),
            max_size=64,
        ),
    ),
)


@settings(max_examples=150, deadline=None)
@given(st.lists(pieces, min_size=1, max_size=25), st.integers(1, 8), st.booleans(), st.floats(0.0, 0.1))
def test_no_input_puts_a_nan_into_the_output_or_a_demand_beyond_its_limit(stream, n, interpolate, most):
    k = Kernel(
        default_params(n_channels=n, pose_interpolate=int(interpolate), max_demand_m=most, sensor_readings=1)
    )
    t_ns = T
    for tick, reports, data in stream:
        t_ns = (t_ns + tick + 2**63) % 2**64 - 2**63  # absurd steps wrap around as the machine's do
        poses = [((t_ns + d + 2**63) % 2**64 - 2**63, (x, y, z, *LEVEL)) for d, x, y, z in reports]
        if data and isinstance(data[0], tuple):
            o = k.step(t_ns, poses, conversions=data)
        else:
            o = k.step(t_ns, poses, ranges=data or [math.nan], given_t_ns=t_ns)
        assert np.isfinite(o["demand"]).all()
        assert abs(o["demand"][2]) <= most
        for name in ("target_m", "height_m", "slope", "speed_mps", "delta_h_m", "error_m"):
            assert np.isfinite(o[name]).all(), name
        if "TOO_CLOSE" in names_of(o["status"]) and "SENSOR_LOST" not in names_of(o["status"]):
            assert o["demand"][2] >= min(0.001, most)


@pytest.mark.parametrize("tau_s", [0.04, 0.1])
def test_another_reference_of_a_ring_does_not_release_the_latch(tau_s):
    """GIVEN a ring that is tilted WHEN its nearest beam falls below the window THEN TOO_CLOSE stays at rest.

    The next beam is mounted higher and reads more, as if the tool had risen: the latch was released at rest.
    By that beam it is released when the tool rises. With the greater τ the follower has another time scale.
    """
    k = Kernel(default_params(mode=1, orient=1, n_channels=3, plant_tau_s=tau_s))
    mounts, rng, tilt = k.params[0]["tool_from_sensor"].reshape(8, 7), np.random.default_rng(0), 0.2
    for c in range(3):
        mounts[c, :2] = 0.03 * math.cos(2.0 * math.pi * c / 3), 0.03 * math.sin(2.0 * math.pi * c / 3)
    closed = []
    for n in range(600):
        t, z = T + 4 * MS * n, 0.075 if n < 100 else max(0.075 - 0.0004 * (n - 100), 0.059)
        z += 0.0004 * min(max(n - 330, 0), 150)
        q = (0.0, math.sin(tilt / 2), 0.0, math.cos(tilt / 2))
        ranges = (z - mounts[:3, 0] * math.sin(tilt)) / math.cos(tilt) + 1e-4 * rng.standard_normal(3)
        if n >= 200:
            ranges[0] = 0.04  # nearer than its near limit
        o = k.step(t, [(t - 1000, (0.0, 0.0, z, *q))] if n % 2 == 0 else [], ranges=ranges, given_t_ns=t)
        closed.append("TOO_CLOSE" in names_of(o["status"]))
    assert closed[199]
    assert all(closed[200:330])
    assert not closed[-1]
