"""Ground that bends under a good sensor of little noise: no estimate that runs away from the samples."""

from __future__ import annotations

from dataclasses import replace

import pytest

from surffollow.benchmark.job_loop import Job, follow

AUV = Job(5.0, 2.0, 1.0, 0.2, 0.5, 0.3, 0.001, (0.5, 40.0))
DRONE = Job(2.0, 0.35, 0.1, 0.05, 2.0, 4.0, 0.002, (0.2, 12.0))
SPRAYER = Job(0.5, 0.2, 0.011, 0.02, 0.5, 2.0, 0.0001, (0.05, 2.5))


@pytest.mark.parametrize(
    ("job", "interval_s", "sigma_m", "slope", "bottom_m"),
    [
        (DRONE, 0.18, 0.0005, 0.2, 20.0),
        (DRONE, 0.18, 0.002, 0.2, 47.0),
        (AUV, 1.0, 0.004, 0.3, 95.7),
        (AUV, 1.5, 0.001, 0.3, 95.7),
    ],
)
def test_a_slow_sensor_stays_over_ground_that_bends_into_a_rise(job, interval_s, sigma_m, slope, bottom_m):
    """GIVEN samples below the estimate WHEN the ground rises between them THEN they agree.

    None did: the models climbed on at their last slope, by 1.3 to 7.7 stand-offs, VALID.
    """
    slow = replace(job, reading_s=interval_s, sigma_m=sigma_m)
    speed = 0.6 * job.standoff_m if job is DRONE else 1.0
    run = follow(slow, lambda x, t: slope * abs(x - bottom_m), (bottom_m + 40.0) / speed, speed, seed=3)
    assert run.clearance_m.max() < 1.4 * job.standoff_m


def test_ground_that_turns_under_a_resting_tool_is_followed():
    """GIVEN ground that rises and falls at 0.3 of the axis' speed THEN the tool follows.

    It was 8 stand-offs too high.
    """
    run = follow(DRONE, lambda x, t: 0.6 * abs(t % 30.0 - 15.0), 60.0)
    assert run.clearance_m.max() < 2.0 * DRONE.standoff_m
    assert "VALID" in run.states[-1]["status"]


def stop_and_go(speed_mps: float, ramp_s: float, moving_s: float, resting_s: float):
    """Place [m] of a tool that rests, starts, moves and stops, over and over, at a time [s]."""
    period_s, way_m = resting_s + 2.0 * ramp_s + moving_s, speed_mps * (ramp_s + moving_s)

    def place_m(t: float) -> float:
        n, s = divmod(t, period_s)
        rising_s = min(max(s - resting_s, 0.0), ramp_s)
        even_s = min(max(s - resting_s - ramp_s, 0.0), moving_s)
        falling_s = max(s - resting_s - ramp_s - moving_s, 0.0)
        ramps = rising_s**2 / 2.0 + falling_s * ramp_s - falling_s**2 / 2.0
        return n * way_m + speed_mps * (ramps / ramp_s + even_s)

    return place_m


def valleys(fall: float, rise: float, length_m: float):
    """Height [m] of ground that falls over a length, rises to where it was, and so on."""
    period_m = length_m * (1.0 + fall / rise)

    def ground_m(x: float, t: float) -> float:
        u = x % period_m
        return -fall * u if u < length_m else rise * (u - length_m) - fall * length_m

    return ground_m


@pytest.mark.parametrize(
    ("speed_mps", "fall", "rise", "length_m", "ramp_taus", "moving_taus", "resting_taus"),
    [
        (3.3, 0.11, 0.06, 18.2, 0.09, 27.0, 21.0),
        (3.3, 0.10, 0.05, 18.2, 0.33, 27.0, 21.0),
        (3.3, 0.12, 0.12, 18.2, 0.09, 27.0, 21.0),
        (2.6, 0.12, 0.12, 32.3, 0.33, 19.0, 18.0),
    ],
)
def test_stop_and_go_over_slopes_costs_no_clearance(
    speed_mps, fall, rise, length_m, ramp_taus, moving_taus, resting_taus
):
    """GIVEN falls and rises WHEN the tool stops and goes THEN it is hardly lower than a P loop.

    Each sample over a rise was a step, which left falling slopes as they were. The slope of the blend went
    to -10, and the tool touched the ground, VALID.
    """
    ground_m, tau = valleys(fall, rise, length_m), SPRAYER.tau_s
    place_m = stop_and_go(speed_mps, ramp_taus * tau, moving_taus * tau, resting_taus * tau)
    ours, plain = (
        follow(SPRAYER, ground_m, 40.0, plain=p, place_m=place_m, seed=2).clearance_m.min()
        for p in (False, True)
    )
    print(f"least clearance {ours:.3f} m, P loop {plain:.3f} m of {SPRAYER.standoff_m} m")
    assert ours > plain - 0.3 * SPRAYER.standoff_m


def test_samples_above_an_estimate_that_falls_faster_than_the_ground_agree():
    """GIVEN a fall of 25 % WHEN the tool starts on it THEN it stays over it: it stopped 1 stand-off above."""
    ground_m, tau = valleys(0.25, 0.2, 42.4), DRONE.tau_s
    place_m = stop_and_go(3.3, 0.65 * tau, 11.0 * tau, 22.0 * tau)
    run = follow(replace(DRONE, reading_s=0.12, sigma_m=0.0006), ground_m, 60.0, place_m=place_m, seed=2)
    assert run.clearance_m.max() < 1.5 * DRONE.standoff_m


@pytest.mark.parametrize("seed", [1, 2])
def test_a_tool_that_stops_and_goes_through_a_valley_keeps_its_clearance(seed):
    """GIVEN models that fall WHEN the ground rises THEN a step up begins the path anew.

    The models fell on behind each step: the tool came within 0.6 to 0.7 of its stand-off.
    """
    tau = DRONE.tau_s
    place_m, ground_m = stop_and_go(8.8, 0.8 * tau, 10.0 * tau, 11.3 * tau), valleys(0.063, 0.124, 305.0)
    run = follow(replace(DRONE, reading_s=0.06), ground_m, 40.0, place_m=place_m, seed=seed)
    print(f"least clearance {run.clearance_m.min():.3f} m of {DRONE.standoff_m} m")
    assert run.clearance_m.min() > 0.9 * DRONE.standoff_m
