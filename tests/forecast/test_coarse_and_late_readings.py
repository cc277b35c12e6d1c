"""Sensors with coarse counts or much noise, and readings that overtake each other on their way."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow.benchmark.job_loop import CELL, Job, follow

DRONE = Job(3.0, 0.5, 0.05, 0.02, 2.5, 5.0, 0.02, (0.2, 12.0))
TORCH = Job(0.004, 0.03, 0.002, 0.005, 0.2, 4.0, 0.05e-3, (0.0005, 0.012))


def hills(job, speed_mps, slope, seed):
    """Ground of forty waves of 8 to 120 vτ, with this RMS slope."""
    rng, way_m = np.random.default_rng(seed), speed_mps * job.tau_s
    lengths_m, phases = np.geomspace(8.0 * way_m, 120.0 * way_m, 40), rng.uniform(0.0, 6.28, 40)
    heights_m = slope * math.sqrt(2.0 / 40.0) / 6.28 * lengths_m
    return lambda x, t: float(np.sum(heights_m * np.sin(6.28 * x / lengths_m + phases)))


@pytest.mark.parametrize("count_standoffs", [0.02, 0.05, 0.1])
@pytest.mark.parametrize(("job", "speed_mps", "seconds"), [(DRONE, 3.0, 100.0), (CELL, 0.1, 12.0)])
def test_neighbouring_counts_of_a_coarse_sensor_agree(job, speed_mps, seconds, count_standoffs):
    """GIVEN counts far above the noise WHEN the tool follows hills THEN no reading is an outlier for long.

    A drone with counts of 0.05 stand-offs rejected all readings and climbed by 3 to 6 stand-offs, VALID.
    """
    count_m, ground = count_standoffs * job.standoff_m, hills(job, speed_mps, 0.1, 3)
    ours, plain = (
        follow(job, ground, seconds, speed_mps, plain, misread=lambda t, r, rng: count_m * round(r / count_m))
        for plain in (False, True)
    )
    outliers = np.mean(["outside the innovation gate" in s["reason"] for s in ours.states])
    print(f"RMS {ours.rms_m(job) / plain.rms_m(job):.2f} of the P loop, outliers {outliers:.3f} of the time")
    assert ours.rms_m(job) < 1.1 * plain.rms_m(job)
    assert outliers < 0.05


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("job", "speed_mps", "slope"), [(CELL, 0.1, 0.1), (TORCH, 0.05, 0.05)])
def test_readings_that_overtake_each_other_keep_their_timestamps(job, speed_mps, slope, seed):
    """GIVEN right timestamps WHEN readings arrive up to τ late, in any order THEN they are used so.

    Those behind newer ones were taken for readings of a clock that went back, and got other timestamps.
    """
    ground = hills(job, speed_mps, slope, seed)
    ours = follow(job, ground, 300.0 * job.tau_s, speed_mps, seed=seed, latest_s=job.tau_s)
    print(f"RMS {ours.rms_m(job) / job.standoff_m:.4f} stand-offs")
    assert ours.rms_m(job) < 0.02 * job.standoff_m
    assert ours.clearance_m.min() > 0.9 * job.standoff_m


def test_much_noise_does_not_send_the_tool_up():
    """GIVEN noise of 0.15 stand-offs WHEN a drone follows hills THEN it is followed as by a P loop."""
    ratios, offsets = [], []
    for seed in range(4):
        ground = hills(DRONE, 3.0, 0.1, seed)

        def misread(t, r, rng):
            return r + 0.15 * DRONE.standoff_m * float(rng.standard_normal())

        ours, plain = (follow(DRONE, ground, 120.0, 3.0, p, misread, seed) for p in (False, True))
        ratios.append(ours.rms_m(DRONE) / plain.rms_m(DRONE))
        offsets.append(float(np.mean(ours.clearance_m)) / DRONE.standoff_m - 1.0)
    print(f"RMS {np.round(ratios, 2)} of the P loop, mean offset {np.round(offsets, 3)} stand-offs")
    assert np.mean(ratios) < 1.1
    assert np.mean(offsets) < 0.02


@pytest.mark.parametrize(("noise_standoffs", "seed"), [(0.15, 3), (0.3, 0), (0.3, 2)])
def test_a_start_in_much_noise_does_not_reject_all_readings(noise_standoffs, seed):
    """GIVEN a slope taken from two noisy readings WHEN no later one agrees with it THEN the gate opens.

    The drone climbed by four to five stand-offs, until it saw nothing any more.
    """

    def misread(t, r, rng):
        return r + noise_standoffs * DRONE.standoff_m * float(rng.standard_normal())

    ours = follow(DRONE, hills(DRONE, 3.0, 0.1, seed), 12.0, 3.0, misread=misread, seed=seed)
    print(f"highest {ours.clearance_m.max() / DRONE.standoff_m:.2f} stand-offs")
    assert ours.clearance_m.max() < 2.2 * DRONE.standoff_m


WELD = Job(0.06, 0.05, 0.025, 0.0125, 0.1, 3.0, 1e-4, (0.015, 0.24))
ALTIMETER = Job(3.0, 0.2, 0.1, 0.02, 2.0, 15.0, 0.005, (0.75, 12.0))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("job", "count_m", "speed_mps"), [(WELD, 1e-3, 0.01), (ALTIMETER, 0.05, 2.0)])
def test_a_range_that_rests_on_a_count_behind_an_approach_is_no_fault(job, count_m, speed_mps, seed):
    """GIVEN level ground and noise of a tenth of a count WHEN the tool has come down THEN it is OK.

    The learned noise fell to nothing on a count, and the last micrometres of the approach were a motion to
    which the range did not respond: STUCK, and half of the weld trackers had no demand ever after.
    """
    above_m = np.random.default_rng(seed).uniform(0.2, 1.7) * job.standoff_m
    read = lambda t, r, rng: count_m * round(r / count_m)  # noqa: E731
    run = follow(
        job, lambda x, t: 0.0, 400.0 * job.tau_s, speed_mps, misread=read, seed=seed, above_m=above_m
    )
    assert not any(s["health"] == "STUCK" for s in run.states)
    assert all("VALID" in s["status"] for s in run.states[10:])
    assert abs(run.clearance_m[-1] - job.standoff_m) < 0.75 * count_m
