"""Ground that alternates from sample to sample: crop rows, furrows, corrugated sheet under a slow sensor.

With 1.3 to 5 samples per row the heights look like noise, and models of slopes see steep ones by chance.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow.benchmark.job_loop import Job, follow
from surffollow.forecast.estimation.noise import update_noise
from surffollow.forecast.reset import reset_learned
from surffollow.forecast.sensing import constant_ranges, mean_range
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState

from .feeding import default_params

DRONE = Job(3.0, 0.5, 0.1, 0.05, 2.0, 2.0, 0.03, (0.2, 40.0))
BOOM = Job(0.5, 0.3, 0.05, 0.02, 0.83, 2.8, 0.003, (0.05, 4.0))
TORCH = Job(0.010, 0.04, 0.005, 0.004, 0.125, 3.1, 6e-5, (0.001, 0.08))


def rows(length_m: float, height_m: float, slope: float, hills_m: tuple[float, float], seed: int):
    """Rows with gaps as wide as half a row, over six waves of hills with this RMS slope."""
    rng = np.random.default_rng(seed)
    numbers = 2.0 * math.pi / np.exp(rng.uniform(*np.log(hills_m), 6))
    phases, heights_m = rng.uniform(0.0, 2.0 * math.pi, 7), slope * math.sqrt(2.0 / 6.0) / numbers

    def ground(x: float, t: float) -> float:
        part = (x / length_m + phases[6]) % 1.0
        row_m = height_m * math.sin(math.pi * part / 0.6) if part < 0.6 else 0.0
        return row_m + float(heights_m @ np.sin(numbers * x + phases[:6]))

    return ground


@pytest.mark.parametrize(
    ("job", "speed_mps", "length_m", "height_m", "slope", "hills_m"),
    [
        (DRONE, 6.0, 2.0, 1.2, 0.08, (20.0, 100.0)),
        (DRONE, 6.0, 1.5, 1.2, 0.08, (20.0, 100.0)),
        (BOOM, 6.0, 0.75, 0.15, 0.03, (10.0, 60.0)),
        (BOOM, 3.0, 0.75, 0.15, 0.03, (10.0, 60.0)),
        (TORCH, 1.4, 0.018, 0.003, 0.02, (0.2, 1.0)),
    ],
    ids=["drone, 2 m", "drone, 1.5 m", "boom, 6 m/s", "boom, 3 m/s", "torch"],
)
def test_rows_that_are_seen_a_few_times_each_do_not_lead_the_tool_away(
    job, speed_mps, length_m, height_m, slope, hills_m
):
    """GIVEN rows of 0.3 to 0.4 stand-offs, of 2 to 5 samples each THEN the tool keeps near their mean."""
    for seed in range(6):
        ground = rows(length_m, height_m, slope, hills_m, seed)
        run = follow(job, ground, 120 * job.tau_s, speed_mps, seed=seed)
        plain = follow(job, ground, 120 * job.tau_s, speed_mps, plain=True, seed=seed)
        error = run.rms_m(job) / plain.rms_m(job)
        away = np.abs(run.clearance_m - job.standoff_m).max() / job.standoff_m
        print(f"seed {seed}: RMS {error:.2f} of a P loop, at most {away:.2f} stand-offs away")
        assert error < 1.2
        assert away < 0.8


def band_over(ranges_m: np.ndarray) -> float:
    """Band of the mean of eight such ranges, over that of their noise by second differences."""
    params, state = default_params(), zeros(AdaptiveState)[0]
    reset_learned(state)
    state["hold"]["interval_s"], state["plant"]["tau_s"] = 4e-3, 0.04
    constant_ranges.begin_run(params, state, 0.2, ranges_m[0])
    for range_m in ranges_m:
        state["estimate"]["samples"] += 1
        state["weights"]["scored"] += 1
        state["hold"]["range_m"] = range_m
        update_noise(state, 0.2 - range_m)
        sigma_m = mean_range.range_sigma_m(state)
        constant_ranges.update_mean(state, range_m, sigma_m, 3.0 * sigma_m)
    return mean_range.range_band_m(state) / mean_range.mean_band_m(sigma_m, 8.0)


@pytest.mark.parametrize("per_row", [1.7, 2.0, 2.4, 2.7])
def test_rows_widen_the_band_of_the_mean_range_little(per_row):
    """GIVEN rows that are seen 1.7 to 2.7 times each THEN the band is half that of noise at most."""
    rng = np.random.default_rng(4)
    heights_m = 5e-3 * np.sin(2.0 * np.pi * np.arange(3000) / per_row + 0.7)
    ranges_m = 0.1 - heights_m + 1e-4 * rng.standard_normal(3000)
    assert band_over(ranges_m) < 0.5
    # the mean itself stays within it
    mean_m, means_m = 0.1, []
    for range_m in ranges_m:
        mean_m += (range_m - mean_m) / 8.0
        means_m.append(mean_m)
    widest_m = 3.0 * 5e-3 / math.sqrt(8.0)
    assert np.abs(np.array(means_m[100:]) - 0.1).max() < widest_m


@pytest.mark.parametrize("slope", [0.0, 1e-4])
def test_noise_has_the_band_of_noise(slope):
    """GIVEN white noise, over level ground or a slope THEN the band is that of independent ranges."""
    rng = np.random.default_rng(4)
    assert band_over(0.1 + slope * np.arange(3000) + 2e-4 * rng.standard_normal(3000)) == 1.0


@pytest.mark.parametrize("per_period", [2.5, 5.0])
@pytest.mark.parametrize("reading_s", [0.02, 0.004])
def test_a_blocked_sensor_with_a_hum_is_found(reading_s, per_period):
    """GIVEN a range that is blocked too long, with a hum of 2.5 or 5 samples THEN no contact while VALID."""
    job = Job(0.1, 0.04, reading_s, 0.004, 0.2, 4.0, 3e-5, (0.03, 0.3))
    for seed in range(4):

        def misread(t: float, range_m: float, rng: np.random.Generator, seed: int = seed) -> float:
            hum_m = 3e-3 * math.sin(2.0 * math.pi * t / (per_period * job.reading_s) + seed)
            return (0.11 if t > 8.0 else range_m) + hum_m

        run = follow(job, lambda x, t: 0.01 * math.sin(5.0 * x), 20.0, 0.1, misread=misread, seed=seed)
        valid = ["VALID" in state["status"] for state in run.states]
        assert run.clearance_m[valid].min() > 0.03
