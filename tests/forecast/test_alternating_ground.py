"""Ground that alternates from sample to sample: crop rows, furrows, corrugated sheet under a slow sensor.

With 1.3 to 5 samples per row the heights look like noise, and models of slopes see steep ones by chance.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow.benchmark.job_loop import Job, follow
from surffollow.forecast.estimation.noise import estimated_range_noise_m, update_noise
from surffollow.forecast.reset import reset_learned
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState

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


def noise_over(heights_m: np.ndarray) -> float:
    """Noise of ranges to such heights, over the noise of a reading [–]."""
    state, rng = zeros(AdaptiveState)[0], np.random.default_rng(4)
    reset_learned(state)
    for h_m in heights_m:
        state["estimate"]["samples"] += 1
        state["weights"]["scored"] += 1
        state["hold"]["range_m"] = 0.1 - h_m + 2e-4 * rng.standard_normal()
        update_noise(state, h_m)
        state["noise"]["sigma_m"] = 1.0  # heights have more
    return float(estimated_range_noise_m(state["noise"])) / 2e-4


@pytest.mark.parametrize("per_row", [2.0, 2.4, 3.0, 3.9, 5.0])
def test_ground_that_alternates_is_no_noise_of_the_range(per_row):
    """GIVEN rows of 10 mm that are seen 2 to 5 times each THEN at most a fourth of them counts as noise."""
    heights_m = 5e-3 * np.sin(2.0 * np.pi * np.arange(2000) / per_row)
    assert noise_over(heights_m) * 2e-4 < 1.3e-3


def test_noise_is_measured_as_from_sample_to_sample():
    assert noise_over(np.zeros(2000)) == pytest.approx(1.0, rel=0.2)
    slopes = 2e-3 * np.abs(np.arange(2000) % 200 - 100)  # 100 samples up, 100 down
    assert noise_over(slopes) == pytest.approx(1.0, rel=0.3)
