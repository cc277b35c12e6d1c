"""The paper's forecast in examples that a reader can follow by hand (§3.2)."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forecast.driving import MS, Kernel, default_params, names_of
from surffollow.follower.range_forecast import RangeForecast, forecast_range
from surffollow.shm.dtypes import zeros
from surffollow.sim.plant import axis_step

T = 10_000 * MS
# the current interval's mean still lacks its far points: up to half an interval in the mean of a range
# lies behind, which with few intervals per range is this much of the slope
PARTIAL = 0.1
LEVEL = (0.0, 0.0, 0.0, 1.0)


def paper(**changes):
    plain = {
        "offset_m": 0.1,
        "sensor_readings": 1,
        "ee_readings": 1,
        "permitted_variance_m": 0.0,
        "range_size": 3,
    }
    return Kernel(default_params(**(plain | {"interval_size_m": 0.002} | changes)))


def ramp(kernel, slope, speed, cycles, start_ns=T, z=0.15, lost=()):
    """Drive along +x over a ramp at constant height; one output per cycle."""
    out = []
    for k in range(cycles):
        t_ns, x = start_ns + k * MS, speed * k * 1e-3
        reading = math.nan if k in lost else z - slope * x
        o = kernel.step(t_ns, [(t_ns, (x, 0.0, z, *LEVEL))], ranges=[reading], given_t_ns=t_ns)
        out.append(o.copy())
    return out


def test_on_the_level_the_demand_is_desired_minus_actual_offset():
    k = paper(offset_m=0.1)
    o = k.step(T, [(T, (0, 0, 0.3, *LEVEL))], ranges=[0.12], given_t_ns=T)
    assert o["demand"][2] == 0.1 - 0.12
    assert o["error_m"] == 0.1 - 0.12
    assert o["delta_h_m"] == 0.0


def test_a_ramp_adds_slope_times_speed_times_time_since_the_previous_reading():
    k = paper()
    o = ramp(k, slope=0.1, speed=0.1, cycles=400)[-1]
    assert o["slope"] == pytest.approx(0.1, rel=PARTIAL)
    assert o["speed_mps"] == pytest.approx(0.1, rel=1e-6)
    assert o["delta_h_m"] == o["slope"] * o["speed_mps"] * 1e-3
    assert o["demand"][2] == o["delta_h_m"] + o["error_m"]


def test_a_change_is_counted_once_from_the_previous_reading_on():
    k = paper()
    ramp(k, slope=0.1, speed=0.1, cycles=400)
    before = float(k.state[0]["paper"]["reading_m"])
    o = k.step(
        T + 400 * MS, [(T + 400 * MS, (0.04, 0, 0.151, *LEVEL))], ranges=[0.147], given_t_ns=T + 400 * MS
    )
    assert before == pytest.approx(0.15 - 0.1 * 0.0399)
    assert o["error_m"] == pytest.approx(0.1 - (before + 0.001), abs=1e-12), "and the tool rose by 1 mm"
    assert o["delta_h_m"] == o["slope"] * o["speed_mps"] * 1e-3
    assert o["demand"][2] == o["delta_h_m"] + o["error_m"]


def test_the_slope_is_zero_until_two_full_ranges_exist():
    k = paper(range_size=4)
    outs = ramp(k, slope=0.2, speed=0.1, cycles=400)
    for o in outs:
        assert (o["slope"] != 0.0) == (o["intervals"] >= 8)
    assert outs[-1]["intervals"] > 8


def test_during_loss_the_height_is_extrapolated_with_the_last_slope_and_speed_over_the_elapsed_time():
    k = paper()
    outs = ramp(k, slope=0.1, speed=0.1, cycles=700, lost=range(400, 700))
    last = outs[399]
    for n in (400, 450, 699):
        assert outs[n]["slope"] == last["slope"]
        assert outs[n]["delta_h_m"] == pytest.approx(last["slope"] * last["speed_mps"] * (n - 399) * 1e-3)
    assert "NO_SENSOR" in names_of(outs[450]["status"])


def test_during_loss_the_tools_own_motion_counts_against_the_demand():
    k = paper()
    k.step(T, [(T, (0, 0, 0.2, *LEVEL))], ranges=[0.11], given_t_ns=T)
    before = k.step(T + MS, [(T + MS, (0, 0, 0.2, *LEVEL))], ranges=[math.nan]).copy()
    after = k.step(T + 2 * MS, [(T + 2 * MS, (0, 0, 0.19, *LEVEL))], ranges=[math.nan])
    assert before["demand"][2] == pytest.approx(-0.01)
    assert after["demand"][2] == pytest.approx(0.0, abs=1e-15)


def test_after_a_loss_the_way_between_is_interpolated_linearly_in_position_and_height():
    k = paper(range_size=5)
    outs = ramp(k, slope=0.1, speed=0.1, cycles=501, lost=range(100, 500))
    assert outs[500]["intervals"] - outs[499]["intervals"] >= 19
    assert outs[500]["slope"] == pytest.approx(0.1, rel=0.02)


def relayed_after(kernel, range_m, t_ns, z=0.3):
    """The demand of the cycle after a reading: the paper's counts from the reading before."""
    pose = (0, 0, z, *LEVEL)
    kernel.step(t_ns, [(t_ns, pose)], ranges=[range_m], given_t_ns=t_ns)
    return float(kernel.step(t_ns + MS, [(t_ns + MS, pose)], ranges=[math.nan])["demand"][2])


def test_hysteresis_keeps_the_relayed_demand_until_it_changes_by_more_than_permitted_variance():
    k = paper(permitted_variance_m=0.001)
    readings = (0.12, 0.1209, 0.1211, 0.1202, 0.1200, 0.1221)
    relayed = [relayed_after(k, r, T + 2 * n * MS) for n, r in enumerate(readings)]
    first, second = 0.1 - 0.12, 0.1 - 0.1211
    assert relayed == [first, first, second, second, 0.1 - 0.1200, 0.1 - 0.1221]


def test_a_change_of_exactly_permitted_variance_is_not_relayed():
    k = paper(permitted_variance_m=0.25, max_demand_m=1.0, range_max_m=2.0, offset_m=0.5)
    for n, (r, expected) in enumerate([(0.5, 0.0), (0.75, 0.0), (0.7500001, 0.5 - 0.7500001)]):
        assert relayed_after(k, r, T + 2 * n * MS, z=0.9) == expected


def test_while_nothing_new_is_relayed_the_tools_own_motion_counts_against_the_demand():
    k = paper(permitted_variance_m=0.001)
    assert relayed_after(k, 0.12, T) == pytest.approx(-0.02)
    # 15 mm of the 20 are done: what remains is demanded, not the 20 mm again
    assert relayed_after(k, 0.1055, T + 2 * MS, z=0.285) == pytest.approx(-0.005)


@pytest.mark.parametrize("permitted_mm", [0.0, 0.1, 1.0, 3.0])
def test_a_still_tool_that_heeds_the_demands_comes_to_rest_within_permitted_variance(permitted_mm):
    k = paper(permitted_variance_m=1e-3 * permitted_mm)
    axis, target = np.array([0.109, 0.0]), 0.109
    heights = []
    for n in range(3000):
        t_ns = T + n * MS
        axis_step(axis, target, 0.04, 0.2, 2.0, 1e-3)
        poses = [(t_ns, (0.0, 0.0, axis[0], *LEVEL))] if n % 10 == 0 else []
        o = k.step(t_ns, poses, ranges=[axis[0]], given_t_ns=t_ns)
        if poses:
            target = axis[0] + float(o["demand"][2])
        heights.append(axis[0] - 0.1)
    rest = np.array(heights[2000:])
    assert np.ptp(rest) < 1e-6, f"it moves by {np.ptp(rest) * 1e3:.3f} mm"
    assert abs(rest[-1]) <= 1e-3 * permitted_mm + 1e-6


def test_ee_averaging_delays_a_step_of_the_tool_by_about_half_its_window():
    k = paper(ee_readings=8, interval_size_m=100.0)
    targets = []
    for n in range(40):
        t_ns, x = T + n * MS, 0.0 if n < 10 else 1.0
        o = k.step(t_ns, [(t_ns, (x, 0, 0.3, *LEVEL))], ranges=[0.1], given_t_ns=t_ns)
        targets.append(float(o["target_m"][0]))
    assert targets[9] == 0.0
    assert [round(v, 12) for v in targets[10:18]] == [n / 8 for n in range(1, 9)]
    assert targets[18:] == [1.0] * 22


def test_paper_mode_uses_the_latest_pose_and_interpolation_that_of_the_samples_time():
    for interpolate, expected in ((0, 1.0), (1, 0.25)):
        k = paper(pose_interpolate=interpolate)
        k.step(T, [(T, (0, 0, 0.3, *LEVEL))], ranges=[math.nan], given_t_ns=T)
        o = k.step(T + 8 * MS, [(T + 8 * MS, (1, 0, 0.3, *LEVEL))], ranges=[0.1], given_t_ns=T + 2 * MS)
        assert o["target_m"][0] == expected


def test_reset_leaves_a_follower_that_cannot_be_distinguished_from_one_that_just_began():
    rng = np.random.default_rng(5)
    used, fresh = paper(range_size=2, ee_readings=4), paper(range_size=2, ee_readings=4)
    ramp(used, slope=0.15, speed=0.4, cycles=900)
    used.reset(0.11)
    fresh.reset(0.11)
    begin = T + 5_000 * MS
    for n in range(600):
        t_ns, x = begin + n * MS, 0.0001 * n
        pose, r = [(t_ns, (x, 0.0, 0.2, *LEVEL))], [0.1 + rng.normal(0.0, 5e-4)]
        a = used.step(t_ns, pose, ranges=r, given_t_ns=t_ns).copy()
        b = fresh.step(t_ns, pose, ranges=r, given_t_ns=t_ns)
        for name in a.dtype.names:
            if name != "cycle":
                assert np.array_equal(a[name], b[name], equal_nan=True), f"{name} in cycle {n}"


def test_reset_keeps_what_was_measured_and_sets_the_offset():
    k = paper()
    ramp(k, slope=0.0, speed=0.05, cycles=50)
    sense = k.state[0]["sense"].copy()
    k.reset(0.13)
    assert k.params[0]["offset_m"] == 0.13
    assert k.state[0]["sense"] == sense


def test_changing_range_size_while_running_recuts_the_ranges_at_once():
    k = paper(range_size=3)
    ramp(k, slope=0.1, speed=0.1, cycles=500)
    for size in (6, 2, 4):
        k.params[0]["range_size"] = size
        t_ns = T + 500 * MS + size
        o = k.step(t_ns, ranges=[0.1451], given_t_ns=t_ns)
        assert o["slope"] == pytest.approx(0.1, rel=2 * PARTIAL), f"Range_Size {size}"


def test_the_range_forecast_carries_the_two_range_slope_on():
    k, unused = paper(), zeros(RangeForecast)
    assert math.isnan(forecast_range(k.params, k.state, unused, 0.5))
    o = ramp(k, slope=0.1, speed=0.1, cycles=400)[-1]
    got = forecast_range(k.params, k.state, unused, 0.5)
    assert got == o["range_m"][0] - o["slope"] * o["speed_mps"] * 0.5


def test_in_a_turn_back_the_slope_is_never_steeper_than_the_ground():
    k = paper()
    slopes = []
    for n in range(1200):
        t_ns, x = T + n * MS, 1e-4 * (n if n < 600 else 1200 - n)
        o = k.step(t_ns, [(t_ns, (x, 0.0, 0.15, *LEVEL))], ranges=[0.15 - 0.1 * x], given_t_ns=t_ns)
        slopes.append(float(o["slope"]))
    assert max(map(abs, slopes)) <= 0.1 * (1 + PARTIAL)
    assert slopes[590] == pytest.approx(0.1, rel=2 * PARTIAL)
    assert slopes[-1] == pytest.approx(-0.1, rel=2 * PARTIAL)
