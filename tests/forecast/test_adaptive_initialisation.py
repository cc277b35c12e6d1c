"""A bad first sample, falling walls, frozen adaptation, and the steps that a drop-out takes back."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow.follower import Follower
from surffollow.forecast.estimation.estimate import reset_estimate, update_estimate
from surffollow.forecast.setpoint.setpoint_limits import limit_setpoint
from surffollow.forecast.terrain.terrain_buffer import CELL_M
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_adaptive_estimation import BUFFER_CELLS
from surffollow.shm.layout_follow import RUN_FREEZE, RUN_NORMAL

from .feeding import MS, default_params, feed

NAN = float("nan")


@pytest.mark.parametrize("first_m", [0.001, 0.002, 0.0045, -0.0045])
def test_a_first_sample_a_few_millimetres_off_is_soon_forgotten(first_m):
    """Within the noise after 20 samples, and within three hundredths of it after 60."""
    for samples, share in ((20, 1.0), (60, 0.03)):
        heights = np.random.default_rng(5).normal(0.0, 1e-4, samples)
        heights[0] += first_m
        bad, _ = feed(heights, sigma=0.0)
        good, _ = feed(heights[2:], sigma=0.0, start=3)
        assert abs(bad["estimate"]["height_m"] - good["estimate"]["height_m"]) < share * 1e-4


def test_on_a_slope_the_second_sample_does_not_restart_the_estimate():
    heights = 0.7e-3 * np.arange(60)  # 20 degrees at 0.5 m/s
    a, taken = feed(heights, way=1.9e-3, sigma=5e-5)
    assert a["estimate"]["samples"] >= 59
    assert taken[2:].all()


def test_no_model_is_scored_during_the_settling_time_after_a_start_or_a_loss():
    samples = 15  # one every 4 ms: 60 ms
    a, _ = feed(np.zeros(samples + 1))
    assert a["weights"]["scored"] == 0
    a, _ = feed(np.zeros(samples + 4))
    assert a["weights"]["scored"] == 3
    # GIVEN a follower that scores its models WHEN no sample came for longer than the loss time-out
    before, _ = feed(np.zeros(100))
    scored = int(before["weights"]["scored"])
    start = 100 + int(default_params()["loss_timeout_ns"]) // (4 * MS) + 2
    # THEN the index waits again, and goes on afterwards
    a, _ = feed(np.zeros(samples + 1), a=before.copy(), start=start)
    assert a["weights"]["scored"] == scored
    a, _ = feed(np.zeros(samples + 4), a=before.copy(), start=start)
    assert a["weights"]["scored"] == scored + 3


def test_models_are_scored_at_once_behind_a_confirmed_step():
    # GIVEN level ground with a step up of 20 mm, which some samples confirm
    level, _ = feed(np.zeros(200))
    stepped, taken = feed(np.where(np.arange(200) < 100, 0.0, 0.02))
    # THEN every sample that enters the estimate is scored, the first ones behind the step too
    assert not taken.all()
    missing = int(len(taken) - taken.sum())
    assert stepped["weights"]["scored"] == level["weights"]["scored"] - missing


def test_a_steady_fall_is_confirmed_while_it_continues():
    heights = np.zeros(400)
    heights[200:250] = -0.56e-3 * np.arange(1, 51)  # 28 mm over 10 mm, at 50 mm/s
    heights[250:] = -0.028
    a, taken = feed(heights[:250], way=0.2e-3, sigma=1e-4)
    first = int(np.argmax(heights < -1.5e-3))  # beyond the gate
    confirmed = first + int(np.argmax(taken[first:]))
    assert confirmed - first <= 14  # 2.5 mm of travel and a little, half way down …
    assert a["estimate"]["height_m"] == pytest.approx(-0.028, abs=4e-3)  # … and known where it ends


def test_readings_that_alternate_are_rough_ground_soon():
    heights = np.where(np.arange(1200) % 2 == 0, 7e-4, -7e-4)
    heights[:600] = 0.0
    a, taken = feed(heights, sigma=5e-5)
    assert taken[700:].mean() > 0.9
    assert abs(a["estimate"]["height_m"]) < 4e-4
    assert a["noise"]["sigma_m"] > 3e-4


def test_noise_free_readings_have_no_negative_noise():
    a, _ = feed(np.zeros(4000), sigma=0.0)
    assert 0.0 <= a["noise"]["sigma_m"] < 1e-6


def take(a, count, adapt, jump=0.0, start=1, seed=3):
    rng = np.random.default_rng(seed)
    params = default_params()
    params["run"] = RUN_NORMAL if adapt else RUN_FREEZE
    for k in range(count):
        h = rng.normal(0.0, 5e-5) + (jump if k == 0 else 0.0)
        update_estimate(params, a, 10**9 + (start + k) * 4 * MS, 1e-3, h, 0.1)


@pytest.mark.parametrize("fresh", [False, True])
def test_a_start_behind_bad_samples_alone_forgets_their_slopes(fresh):
    """GIVEN slopes of bad samples WHEN nothing else is known THEN they do not widen the clamp."""
    a, _ = feed(0.5e-3 * np.arange(400))
    estimate = a["estimate"]
    assert min(estimate["slope_power"], estimate["quick_slope_power"]) > 0.01
    reset_estimate(default_params(), a, 10**10, 0.0, 0.0, 0.1, fresh)
    assert (max(estimate["slope_power"], estimate["quick_slope_power"]) == 0.0) == fresh


@pytest.mark.parametrize("adapt", [0, 1])
def test_a_bad_sample_after_a_reset_keeps_noise_index_and_weights(adapt):
    a = zeros(AdaptiveState)[0]
    take(a, 1200, 1)
    noise, scored, weight = a["noise"]["sigma_m"], a["weights"]["scored"], a["weights"]["weight"].copy()
    a["estimate"]["samples"] = 0  # as SFReset does
    take(a, 20, adapt, jump=0.03, start=1201)
    assert a["estimate"]["samples"] >= 15
    assert abs(a["estimate"]["height_m"]) < 2e-4
    assert a["noise"]["sigma_m"] == pytest.approx(noise, rel=0.1)
    assert a["weights"]["scored"] == scored
    if adapt == 0:
        np.testing.assert_array_equal(a["weights"]["weight"], weight)


def test_frozen_the_gate_does_not_grow():
    a = zeros(AdaptiveState)[0]
    take(a, 600, 1)
    scale = a["gate"]["scale_m"]
    rng = np.random.default_rng(7)
    params = default_params()
    params["run"] = RUN_FREEZE
    for k in range(200):
        update_estimate(params, a, 10**9 + (601 + k) * 4 * MS, 1e-3, rng.uniform(-0.03, 0.03), 0.1)
    assert a["gate"]["scale_m"] == scale


def standoffs(sensor, seconds, config=None, speed_mps=0.1):
    """True stand-offs [m] of a tool led over flat ground, read at 250 Hz as `sensor(t_s, range)` says."""
    f = Follower({"memory": False, **(config or {})}, offset_m=0.1)
    rng = np.random.default_rng(2)
    z, set_m, out = 0.1, 0.1, []
    for k in range(int(seconds * 1000)):
        t_ns = 10**10 + k * MS
        if k % 10 == 0:
            f.pose(t_ns, (speed_mps * k * 1e-3, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        reading = sensor(k * 1e-3, z + rng.normal(0.0, 5e-5)) if k % 4 == 0 else NAN
        demand = f.step(t_ns, [reading])[2]
        if k % 10 == 0:
            set_m = z + demand
        z += np.clip((set_m - z) / 0.04, -0.2, 0.2) * 1e-3
        out.append(z)
    return np.array(out)


def test_a_few_bad_readings_and_then_none_do_not_lower_the_tool_for_long():
    bad = [0]

    def sensor(t_s, range_m):
        if t_s < 0.01:  # three readings, all that there are: 40 mm too long
            bad[0] += 1
            return range_m + 0.04
        return NAN if t_s < 1.5 else range_m

    z = standoffs(sensor, 2.0)
    assert bad[0] == 3
    assert z.min() > 0.097


def test_a_step_down_is_taken_back_when_nothing_confirms_it():
    # after steps that stayed two readings tell a step
    def sensor(t_s, range_m):
        for j in range(1, 4):
            if t_s > j:
                range_m += 0.01
        if 4.5 <= t_s < 4.508:
            return range_m + 0.04
        return NAN if 4.508 <= t_s < 6.0 else range_m

    z = standoffs(sensor, 7.0)
    before = z[4490]
    assert z[4500:6000].min() > before - 0.006
    assert z[-1] == pytest.approx(before, abs=3e-4)


@pytest.mark.parametrize("rate_hz", [10, 25, 250])
def test_a_real_step_down_at_rest_is_not_taken_back_between_slow_samples_or_later(rate_hz):
    # the ground sinks by 10 mm under a standing tool; later readings fail now and then
    every, z, z0, highest, lowest = 1000 // rate_hz, 0.1, 0.1, 0.0, 1.0
    f = Follower({"memory": False}, offset_m=0.1)
    rng = np.random.default_rng(4)
    for k in range(9000):
        t_ns = 10**10 + k * MS
        ground_m = 0.0 if k < 3000 else -0.01
        fails = k > 4500 and k % 300 < 200
        if k % 10 == 0:
            f.pose(t_ns, (0.0, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        sampled = k % every == 0 and not fails
        reading = z - ground_m + rng.normal(0.0, 2e-5) if sampled else NAN
        demand = f.step(t_ns, [reading])[2]
        if k % 10 == 0:
            set_m = z + demand
        z += np.clip((set_m - z) / 0.04, -0.2, 0.2) * 1e-3
        if k > 3000:
            lowest = min(lowest, z)
            highest = max(highest, z - lowest)
    assert highest < 1e-3  # it never goes up again
    assert z == pytest.approx(z0 - 0.01, abs=3e-4)


def test_the_limits_are_those_that_the_axis_can_use():
    params, a = default_params(), zeros(AdaptiveState)[0]
    heights, t_ns = [0.0], 10**9
    for _ in range(400):
        t_ns += MS
        limit_setpoint(params, a, t_ns, 0.05, heights[0])
        heights.append(a["setpoint"]["position_m"])
    rate = np.diff(heights) * 1e3
    limit = 2.0 * params["plant_v_max_mps"]
    assert 0.5 * limit < rate.max() <= limit * (1 + 1e-9)
    accel = np.diff(rate) * 1e3
    assert np.abs(accel[1:]).max() <= 20.0 * params["plant_a_max_mps2"] * (1 + 1e-6)
    assert heights[-1] == pytest.approx(0.05, abs=1e-6)


def test_a_plan_that_comes_and_goes_does_not_throw_the_setpoint_beyond_its_target():
    """GIVEN a slow axis WHEN preview has a share in every other cycle THEN the setpoint stops in time.

    With limits that fell from those of the setpoint to twenty times those of the axis it passed by 5.7 mm.
    """
    params, a = default_params(), zeros(AdaptiveState)[0]
    params["plant_v_max_mps"], params["plant_a_max_mps2"], params["toward_factor"] = 0.03, 0.015, 1.0
    lowest_m = 0.0
    for k in range(3000):
        a["preview"]["share"] = 0.15 * (k % 2)
        limit_setpoint(params, a, 10**9 + k * MS, -0.02, 0.0)
        lowest_m = min(lowest_m, float(a["setpoint"]["position_m"]))
    print(f"{-1e3 * lowest_m - 20.0:.3f} mm beyond the target")
    assert lowest_m > -0.021


def test_the_first_cell_behind_an_initialisation_lies_at_its_footprint():
    """It lay half a metre ahead: the path was advanced, and the sample was not."""
    f, rng = Follower({"memory": False}, offset_m=0.1), np.random.default_rng(1)
    for k in range(42):
        t = 10**9 + 4 * k * MS
        f.pose(t, (4e-4 * k, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
        f.step(t, [0.1 + 1e-4 * rng.standard_normal()])
        if k == 40:
            f.reset()
    a = f._state["adaptive"][0]
    cell = int(a["estimate"]["arc_length_m"] / CELL_M) & (BUFFER_CELLS - 1)
    assert a["buffer"]["x_m"][cell] == pytest.approx(a["sample"]["x_m"], abs=1e-9)
