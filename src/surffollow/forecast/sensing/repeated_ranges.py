"""Ranges in a row that repeat the first of them: some sensors hold ranges, or repeat the last on a loss."""

from surffollow.forecast.estimation.innovation_gate import gate_width
from surffollow.forecast.estimation.noise import MIN_NOISE_M, estimated_range_noise_m
from surffollow.forecast.quantities import REPEAT_BAND
from surffollow.forecast.sensing.mean_range import MAX_READINGS, RUN_SAMPLES, range_band_m
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_sensing import RESPONSE_RUN

REPEAT_RATIO = 2.0  # in usual runs of repeated ranges: a longer one, of a mean at least, is a sign of a fault


@jit
def count_repeats(params, adaptive, range_m, tool_z_m):
    """Count repeated ranges, and whether the newest one is of use; update the usual number of a good sensor.

    Repeats that end with an outlier may have been a loss, unless they are frequent: some sensors hold ranges.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`repeats` updated)
    range_m : float64   range [m]
    tool_z_m : float64  height of the tool at its time [m]
    """
    repeats, sigma_m = adaptive.repeats, estimated_range_noise_m(adaptive.noise)
    change_m = abs(range_m - repeats.range_m)
    if repeats.count == 0 or change_m > REPEAT_BAND * sigma_m:
        more, outlier = repeats.count - repeats.usual, change_m > gate_width(params, adaptive)
        if adaptive.response.phase == RESPONSE_RUN:
            repeats.usual += more / (RUN_SAMPLES if more < 0.0 else 8.0 if outlier else 1.0)
        repeats.count, repeats.range_m, repeats.tool_z_m, repeats.unused = 1, range_m, tool_z_m, 0
        return
    repeats.count += 1
    # chance makes four of a row now and then; without noise, or before it is known, ranges stay for long
    often = repeats.count >= max(REPEAT_RATIO * repeats.usual, 5.0) and sigma_m > MIN_NOISE_M
    known = adaptive.weights.scored > 100 and repeats.usual > 0.0
    if often and known and abs(tool_z_m - repeats.tool_z_m) > range_band_m(adaptive):
        repeats.unused = 1


@jit
def is_repeated(repeats):
    """Whether the newest ranges are repeated far more often than usual."""
    return repeats.count >= max(REPEAT_RATIO * repeats.usual, MAX_READINGS)
