"""Ranges that do not explain a descent are named in the health, before the tool is down."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow.benchmark import families
from surffollow.benchmark.hazard_scenarios import SIGMA_M, STANDOFF_M
from surffollow.benchmark.job_loop import Job, follow
from surffollow.forecast.sensing.descent import observe_descent
from surffollow.forecast.step import reset_stop
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import REASON_DESCENT, REASON_NAMES, AdaptiveState
from surffollow.shm.layout_follow import STOP_DESCENT, STOPPED, VALID

from .feeding import default_params
from .response_loop import MS, closed_loop, noisy, standard

REASON = REASON_NAMES[REASON_DESCENT]


def seen(states: list[dict]) -> list[bool]:
    return [s["reason"] == REASON or s["health"] == "STUCK" for s in states]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "unseen_m",
    [
        lambda t, rng: 0.105 + 0.005 * math.sin(2.0 * math.pi * t) + SIGMA_M * rng.standard_normal(),
        lambda t, rng: 0.105 + 0.0025 * rng.standard_normal(),
        lambda t, rng: 0.11 + 0.01 * rng.standard_normal(),
    ],
    ids=["hose", "noise", "much noise"],
)
def test_ranges_that_depend_on_nothing_are_named_before_the_tool_is_down(unseen_m, seed):
    def read(t, r, rng):
        return noisy(t, r, rng) if t < 2.0 else unseen_m(t, rng)

    heights, _, states = closed_loop(
        lambda x: 0.01 * math.sin(12.0 * x), read, seconds=5.0, seed=seed, speed=0.05
    )
    first = next(k for k, s in enumerate(seen(states)) if s)
    assert first > 200
    assert heights[: first + 1].min() > 0.5 * STANDOFF_M


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("period_s", [0.5, 1.0])
def test_a_hose_below_the_sensor_does_not_lead_the_tool_into_the_ground(period_s, seed):
    """GIVEN a range that sways by 5 mm around 105 mm WHEN it has led the tool deep THEN it is found out."""

    def read(t, r, rng):
        return noisy(t, r, rng) if t < 2.0 else 0.105 + 0.005 * math.sin(2.0 * math.pi * t / period_s)

    heights, _, states = closed_loop(
        lambda x: 0.01 * math.sin(12.0 * x), read, seconds=12.0, seed=seed, speed=0.05
    )
    assert heights.min() > 0.3 * STANDOFF_M
    assert np.mean([s["health"] == "STUCK" for s in states[400:]]) > 0.6


@pytest.mark.parametrize("slope", [0.6, 0.8])
@pytest.mark.parametrize("bias_m", [0.0, 3e-3, 1e-2])
@pytest.mark.parametrize("begin_m", [0.0, 0.2, 0.6])
def test_ground_that_falls_steeply_does_not_leave_the_window_in_a_test(slope, bias_m, begin_m):
    """GIVEN a good sensor with a near end of its window WHEN the ground falls by 60 or 80 %."""
    for seed in range(2):
        heights, _, states = closed_loop(
            lambda x: -slope * max(x - begin_m, 0.0),
            lambda t, r, rng: noisy(t, r + bias_m, rng),
            seconds=3.0 + begin_m / 0.2,
            speed=0.2,
            seed=seed,
        )
        # THEN the tool follows it
        assert heights.max() < 1.65 * STANDOFF_M
        assert states[-1]["health"] in ("OK", "SUSPECT")


def test_a_steady_long_fall_is_suspected_for_a_few_standoffs_only():
    """GIVEN ten readings a second WHEN a drone follows a fall of 27 % THEN the suspicion ends."""
    job = Job(2.0, 0.3, 0.1, 0.05, 2.0, 4.0, 0.004, (0.2, 6.0))
    run = follow(job, lambda x, _t: -0.27 * x, 60.0, speed_mps=3.0)
    suspected = [s["reason"] == REASON for s in run.states]
    assert np.mean(suspected) < 0.15
    assert not any(suspected[len(suspected) // 2 :])
    assert run.clearance_m.min() > 0.9 * job.standoff_m


@pytest.mark.parametrize("seed", range(3))
def test_a_stop_for_descents_ends_them_and_can_be_reset(seed):
    """GIVEN a configuration that names the cause WHEN the sensor reads a hose THEN the tool stays up."""
    f = standard()
    f._params[0]["stop_on"] = STOP_DESCENT

    seen = []

    def read(t, r, rng):
        seen.append((int(f._output[0]["stop"]), int(f._output[0]["stop_now"])))
        return 0.105 + 0.005 * math.sin(2.0 * math.pi * t) if 2.0 < t < 9.0 else noisy(t, r, rng)

    heights, _, _ = closed_loop(
        lambda x: 0.01 * math.sin(12.0 * x), read, seconds=5.0, seed=seed, speed=0.05, follower=f
    )
    assert heights.min() > 0.5 * STANDOFF_M
    output = f._output[0]
    assert output["status"] & STOPPED
    assert not output["status"] & VALID
    stopped = [now for stop, now in seen if stop == STOP_DESCENT]
    again = [now & STOP_DESCENT for now in stopped[1:]]
    assert not any(again), "the cause is not present while it is stopped, and a reset is accepted"
    reset_stop(f._params, f._state)
    z = STANDOFF_M
    for ms in range(5000, 6000):
        if ms % 10 == 0:
            f.pose(ms * MS, (0.25, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        f.step(ms * MS, [STANDOFF_M if ms % 4 == 0 else math.nan])
    assert output["status"] & VALID
    assert output["stop"] == 0


def test_another_standoff_ends_the_suspicion_of_a_descent():
    """GIVEN a hose that was read as ground WHEN the stand-off changes THEN the tool may descend to it."""
    changed = []

    def read(t, r, rng):
        if t > 2.0 and not changed and int(f._state["adaptive"]["descent"]["unexplained"][0]):
            f.set_params(offset_m=0.11)
            changed.append(t)
        if changed and t < changed[0] + 0.01:
            seen.append(int(f._state["adaptive"]["descent"]["unexplained"][0]))
        return 0.105 + 0.005 * math.sin(2.0 * math.pi * t) if t > 2.0 else noisy(t, r, rng)

    f, seen = standard(), []
    closed_loop(lambda x: 0.01 * math.sin(12.0 * x), read, seconds=5.0, seed=0, speed=0.05, follower=f)
    assert seen, "a descent was suspected"
    assert seen[-1] == 0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("ground", "speed"),
    [
        (lambda x: 0.02 * math.sin(8.0 * x) + 0.005 * math.sin(31.0 * x), 0.2),
        (lambda x: -0.3 * x, 0.2),
        (lambda x: -0.03 * (1.0 + math.tanh(20.0 * (x - 0.3))), 0.1),
        (lambda x: -0.02 * (x > 0.3), 0.1),
    ],
    ids=["waves", "ramp", "flank", "edge"],
)
def test_a_tool_that_follows_falling_ground_is_not_suspected(ground, speed, seed):
    _, _, states = closed_loop(ground, noisy, seconds=5.0, seed=seed, speed=speed)
    assert not any(s["reason"] == REASON for s in states)


@pytest.mark.parametrize("speed", [0.1, 0.4])
@pytest.mark.parametrize("family", ["weld", "hull", "casting", "lap_joints", "pipes", "terrain", "furrows"])
def test_a_tool_over_the_surfaces_of_the_benchmark_is_not_suspected(family, speed):
    x = np.arange(0.0, 3.0, 5e-4)
    h = getattr(families, family)(np.random.default_rng(9001), x)
    _, _, states = closed_loop(
        lambda at: float(np.interp(at, x, h)), noisy, seconds=min(5.0, 2.8 / speed), speed=speed
    )
    assert not any(s["reason"] == REASON for s in states)


@pytest.mark.parametrize("seed", range(10))
def test_a_descent_is_what_its_naive_twin_says(seed):
    """The twin keeps all samples of the descent, and finds its mean error from them each time."""
    rng = np.random.default_rng(seed)
    params, a = default_params(), zeros(AdaptiveState)[0]
    params["offset_m"] = STANDOFF_M
    a["noise"]["sigma_m"], a["plant"]["tau_s"], a["hold"]["interval_s"] = 2e-4, 0.04, 4e-3
    a["noise"]["range_sigma_m"], scatter = 2e-4, 0.0
    speed = float(rng.uniform(0.0, 0.1))
    a["kinematics"]["speed_mps"], a["kinematics"]["climb_mps"] = speed, -0.1
    window_m = 0.06 if seed % 2 else 0.04  # above the stand-off; 40 mm are enough for a hold, not for a lift
    params["range_max_m"] = STANDOFF_M + window_m
    band, z, kept, falls = 3.0 * 2e-4 / math.sqrt(8.0), 0.0, [], 0
    slope = float(rng.choice([0.0, 0.5]))
    a["estimate"]["slope_power"] = slope * slope
    mean = low = high = floor = top = math.nan
    reach, tests = 0.1 * STANDOFF_M, 0
    for k in range(1, 1500):
        z -= 3e-4 * float(rng.random() - 0.2)
        z += 0.01 * float(rng.random() < 0.002)
        r = STANDOFF_M + 0.006 + 0.003 * math.sin(0.05 * k) + 1e-3 * float(rng.standard_normal())
        r += 0.05 * float(rng.random() < 0.05)
        a["sample"]["lead_m"] = 0.05 * (k % 40 < 10)  # at times it leads
        comes_back = k % 70 < 35  # from another test
        a["response"]["settled_ns"] = (k * 4 + 100) * MS if comes_back else 0
        a["estimate"]["samples"] = k
        tested_m = observe_descent(params, a, k * 4 * MS, r, z)
        a["response"]["t_ns"] = k * 4 * MS
        if k == 1:
            mean = low = high = r
            floor = top = z
        deviation = min(abs(r - mean), 3.0 * max(scatter, 2e-4))  # an outlier is cut
        scatter += (deviation - scatter) / 64.0
        r = mean + math.copysign(deviation, r - mean)
        mean += (r - mean) / 8.0
        low = min(low + (mean - low) / 500.0, mean)
        high = max(high + (mean - high) / 500.0, mean)
        heights = [top, *(h for h, _ in kept)]
        fall = top - min(heights)
        if z - min(heights) > min(fall, max(4.0 * band, 0.1 * fall)):
            floor, top, kept, reach = min(floor, *heights), z, [], 0.1 * STANDOFF_M
        elif fall > STANDOFF_M:
            floor, top, kept, reach = min(floor, *heights), z, [], 2.0 * reach
        kept.append((z, r))
        error, fall = 0.0, top - z
        for n, (_, x) in enumerate(kept, start=1):
            error += (x - STANDOFF_M - error) / min(n, 64)
        spread = max(0.5 * (high - low), band)
        expected = (
            len(kept) > 16
            and error > max(band, 0.02 * STANDOFF_M)
            and fall > 3.0 * error
            and error * fall > 0.36 * spread * STANDOFF_M
            and fall > 0.2 * speed * 4e-3 * len(kept)
            and fall > reach
            and k % 40 >= 10
        )
        assert a["descent"]["unexplained"] == expected, k
        deep = z < floor - reach and fall > 2.0 * slope * speed * 4e-3 * len(kept)
        lasts_s = 2.0 * (2.0 * 0.04 + 16.0 * 4e-3) + 0.04  # τ and samples, of a hold and a lift
        room = window_m - error - 4.5 * spread - 0.1 * lasts_s
        answers = spread < 0.1 * STANDOFF_M and room > 0.0 and k > 500
        to_test = expected and deep and answers and not comes_back
        assert tested_m == pytest.approx(spread if to_test else 0.0), k
        if to_test:  # the response begins the test, which is short here
            reach *= 2.0
            floor, top, kept = min(floor, z, *(h for h, _ in kept)), z, []
            a["response"]["swing_m"] = spread
            observe_descent(params, a, (k * 4 + 1) * MS, r, z)
            a["response"]["swing_m"] = 0.0
        falls += expected
        tests += to_test
    print(f"seed {seed}: {falls} samples unexplained, {tests} tests")


@pytest.mark.parametrize("gap_at_s", [3.0, 3.5, 5.0])
def test_a_pause_of_a_stuck_sensor_does_not_make_it_a_good_one(gap_at_s):
    """GIVEN a range that froze in a steady fall WHEN a few readings are missing THEN it stays STUCK."""

    def read(t, r, rng):
        if gap_at_s < t < gap_at_s + 0.08:
            return math.nan
        return noisy(t, r, rng) if t < 2.0 else noisy(t, STANDOFF_M, rng)

    _, _, states = closed_loop(lambda x: -0.15 * min(x, 0.8), read, seconds=7.0)
    stuck = [s["health"] == "STUCK" for s in states]
    begin = stuck.index(True)
    assert begin < 100 * gap_at_s
    assert all(stuck[begin:])


@pytest.mark.parametrize("seed", range(3))
def test_a_frozen_sensor_with_pauses_is_found_as_early_as_one_without(seed):
    """GIVEN level ground, a range frozen 0.5 mm too long with its noise, and a gap of 80 ms every second."""

    def read(t, r, rng):
        if t % 1.0 < 0.08:
            return math.nan
        return noisy(t, r, rng) if t < 2.0 else noisy(t, STANDOFF_M + 5e-4, rng)

    heights, _, _ = closed_loop(lambda _: 0.0, read, seconds=25.0, seed=seed, speed=0.1)
    assert heights.min() > 0.85 * STANDOFF_M
