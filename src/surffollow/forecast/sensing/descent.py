"""Descents that the ranges do not explain: the ground seems to fall by as much as the tool descends.

A sensor that sees something else than the ground (a hose that sways below it, an echo, noise) may read ranges
that vary, and do not depend on the tool. Where their mean is longer than the stand-off, the tool descends and
descends. Over ground that stays, a descent makes the range shorter, and ends after two mean errors at most.
Over ground that falls, the mean error is small beside the spread of the ranges. The health is SUSPECT when
neither is so, and the ground would be steep. Below the lowest ground so far such a descent is tested
(`response`).
"""

import math

from surffollow.forecast.estimation.noise import range_noise_m
from surffollow.forecast.quantities import APART_M, LONG_GAP_NS, PLAUSIBLE_SLOPE
from surffollow.forecast.sensing import mean_range
from surffollow.forecast.sensing.constant_ranges import MIN_MEANS, MOTION_BANDS
from surffollow.forecast.sensing.response import SWINGS, answer_s
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_sensing import RESPONSE_RUN

SPREAD_TAUS = 50.0  # in which the spread of the ranges fades


@jit
def begin_descent(adaptive, tool_z_m, reach_m):
    """Begin at this height without a range; shorter descents than `reach_m` are taken as explained."""
    descent = adaptive.descent
    descent.floor_z_m, descent.reach_m = min(descent.floor_z_m, descent.low_z_m), reach_m
    descent.slope = math.sqrt(adaptive.estimate.slope_power)
    descent.samples, descent.error_m, descent.travel_m = 0, 0.0, 0.0
    descent.top_z_m = descent.low_z_m = tool_z_m


@jit
def _update_mean(adaptive, range_m, error_samples):
    """Update running mean and spread of the ranges; the range, within three mean deviations [m].

    At first a range whose noise has grown counts as an outlier, too.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (`descent` updated)
    range_m : float64        range [m]
    error_samples : float64  number of samples in the mean deviation
    """
    descent, number = adaptive.descent, mean_range.samples_in_mean(adaptive)
    most_m = mean_range.BAND_SIGMAS * max(descent.scatter_m, range_noise_m(adaptive.noise))
    deviation_m = min(max(range_m - descent.range_m, -most_m), most_m)
    descent.scatter_m += (abs(deviation_m) - descent.scatter_m) / error_samples
    range_m = descent.range_m + deviation_m
    fade = min(adaptive.hold.interval_s / (SPREAD_TAUS * adaptive.plant.tau_s), 1.0)
    descent.range_m += (range_m - descent.range_m) / number
    descent.least_m = min(descent.least_m + fade * (descent.range_m - descent.least_m), descent.range_m)
    descent.most_m = max(descent.most_m + fade * (descent.range_m - descent.most_m), descent.range_m)
    return range_m


@jit
def observe_descent(params, adaptive, t_ns, range_m, tool_z_m):
    """Update the descent with a sample of channel 0; half the spread of the ranges if it is to be tested [m].

    With mean error e, fall Δz, spread ±B of the ranges, stand-off s₀, RMS slope m before the descent and the
    distance d travelled it is unexplained if

        e > 0.02 s₀, Δz > 3 e, e Δz > 0.36 B s₀, Δz > 0.2 d, Δz > L

    It is to be tested L below the lowest height before, if B < 0.1 s₀ and Δz > 2 m d, unless the tool comes
    back from another test. Falling ground must stay in the window until it is answered. The test ends it.
    L is 0.1 s₀, and twice as much behind each test that the range answers and each fall of s₀, until the tool
    rises. With fewer than eight samples in τ the tool would lag too far behind falling ground in a test.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`descent` updated)
    t_ns : int64         timestamp
    range_m : float64    range [m]
    tool_z_m : float64   height of the tool at that time [m]

    Returns
    -------
    float64  half the spread ±B of the ranges, if the descent is to be tested [m]; 0: it is not
    """
    descent, before_ns, band = adaptive.descent, adaptive.response.t_ns, mean_range.range_band_m(adaptive)
    error_samples = 8.0 * mean_range.samples_in_mean(adaptive)  # with more a slow sensor is named later
    share_m = 0.1 * params.offset_m  # below the lowest ground until then a descent is tested
    if before_ns == 0 or not 0 < t_ns - before_ns < LONG_GAP_NS:
        descent.range_m = descent.least_m = descent.most_m = range_m
        descent.floor_z_m = descent.low_z_m = tool_z_m
        descent.offset_m, descent.changed_ns = params.offset_m, t_ns - LONG_GAP_NS
        begin_descent(adaptive, tool_z_m, share_m)
    if params.offset_m != descent.offset_m:
        descent.offset_m, descent.changed_ns = params.offset_m, t_ns
    changing = t_ns - descent.changed_ns < 1e9 * answer_s(adaptive, MIN_MEANS)  # on its way to a stand-off
    if changing or adaptive.response.swing_m > 0.0:  # or in its test
        begin_descent(adaptive, tool_z_m, descent.reach_m)
        descent.unexplained = 0
        return 0.0
    range_m = _update_mean(adaptive, range_m, error_samples)
    fall_m, rise_m = descent.top_z_m - descent.low_z_m, tool_z_m - descent.low_z_m
    if rise_m > min(fall_m, max(MOTION_BANDS * band, 0.1 * fall_m)):  # another descent begins
        begin_descent(adaptive, tool_z_m, share_m)
    elif fall_m > params.offset_m:  # over ground that stays the tool would have touched it
        begin_descent(adaptive, tool_z_m, 2.0 * descent.reach_m)
    descent.low_z_m = min(descent.low_z_m, tool_z_m)
    descent.samples += 1
    newest = min(float(descent.samples), error_samples)
    descent.error_m += (range_m - params.offset_m - descent.error_m) / newest
    descent.travel_m += adaptive.kinematics.speed_mps * adaptive.hold.interval_s
    spread_m = max(0.5 * (descent.most_m - descent.least_m), band)
    unexplained = _is_unexplained(params, adaptive, tool_z_m, spread_m)
    descent.unexplained = 1 if unexplained else 0
    if not unexplained or not _is_testable(params, adaptive, t_ns, tool_z_m, spread_m):
        return 0.0
    descent.reach_m *= 2.0
    return spread_m


@jit
def _is_unexplained(params, adaptive, tool_z_m, spread_m):
    """Whether the mean range is too long for so long and steep a descent, as in `observe_descent`.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState`
    tool_z_m : float64  height of the tool [m]
    spread_m : float64  half the spread of the means, the band at least [m]
    """
    descent, error_m = adaptive.descent, adaptive.descent.error_m
    fall_m = descent.top_z_m - tool_z_m
    # a smaller share of the stand-off takes a descent of fifty errors or more to the ground
    least_m = max(mean_range.range_band_m(adaptive), 0.02 * params.offset_m)
    known = descent.samples > 2.0 * mean_range.samples_in_mean(adaptive)
    long = known and error_m > least_m and fall_m > 3.0 * error_m  # over ground that stays it is two at most
    great = error_m * fall_m > mean_range.ERROR_MOTION * spread_m * params.offset_m
    steep = fall_m > max(PLAUSIBLE_SLOPE * descent.travel_m, descent.reach_m)
    return long and great and steep and abs(adaptive.sample.lead_m) < APART_M


@jit
def _is_testable(params, adaptive, t_ns, tool_z_m, spread_m):
    """Whether an unexplained descent is to be tested, as in `observe_descent`.

    The answer must stand out from the spread, and come in time: with few samples it is late. The ground falls
    at the rate of the tool until the tool, which was held, follows again.

    Parameters
    ----------
    params, adaptive, tool_z_m, spread_m : as in `_is_unexplained`
    t_ns : int64  timestamp of the sample
    """
    descent, response, estimate = adaptive.descent, adaptive.response, adaptive.estimate
    known = estimate.samples * adaptive.hold.interval_s > SPREAD_TAUS * adaptive.plant.tau_s
    quick = mean_range.samples_in_mean(adaptive) >= mean_range.MAX_READINGS
    narrow = spread_m < 0.1 * params.offset_m  # so that an answer can exceed it
    lasts_s = 2.0 * answer_s(adaptive, MIN_MEANS) + adaptive.plant.tau_s  # a hold and a lift
    falls_m = abs(adaptive.kinematics.climb_mps) * lasts_s
    has_room = descent.error_m + SWINGS[1] * spread_m + falls_m < params.range_max_m - params.offset_m
    # ground that was steep before may fall as steeply
    steeper = descent.top_z_m - tool_z_m > 2.0 * descent.slope * descent.travel_m
    deep = steeper and tool_z_m < descent.floor_z_m - descent.reach_m
    idle = response.phase == RESPONSE_RUN and t_ns >= response.settled_ns
    return known and quick and narrow and has_room and deep and idle
