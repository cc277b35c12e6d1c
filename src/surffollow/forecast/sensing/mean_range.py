"""Mean of the newest ranges, the band within which noise alone keeps it, and errors that are no lag."""

import math

from surffollow.forecast.estimation.noise import range_noise_m
from surffollow.forecast.sensing.sample_hold import resolution_m
from surffollow.shm.jit import jit

RUN_SAMPLES = 64  # in the mean of a run of constant ranges, and runs in the usual length of repeated ranges
MIN_READINGS, MAX_READINGS = 2.0, 8.0  # samples in the mean range: those of a time constant
BAND_SIGMAS = 3.0  # of the mean: the range has changed; of a sample, which moves the mean by no more
ERROR_MOTION = 0.36  # of a band times the reach: error times motion; a small one needs a long one
LAG_TAUS = 0.3  # errors that so great a lag of the axis model explains are no sign of a fault
TEST_BAND_FACTOR = 1.5  # … beyond the chance of many looks, in bands: during a test and after it


@jit
def samples_in_mean(adaptive):
    """Samples in a mean range: those of a time constant, within limits."""
    interval_s = max(adaptive.hold.interval_s, 1e-6)
    return min(max(adaptive.plant.tau_s / interval_s, MIN_READINGS), MAX_READINGS)


@jit
def mean_band_m(sigma_m, number):
    """Change of a mean of `number` ranges of standard deviation σ that noise explains [m]."""
    return BAND_SIGMAS * sigma_m / math.sqrt(number)


@jit
def range_sigma_m(adaptive):
    """Standard deviation of a range of channel 0, that of the quantisation at least [m]."""
    return max(range_noise_m(adaptive.noise), resolution_m(adaptive.hold) / math.sqrt(12.0))


@jit
def range_band_m(adaptive):
    """Change of the mean range of channel 0 that noise explains [m]."""
    return mean_band_m(range_sigma_m(adaptive), samples_in_mean(adaptive))


@jit
def is_suspicious(error, motion, rate, band, tau_s, reach):
    """Whether an error that does not change is too great for a lag, and for the motion of the run.

    Parameters
    ----------
    error, motion, rate, band : float64  error, motion of the tool and its rate, band of the noise [m or rad]
    tau_s : float64                      time constant of the axis [s]
    reach : float64                      motion that the surface leaves to the tool [m or rad]
    """
    return error > max(band, LAG_TAUS * tau_s * rate) and error * motion > ERROR_MOTION * band * reach
