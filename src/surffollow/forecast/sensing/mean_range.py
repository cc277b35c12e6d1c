"""Mean of the newest ranges, and the band within which noise alone keeps it."""

from surffollow.shm.jit import jit

RUN_SAMPLES = 64  # in the mean of a run of constant ranges, and runs in the usual length of repeated ranges
MIN_READINGS, MAX_READINGS = 2.0, 8.0  # samples in the mean range: those of a time constant
BAND_SIGMAS = 3.0  # of the mean: the range has changed; of a sample, which moves the mean by no more
TEST_BAND_FACTOR = 1.5  # … beyond the chance of many looks, in bands: during a test and after it


@jit
def mean_samples(adaptive):
    """Samples in a mean range: those of a time constant, within limits."""
    interval_s = max(adaptive.prediction.interval_s, 1e-6)
    return min(max(adaptive.plant.tau_s / interval_s, MIN_READINGS), MAX_READINGS)


@jit
def mean_band_m(sigma_m, number):
    """Change of a mean of `number` ranges of standard deviation σ that noise explains [m]."""
    return BAND_SIGMAS * sigma_m / number**0.5
