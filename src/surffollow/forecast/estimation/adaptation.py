"""Permitted_Variance in force; the smoothing as Interval_Size and Range_Size.

Permitted_Variance is the change of the demand that is not relayed. Where the standard deviation of the height
is larger, it takes its place. Interval_Size and Range_Size in force follow from the gain of the blend.
"""

from surffollow.shm.jit import jit
from surffollow.shm.layout_follow import INTERVALS


@jit
def permitted_variance_m(params, adaptive):
    """Permitted_Variance in force [m]; more uncertainty than 2 mm raises it no farther."""
    return max(params.permitted_variance_m, min(adaptive.estimate.sigma_m, 2e-3))


@jit
def publish_adaptation(params, adaptive, output):
    """Publish Permitted_Variance, Interval_Size and Range_Size in force.

    A mean over n samples has the variance of a filter with gain 2 / (n + 1).
    """
    sample, estimate = adaptive.sample, adaptive.estimate
    output.latency_s = params.sensor_latency_ns * 1e-9 + adaptive.latency.correction_s
    output.permitted_variance_m = permitted_variance_m(params, adaptive)
    if estimate.samples == 0:
        output.interval_size_m, output.range_size = params.interval_size_m, params.range_size
        return
    samples = 2.0 / min(max(estimate.gain, 1e-4), 1.0) - 1.0  # a bound on what is published
    interval = max(min(params.interval_size_m, samples * sample.spacing_m), sample.spacing_m, 1e-6)
    output.interval_size_m = interval
    output.range_size = min(max(int(samples * sample.spacing_m / interval + 0.5), 1), INTERVALS // 2)
