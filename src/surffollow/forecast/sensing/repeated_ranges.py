"""Ranges in a row that repeat the first of them: some sensors hold ranges, or repeat the last on a loss."""

import math

from surffollow.forecast.estimation.noise import MIN_NOISE_M, estimated_range_noise_m
from surffollow.forecast.quantities import REPEAT_BAND
from surffollow.forecast.sensing.mean_range import MAX_READINGS, RUN_SAMPLES, range_band_m, range_sigma_m
from surffollow.forecast.sensing.sample_hold import resolution_m
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_sensing import RESPONSE_RUN

REPEAT_RATIO = 2.0  # in usual runs of repeated ranges: a longer one, of a mean at least, is a sign of a fault


@jit
def _learn_usual(usual, number):
    """Usual number of ranges in a run after one more run: a longer run is learned soon, but not at once."""
    more = number - usual
    return usual + more / (RUN_SAMPLES if more < 0.0 else MAX_READINGS)


@jit
def count_repeats(adaptive, range_m, tool_z_m):
    """Count ranges that repeat the first of them, and decide whether the newest one is of use.

    It is not when the tool has moved meanwhile. Two ranges with the noise σ differ by less than half a count
    q with the probability q / (2 √π σ). So few that are exactly equal suffice, when the tool is about to
    move. The usual numbers are learned: some sensors hold each range for a while.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (`repeats` updated)
    range_m : float64   range [m]
    tool_z_m : float64  height of the tool at its time [m]
    """
    repeats, sigma_m, step_m = adaptive.repeats, range_sigma_m(adaptive), resolution_m(adaptive.hold)
    setpoint_m, change_m = adaptive.setpoint.position_m, abs(range_m - repeats.range_m)
    if repeats.count == 0 or change_m > REPEAT_BAND * estimated_range_noise_m(adaptive.noise):
        if adaptive.response.phase == RESPONSE_RUN and repeats.count > 0:  # not of a run that a reset ended
            repeats.usual = _learn_usual(repeats.usual, repeats.count)
            repeats.usual_equal = _learn_usual(repeats.usual_equal, repeats.equal)
        repeats.count = repeats.equal = 1
        repeats.unused, repeats.chance = 0, 1.0
        repeats.range_m, repeats.tool_z_m, repeats.setpoint_m = range_m, tool_z_m, setpoint_m
        return
    repeats.count += 1
    if change_m == 0.0:
        repeats.equal += 1
        repeats.chance *= min(0.5 / math.sqrt(math.pi) * step_m / sigma_m, 1.0)
    # before the noise is known ranges may stay for long
    known = adaptive.weights.scored > 100 and estimated_range_noise_m(adaptive.noise) > MIN_NOISE_M
    moved_m, led_m = abs(tool_z_m - repeats.tool_z_m), abs(setpoint_m - repeats.setpoint_m)
    # chance makes four of a row near each other now and then; counts of a coarse sensor are all that near
    often = repeats.count >= max(REPEAT_RATIO * repeats.usual, 5.0)
    near = often and moved_m > range_band_m(adaptive) and step_m < REPEAT_BAND * sigma_m
    # such a chance comes once in 400 s at 250 Hz, and the tool must be about to move just then
    held = repeats.equal >= REPEAT_RATIO * repeats.usual_equal and repeats.chance < 1e-5
    if known and (near or (held and max(moved_m, led_m) > range_band_m(adaptive))):
        repeats.unused = 1


@jit
def is_repeated(repeats):
    """Whether the newest ranges are repeated far more often than usual."""
    return repeats.count >= max(REPEAT_RATIO * repeats.usual, MAX_READINGS)
