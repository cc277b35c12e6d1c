"""Stages of the default follower: gate, noise, terrain memory, limits, latency."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow.follower import Follower
from surffollow.forecast.estimation.estimate import update_estimate
from surffollow.forecast.estimation.innovation_gate import register_step
from surffollow.forecast.estimation.model_bank import BANK
from surffollow.forecast.estimation.pending_samples import drop_pending
from surffollow.forecast.pose import push_pose
from surffollow.forecast.sensing.latency_identification import (
    is_late,
    observe_height,
    update_correction,
    update_delay,
)
from surffollow.forecast.sensing.sample_hold import record_sample, reset_hold, resolution_m
from surffollow.forecast.setpoint.setpoint_limits import limit_setpoint
from surffollow.forecast.step import follow_step
from surffollow.forecast.terrain.terrain_buffer import buffered_height, store_ground
from surffollow.forecast.terrain.terrain_memory import new_memory, read_height, store_height
from surffollow.shm.conversion import pack_conversion
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_adaptive_estimation import CURVES, MEMORY_CELLS
from surffollow.shm.layout_follow import RUN_FREEZE, Inputs, SenseState

from .feeding import MS, default_params, feed


def test_single_glitches_never_enter_the_estimate():
    heights = np.zeros(600)
    heights[100::50] = 0.02
    a, taken = feed(heights)
    assert not taken[100::50].any()
    assert taken.sum() == 600 - 10
    assert abs(a["estimate"]["height_m"]) < 2e-4


def test_a_slot_two_millimetres_wide_is_not_chased():
    heights = np.zeros(600)
    for k in range(100, 600, 100):
        heights[k : k + 5] = -0.01
    a, taken = feed(heights, way=0.4e-3)
    assert not taken[heights < 0].any()
    assert a["gate"]["slot_likelihood"] == 1.0


def delays_of_steps(heights, edges):
    """Readings that each step at `edges` waits for before one is taken."""
    _, taken = feed(heights, way=0.4e-3)
    return [int(np.argmax(taken[k:])) for k in edges]


def test_a_step_down_is_confirmed_after_travel_and_later_ones_sooner():
    edges = range(250, 3000, 250)
    delays = delays_of_steps(-0.01 * np.ceil((np.arange(3000) - 249) / 250), edges)
    assert delays[0] == 7  # 2.5 mm after the first sample beyond the edge
    assert 2 <= delays[1] <= 3
    assert max(delays[2:]) <= 2


def test_a_step_up_is_confirmed_by_three_samples_without_travel():
    delays = delays_of_steps(0.01 * np.ceil((np.arange(3000) - 249) / 250), range(250, 3000, 250))
    assert delays[0] == 2
    assert max(delays) <= 2


def test_steps_up_that_stayed_shorten_the_travel_of_the_first_step_down():
    heights = np.zeros(1500)
    heights[300:600], heights[600:900], heights[900:] = 0.01, 0.02, 0.01
    assert delays_of_steps(heights, [900])[0] <= 3


def test_a_step_that_comes_in_pieces_is_no_slot():
    heights = np.zeros(1500)
    for k, edge in enumerate(range(200, 1400, 200)):
        sign = 1.0 if k % 2 == 0 else -1.0
        heights[edge : edge + 10] += sign * 0.001 * np.arange(10)
        heights[edge + 10 :] += sign * 0.01
    a, _ = feed(heights, way=0.1e-3)
    assert a["gate"]["slot_likelihood"] < 0.1
    assert abs(a["estimate"]["height_m"] - heights[-1]) < 1e-3


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_readings_on_an_edge_are_no_burst(sign):
    """GIVEN steps that stay WHEN readings on each edge lie between both heights THEN later ones count sooner.

    No two readings on an edge agree, as in a burst, but none lies beyond the ground behind it. A tool at
    25 mm/s over steps had 1.2 times the error: each of them was the first one again.
    """
    heights = np.zeros(3000)
    for edge in range(250, 3000, 250):
        heights[edge + 4 :] += sign * 0.01
        heights[edge : edge + 4] += sign * 0.002 * np.arange(1, 5)
    a, taken = feed(heights, way=0.1e-3)
    assert a["gate"]["slot_likelihood"] < 0.1
    late = [int(np.argmax(taken[edge:])) for edge in range(1000, 3000, 250)]
    assert max(late) <= 9  # four on the edge and five behind it; a first step down waits for 25


@pytest.mark.parametrize(
    ("least_m", "greatest_m", "likelihood"), [(-0.02, 0.0, 0.05), (-0.02, 0.004, 1.0), (-0.04, 0.0, 1.0)]
)
def test_outliers_beyond_the_heights_beside_a_step_are_a_burst(least_m, greatest_m, likelihood):
    a = zeros(AdaptiveState)[0]
    gate, pending = a["gate"], a["pending"]
    gate["width_m"], gate["slot_likelihood"], gate["step_ns"] = 1e-3, 0.05, 1
    pending["samples"], pending["rejected"], pending["innovation_m"] = 3, 4, 3 * -0.03
    pending["least_m"], pending["greatest_m"] = least_m, greatest_m
    register_step(default_params(), gate, pending, 10**9)
    assert gate["slot_likelihood"] == likelihood
    assert (gate["step_m"] == 0.0) == (likelihood == 1.0)


def test_outliers_of_long_ago_are_forgotten():
    pending = zeros(AdaptiveState)[0]["pending"]
    pending["rejected"], pending["least_m"], pending["greatest_m"] = 2, -0.02, 0.004
    drop_pending(pending)
    assert (pending["least_m"], pending["greatest_m"]) == (-0.02, 0.004)
    drop_pending(pending)
    assert (pending["least_m"], pending["greatest_m"]) == (0.0, 0.0)


def test_after_one_slot_that_was_followed_the_next_one_is_not():
    """GIVEN a step down that stays WHEN a slot is taken for another THEN its end tells of slots."""
    heights, slot = np.zeros(1200), -0.03
    heights[200:] = -0.01  # the likelihood of slots falls: 0.75 mm of travel confirm a fall
    heights[600:618] = heights[900:918] = slot  # 1.8 mm long
    a, taken = feed(heights, way=0.1e-3)
    assert a["gate"]["slot_likelihood"] == 1.0
    assert taken[600:618].any(), "the first one is followed"
    assert not taken[900:918].any()


def test_a_glitch_among_pending_samples_takes_no_travel_from_them():
    """GIVEN a fall that 2.5 mm of travel confirm WHEN one sample on it is wrong THEN no later."""
    heights = np.where(np.arange(300) < 200, 0.0, -0.01)
    glitch = heights.copy()
    glitch[210] = 0.03
    without = np.flatnonzero(feed(heights, way=0.1e-3)[1][200:])
    with_glitch = np.flatnonzero(feed(glitch, way=0.1e-3)[1][200:])
    assert with_glitch[0] == without[0]


def test_the_noise_is_estimated_to_a_tenth_and_soon():
    found = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        a = None
        for k in range(0, 6000, 500):
            heights = 2.5e-4 * rng.standard_normal(500)
            a, _ = feed(heights, sigma=0.0, a=a, start=1 + k)
            found.append((k, float(a["noise"]["sigma_m"])))
    settled = np.array([n for k, n in found if k >= 2000])
    assert np.std(settled) < 0.1 * 2.5e-4
    assert abs(np.mean(settled) - 2.5e-4) < 0.05 * 2.5e-4
    early = np.array([n for k, n in found if k == 0])
    assert (np.abs(early - 2.5e-4) < 0.4 * 2.5e-4).all()


def test_the_slope_stays_when_a_step_is_confirmed():
    x = 1e-3 * np.arange(700)
    model = int(np.flatnonzero((BANK[:CURVES, 0] > 1.0) & (BANK[:CURVES, 1] == 0.05))[0])
    for k in (604, 610, 700):
        a, taken = feed((0.1 * x + 0.03 * (np.arange(700) > 600))[:k])
        assert a["bank"]["slope"][model] == pytest.approx(0.1, abs=0.04)
    assert not taken[601:603].any()
    assert taken[610:].all()


def test_the_slope_along_the_way_is_kept_over_a_rest():
    """GIVEN a slope WHEN the tool rests for 2 s and starts again THEN the models have it at once."""
    model = int(np.flatnonzero((BANK[:CURVES, 0] > 1.0) & (BANK[:CURVES, 1] == 0.05))[0])
    a = zeros(AdaptiveState)[0]
    a["kinematics"]["speed_mps"] = 0.25
    a, _ = feed(0.1e-3 * np.arange(700), sigma=1e-3, a=a)
    before = float(a["estimate"]["slope"])
    assert abs(before) > 0.05
    a["kinematics"]["speed_mps"] = 0.0
    a, _ = feed(np.full(500, 0.07), way=0.0, sigma=1e-3, a=a, start=701)
    assert a["bank"]["slope"][model] == pytest.approx(0.0, abs=0.02)  # the ground does not move
    a["kinematics"]["speed_mps"] = 0.25
    a, _ = feed([0.07], sigma=0.0, a=a, start=1201)
    assert a["bank"]["slope"][model] == pytest.approx(before, abs=0.02)


def test_a_slope_does_not_enter_the_noise():
    x = 1e-3 * np.arange(2000)
    for sigma in (0.1e-3, 0.4e-3):
        a, _ = feed(0.2 * x, sigma=sigma)
        assert a["noise"]["sigma_m"] == pytest.approx(sigma, rel=0.3)


def test_frozen_adaptation_keeps_weights_noise_and_wave_numbers():
    params = default_params()
    a, _ = feed(5e-3 * np.sin(2.0 * np.pi * 1e-3 * np.arange(300) / 0.13))
    numbers = a["bank"]["wave_number"].copy()
    before = a["weights"]["weight"].copy(), float(a["noise"]["sigma_m"]), a["weights"]["recent_m2"].copy()
    rng = np.random.default_rng(1)
    params["run"] = RUN_FREEZE
    for k in range(300, 500):
        update_estimate(params, a, 10**9 + k * 4 * MS + 4 * MS, 1e-3, 1e-3 * rng.standard_normal(), 0.1)
    assert (a["weights"]["weight"] == before[0]).all()
    assert a["noise"]["sigma_m"] == before[1]
    assert (a["weights"]["recent_m2"] == before[2]).all()
    assert (a["bank"]["wave_number"] == numbers).all()


def test_a_setpoint_keeps_its_limits_and_arrives_without_overshoot():
    params = default_params()
    params["max_speed_mps"], params["max_accel_mps2"], params["max_jerk_mps3"] = 0.5, 20.0, 1e9
    for expected, most in ((0.05, 0.5), (-0.05, 0.25)):
        a = zeros(AdaptiveState)[0]
        path = []
        for k in range(600):
            limit_setpoint(params, a, 10**9 + k * MS, expected, 0.0)
            path.append(float(a["setpoint"]["position_m"]))
        path = np.array(path)
        speed = np.diff(path) / 1e-3
        assert np.abs(speed).max() <= most * (1 + 1e-9)
        assert np.abs(np.diff(speed)).max() <= 20.0 * 1e-3 * (1 + 1e-6)
        assert path[-1] == pytest.approx(expected, abs=1e-6)
        assert np.abs(path).max() <= 1.01 * abs(expected)


@pytest.mark.parametrize(("share", "ratio"), [(0.0, 1.0), (0.5, 2.0), (1.0, 3.0)])
def test_a_setpoint_of_a_plan_may_be_three_times_as_quick(share, ratio):
    """A plan is farther ahead of the axis: 2 to 6 times `plant_v_max`, 20 to 60 times `plant_a_max`."""
    params, a = default_params(), zeros(AdaptiveState)[0]
    params["max_speed_mps"] = params["max_accel_mps2"] = params["max_jerk_mps3"] = 1e6
    params["plant_v_max_mps"], params["plant_a_max_mps2"] = 0.2, 2.0
    a["preview"]["share"] = share
    speed, accel = [], []
    for k in range(200):
        limit_setpoint(params, a, 10**9 + k * MS, 10.0, 0.0)
        speed.append(float(a["setpoint"]["velocity_mps"]))
        accel.append(float(a["setpoint"]["acceleration_mps2"]))
    assert max(speed) == pytest.approx(ratio * 0.4, rel=0.02)
    assert max(accel) == pytest.approx(ratio * 40.0, rel=0.02)


def test_the_terrain_buffer_returns_stored_heights_and_nothing_else():
    a = zeros(AdaptiveState)[0]
    for s in np.arange(0.1, 0.3, 0.4e-3):
        store_ground(a, s, 0.2 * s)
    for s in np.arange(0.105, 0.295, 0.0013):
        assert buffered_height(a, s) == pytest.approx(0.2 * s, abs=1e-9)
    assert math.isnan(buffered_height(a, 0.05))
    assert math.isnan(buffered_height(a, 0.32))


def test_the_terrain_memory_averages_a_cell_and_keeps_the_last_pass_apart():
    memory = new_memory()
    second = 10**9
    for t_ns, h in ((1, 1.0), (2, 3.0)):
        store_height(memory, 0.5, -0.25, h, t_ns)
    assert read_height(memory, 0.5, -0.25, 100) == pytest.approx(2.0)
    assert math.isnan(read_height(memory, 0.5, -0.25, 1))
    assert math.isnan(read_height(memory, 0.6, -0.25, 100))
    store_height(memory, 0.5, -0.25, 10.0, 5 * second)
    assert read_height(memory, 0.5, -0.25, 4 * second) == pytest.approx(2.0)


def test_a_full_terrain_memory_replaces_the_oldest_cell():
    memory = new_memory()
    rng = np.random.default_rng(0)
    points = rng.uniform(-3.0, 3.0, (2 * MEMORY_CELLS, 2))
    for k, (x, y) in enumerate(points[: MEMORY_CELLS // 2]):
        store_height(memory, x, y, x + 2 * y, k + 1)
    errors = [read_height(memory, x, y, 10**9) - x - 2 * y for x, y in points[:2000]]
    assert np.nanmax(np.abs(errors)) < 0.02
    for bad in (math.nan, math.inf, 1e300):
        store_height(memory, bad, 0.0, 1.0, 10**9)
        assert math.isnan(read_height(memory, bad, 0.0, 10**9))


def test_conversions_of_a_held_value_are_one_sample_stamped_where_it_began():
    f = Follower({"memory": False, "sensor_latency": "30 ms"}, offset_m=0.1)
    f._params["scale_m"], f._params["zero_m"] = 0.1 / 4096, 0.05
    values = 1990 + 10 * (np.arange(600) % 3)  # each unlike the one before, none an outlier
    i, t0 = f._inputs, 10**12
    for k in range(1000):
        t = t0 + k * MS
        if k % 10 == 0:
            pose = np.array([1e-4 * k, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0])
            push_pose(f._state["sense"][0], t - 10 * MS, pose, 0)
        stamps = range(t - MS + 40_000, t + 1, 40_000)
        i["t_ns"], i["n_ranges"], i["n_conversions"] = t, 0, len(stamps)
        for n, s in enumerate(stamps):
            i["conversion"][0][n] = pack_conversion(int(values[(s - t0 + 4 * MS) // (4 * MS)]), 0, 0, s - t)
        follow_step(f._params, f._state, i, f._output, f._scratch)
    a = f._state["adaptive"][0]
    assert 240 <= a["estimate"]["samples"] <= 252
    # the latency is that of the middle of a held value
    assert (a["estimate"]["sample_ns"] + 30 * MS - int(f._params["hold_ns"][0]) // 2 - t0) % (
        4 * MS
    ) <= 40_000


def over_one_spot(
    truth_s: float, climb, seed: int = 0, sigma: float = 0.25e-3, f: Follower | None = None, steps=range(2500)
) -> Follower:
    """A follower over one spot; `climb(t)` is the height of the tool, ranges are 30 ms + `truth_s` old."""
    rng = np.random.default_rng(seed)
    f = f or Follower({"memory": False}, offset_m=0.1)
    for k in steps:
        t = 0.001 * k
        if k % 10 == 0:
            z = 0.1 + climb(t - 0.01) + 5e-5 * rng.standard_normal()
            f.pose(round((t - 0.01) * 1e9) + 10**10, (0.0, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        if k % 4 == 0:
            r = 0.1 + climb(t - 0.03 - truth_s) + sigma * rng.standard_normal()
            if rng.random() < 0.01:
                r += rng.uniform(-0.03, 0.03)
            f.step(round((t - 0.03) * 1e9) + 10**10, [r])
    return f


@pytest.mark.parametrize("truth_s", [-0.02, 0.0, 0.01, 0.04])
def test_the_latency_is_identified_while_the_tool_climbs_over_one_spot(truth_s):
    f = over_one_spot(truth_s, lambda t: 0.006 * math.sin(2 * math.pi * 1.5 * t))
    assert f.state()["latency_s"] == pytest.approx(truth_s, abs=2e-3)  # none is configured


def bobbing_m(t: float) -> float:
    return 0.006 * math.sin(2 * math.pi * 1.5 * t)


def test_a_configured_latency_discards_the_correction():
    f = over_one_spot(0.02, bobbing_m)
    assert f.state()["latency_s"] == pytest.approx(0.02, abs=2e-3)  # none is configured
    f.set_params(sensor_latency="0.015 s")
    over_one_spot(0.02, bobbing_m, f=f, steps=range(2500, 2530))
    assert f.state()["latency_s"] == pytest.approx(0.015, abs=1e-9)
    f.set_params(max_demand="0.04 m")
    f.set_params(sensor_latency="0.015 s")
    before = f._state["adaptive"][0]["latency"]["count"]
    over_one_spot(0.02, bobbing_m, f=f, steps=range(2530, 2560))
    assert f._state["adaptive"][0]["latency"]["count"] > before, "the same latency again drops nothing"


def test_a_tool_at_rest_identifies_no_latency():
    assert over_one_spot(0.04, lambda t: 0.0).state()["latency_s"] == 0.0


def stand_off_rms(sensors: list[dict[str, list[float]]], biases_m: list[float], seed: int = 3) -> float:
    """Stand-off RMS [m] of a robot with τ = 40 ms over a wave of 100 mm at 100 mm/s."""

    def ground(x: float) -> float:
        return 0.005 * math.sin(2 * math.pi * x / 0.1) + 0.003 * math.sin(2 * math.pi * x / 0.061)

    rng = np.random.default_rng(seed)
    f = Follower({"memory": False, "sensors": sensors}, offset_m=0.1)
    leads = [s.get("position_m", [0.0])[0] for s in sensors]
    history, errors, z, v, goal = [], [], 0.1, 0.0, 0.1
    reported = 0.1
    for k in range(40_000):
        t, x = k, 1e-4 * k
        v += min(max((goal - z) / 0.04 - v, -0.002), 0.002)
        z += 1e-3 * v
        history.append((x, z))
        if t % 10 == 0 and t >= 30:
            if t > 50:
                goal = reported + f.step(10**10 + t * MS, [math.nan])[2]
            px, pz = history[t - 10]
            reported = pz + 5e-5 * rng.standard_normal()
            f.pose(10**10 + (t - 10) * MS, (px, 0.0, reported, 0.0, 0.0, 0.0, 1.0))
        if t % 4 == 0 and t >= 40:
            px, pz = history[t - 30]
            ranges = [
                pz - ground(px + c) + b + 2.5e-4 * rng.standard_normal() for c, b in zip(leads, biases_m)
            ]
            if rng.random() < 0.01:
                ranges[-1] += rng.uniform(-0.03, 0.03)
            f.step(10**10 + (t - 30) * MS, ranges)
        if k > 20_000:
            errors.append(z - ground(x) - 0.1)
    return float(np.sqrt(np.mean(np.square(errors))))


def test_a_look_ahead_sensor_halves_the_error_and_its_bias_is_estimated():
    alone = stand_off_rms([{}], [0.0])
    assert stand_off_rms([{}, {"position_m": [0.05, 0.0, 0.0]}], [0.0, 0.0]) < 0.5 * alone
    assert stand_off_rms([{}, {"position_m": [0.05, 0.0, 0.0]}], [0.0, 1e-3]) < 0.6 * alone


def test_a_second_sensor_beside_or_behind_changes_nothing():
    alone = [stand_off_rms([{}], [0.0], seed) for seed in range(3, 6)]
    beside = [{}, {"position_m": [-0.05, 0.0, 0.0]}]
    both = [stand_off_rms(beside, [0.0, 0.0], seed) for seed in range(3, 6)]
    assert np.mean(both) == pytest.approx(np.mean(alone), rel=0.1)


def follow_at_rest(bad: dict[int, float], step_m: float = 0.0, count: int = 1500) -> tuple[float, float]:
    """Lowest height of a standing tool, and when its error came below 3 mm for good, from sample 250 on [s].

    `bad` adds to readings; the ground moves by `step_m` at sample 250.
    """
    f, rng = Follower(offset_m=0.1), np.random.default_rng(0)
    z, v, lowest, last = 0.1, 0.0, 0.1, 0.0
    for i in range(count):
        t, ground = (i + 1) * 4 * MS, step_m if i >= 250 else 0.0
        f.pose(t, (0.0, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        d = f.step(t, [z - ground + 2e-4 * rng.standard_normal() + bad.get(i, 0.0)])
        v += float(np.clip(np.clip(d[2] / 0.04, -0.2, 0.2) - v, -0.008, 0.008))
        z += 0.004 * v
        lowest = min(lowest, z)
        if abs(z - ground - 0.1) > 3e-3:
            last = (i - 250) * 4e-3
    return lowest, last


def test_a_first_reading_that_is_a_glitch_does_not_drive_a_standing_tool_to_the_surface():
    for bad in ({0: 0.04}, {0: 0.04, 2: -0.03}, {0: -0.03}):
        lowest, last = follow_at_rest(bad)
        assert lowest > 0.099, bad
        assert last <= 0.0, bad


@pytest.mark.parametrize("step_m", [-0.02, 0.02])
def test_ground_that_moves_under_a_standing_tool_is_confirmed(step_m):
    assert follow_at_rest({}, step_m)[1] < 0.4


@pytest.mark.parametrize(("samples", "identified"), [(59, False), (60, True)])
def test_a_latency_needs_sixty_samples_of_one_rest(samples, identified):
    """GIVEN heights that the climb rate explains WHEN a rest is short THEN it may be chance."""
    a = zeros(AdaptiveState)[0]
    latency = a["latency"]
    latency["count"], latency["climb_climb"] = samples, samples * 0.03**2
    latency["climb_height"] = 0.02 * latency["climb_climb"]  # 20 ms
    latency["height_height"] = 0.02**2 * latency["climb_climb"]
    update_correction(default_params(), a)
    assert float(latency["correction_s"]) == pytest.approx(0.02 if identified else 0.0, rel=0.1)


@pytest.mark.parametrize("delay_s", [0.0, 1e-6])
def test_one_late_sample_among_those_without_a_delay_is_not_the_usual_one(delay_s):
    """A usual delay of 0 counted as not known: one sample 0.3 s late made it 0.3 s."""
    a, late = zeros(AdaptiveState)[0], 0
    a["plant"]["tau_s"], a["hold"]["interval_s"] = 0.04, 0.004
    for k in range(200):
        found_s = 0.3 if k == 100 else delay_s
        update_delay(a["latency"], found_s, found_s, 0.004)
        late += is_late(a)
    assert late == 0


@pytest.mark.parametrize("averaged", [False, True])
def test_ranges_that_are_averaged_may_be_older_and_conversions_may_not(averaged):
    """GIVEN samples 27 ms later than at first THEN those of a converter are late, means of 7 ranges are not.

    A service with the default of 7 tolerated 12 ms for an average that the demand does not use.
    """
    f, i = Follower({"memory": False, "sensor_readings": 7}, offset_m=0.1), zeros(Inputs)
    f._params["scale_m"], f._params["zero_m"] = 0.1 / 4096, 0.05
    for k in range(200):
        t = 10**12 + 4 * k * MS
        push_pose(f._state["sense"][0], t, np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0]), 0)
        i["t_ns"] = i["given_t_ns"] = t
        i["n_ranges"], i["n_conversions"] = int(averaged), int(not averaged)
        i["given_m"][0][0] = 0.1 + 1e-5 * (k % 3)
        i["conversion"][0][0] = pack_conversion(2048 + 10 * (k % 3), 0, 0, 0)
        follow_step(f._params, f._state, i, f._output, f._scratch)
    a = f._state["adaptive"][0]
    assert a["hold"]["interval_s"] == pytest.approx(4e-3, rel=0.02)
    a["latency"]["mean_s"] = a["latency"]["first_s"] + 0.027  # the axis has 40 ms
    assert is_late(a) != averaged


@pytest.mark.parametrize("glitch_m", [0.0, 0.02])
def test_a_rest_that_begins_with_a_glitch_identifies_the_latency(glitch_m):
    """GIVEN ranges that are 20 ms old WHEN the first one of a rest is a glitch THEN the others count.

    They were all compared with the glitch, and none was near.
    """
    a, sense, rng, pose = zeros(AdaptiveState)[0], zeros(SenseState)[0], np.random.default_rng(0), np.zeros(7)
    a["noise"]["sigma_m"] = 2e-4
    for k in range(700):
        t, t_ns = 4e-3 * k, 10**9 + 4 * k * MS
        push_pose(sense, t_ns, np.array([0.0, 0.0, bobbing_m(t), 0.0, 0.0, 0.0, 1.0]), 0)
        h = bobbing_m(t) - bobbing_m(t - 0.02) + 2e-4 * rng.standard_normal()
        if k >= 20:
            observe_height(default_params(), a, sense, t_ns, h + (glitch_m if k == 20 else 0.0), pose)
    assert float(a["latency"]["correction_s"]) == pytest.approx(0.02, abs=2e-3)


def test_the_count_of_a_sensor_is_its_least_change_of_many():
    hold, count = zeros(AdaptiveState)[0]["hold"], 5e-3
    for k in range(8):
        assert resolution_m(hold) == 0.0, "few changes say nothing: a step of the ground is one"
        record_sample(hold, (k + 1) * MS, 0.1 + count * (k % 2))
        record_sample(hold, (k + 1) * MS + 1, 0.1 + count * (k % 2))
    record_sample(hold, 10 * MS, 0.1)
    assert resolution_m(hold) == pytest.approx(count, rel=1e-9)
    reset_hold(hold)
    assert resolution_m(hold) == 0.0


@pytest.mark.parametrize("gap_s", [0.5, 2.0])
def test_the_usual_interval_is_not_that_of_a_loss(gap_s):
    """GIVEN readings every 4 ms WHEN they are missing for seconds THEN the sensor is none of a second."""
    hold = zeros(AdaptiveState)[0]["hold"]
    for k in range(200):
        record_sample(hold, 10**9 + k * 4 * MS, 0.1)
    record_sample(hold, 10**9 + 796 * MS + round(gap_s * 1e9), 0.1)
    assert 4e-3 <= hold["interval_s"] < 5e-3


def test_a_pause_behind_the_first_sample_is_no_interval():
    """GIVEN a sample, a pause of 6 s and a sample 4 ms later THEN the interval is 4 ms."""
    hold = zeros(AdaptiveState)[0]["hold"]
    record_sample(hold, 10**9, 0.1)
    record_sample(hold, 7 * 10**9, 0.1)
    assert hold["interval_s"] == 0.0
    record_sample(hold, 7 * 10**9 + 4 * MS, 0.1)
    assert hold["interval_s"] == pytest.approx(4e-3)
