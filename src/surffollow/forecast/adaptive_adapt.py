"""Adapt the paper's Permitted_Variance to what is known of the ground; tell the smoothing in its terms.

Permitted_Variance is what may stay uncorrected. A change smaller than the uncertainty of the height itself
says nothing, so the uncertainty takes its place where it is larger: the robot is not made restless by what
may be noise. Interval_Size and Range_Size in force follow from the gain of the blended models.
"""

from __future__ import annotations

from typing import Any

from surffollow.forecast.adaptive_judge import SHARP, noise_part
from surffollow.shm.jit import jit
from surffollow.shm.layout_follow import INTERVALS

MOST_M = 2e-3
YOUNG_BAND = 3.5  # so much wider is the band at first
LEAST_GAIN = 1e-4


@jit
def adapt_band(params: Any, a: Any) -> None:
    """Set the way that the set point may stay away from where it is wanted."""
    a.permitted_m = max(params.permitted_variance_m, min(a.sigma_m, MOST_M))
    # while scores are young and all is noise, what models say is luck
    young = 1.0 - min(max(a.samples, a.scored), SHARP) / SHARP
    noise = noise_part(a)
    a.calm_band_m = params.calm_share * a.permitted_m * (1.0 + YOUNG_BAND * young * noise * noise)


@jit
def report_adapted(params: Any, a: Any, output: Any) -> None:
    """Tell Permitted_Variance, Interval_Size and Range_Size in force.

    A mean over n samples has the variance of a filter with gain 2 / (n + 1).
    """
    output.latency_s = params.sensor_latency_ns * 1e-9 + a.older_s
    output.permitted_variance_m = a.permitted_m
    if a.samples == 0:
        output.interval_size_m, output.range_size = params.interval_size_m, params.range_size
        return
    samples = 2.0 / min(max(a.gain, LEAST_GAIN), 1.0) - 1.0
    interval = max(min(params.interval_size_m, samples * a.sample_way_m), a.sample_way_m, 1e-6)
    output.interval_size_m = interval
    output.range_size = min(max(int(samples * a.sample_way_m / interval + 0.5), 1), INTERVALS // 2)
