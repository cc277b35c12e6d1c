"""A run of constant ranges under a tool that moves: its mean, its spread, and signs of a fault in it.

A sensor that no longer sees the ground (stuck, or blocked by something that moves with it) reads a constant
range with any noise. The ground then seems to move with the tool.
A follower that tracks a plane well reads a constant range, too, but that is the wanted one, with noise. A run
with a sign of a fault is tested (`response`).
"""

from surffollow.forecast.estimation.noise import MIN_NOISE_M
from surffollow.forecast.quantities import APART_M, LEVEL_SHARE, SLOW_RATE
from surffollow.forecast.sensing import mean_range
from surffollow.forecast.sensing.kinematics import is_at_rest, path_speed
from surffollow.forecast.sensing.repeated_ranges import is_repeated
from surffollow.forecast.sensing.sample_hold import is_slow
from surffollow.shm import layout_adaptive_sensing as layout
from surffollow.shm.jit import jit

MOTION_BANDS = 4.0  # motion of a test: shorter descents, and ranges that change less, hide in the noise
SHIFT_DESCENT = 0.25  # of the stand-off: from such a descent on the setpoint is shifted up without a sign
MAX_DESCENT = 0.8  # of the stand-off: a tool that would descend farther before it stops is held at once
MAX_UNSEEN = 0.35  # of the stand-off: clearance that may be lost unseen
STEADY_M = 0.3  # over which ground with a mean slope has it: that of shorter waves is small
ANSWER_TAUS = 10.0  # in which a range may change under a tool that climbs: on ground that bends it may stay
MIN_MEANS = 2.0  # independent means in an answer or a run; twice as many in a run without a suspicion


@jit
def begin_run(params, adaptive, tool_z_m, range_m):
    """Begin a run of ranges with this mean, over the present slope, for this stand-off."""
    run = adaptive.run
    run.slope, run.lasting_slope = adaptive.estimate.slope, run.mean_slope
    run.steady_slope, run.travel_m = run.path_slope, 0.0
    run.offset_m = params.offset_m
    run.range_m, run.mean_m, run.samples, run.rate_mps = range_m, range_m, 0, 0.0
    run.top_z_m = run.low_z_m = tool_z_m
    run.band_m = mean_range.range_band_m(adaptive)


@jit
def turn_back(run):
    """Turn the slopes along the path with the direction of travel."""
    run.path_slope, run.steady_slope = -run.path_slope, -run.steady_slope


@jit
def forget_slopes(run):
    """Over other ground its slope along the path is not known."""
    run.path_slope = run.steady_slope = 0.0


@jit
def moves_tool(response):
    """Whether a test of the response holds, lifts or shifts the tool."""
    return response.phase != layout.RESPONSE_RUN or response.lift_m > 0.0


@jit
def update_mean(adaptive, range_m, sigma_m, most_m):
    """Update mean, spread and travel of the run, the running mean, usual error outside tests, and slopes.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (`run` updated)
    range_m : float64  range [m]
    sigma_m : float64  standard deviation of ranges [m]; more is no noise, and not learned as usual
    most_m : float64   a range moves the mean as if it were so far away at most [m]
    """
    run, number = adaptive.run, mean_range.samples_in_mean(adaptive)
    deviation_m = min(max(range_m - run.mean_m, -most_m), most_m)
    run.mean_m += deviation_m / number
    noise_m = min(abs(deviation_m), mean_range.BAND_SIGMAS * sigma_m)
    run.spread_m += (noise_m - run.spread_m) / (2.0 * MIN_MEANS * number)
    if not is_quiet(run):  # noise far below the usual one is not learned
        run.usual_m += SLOW_RATE * (min(run.spread_m, sigma_m) - run.usual_m)
    if not moves_tool(adaptive.response) and run.offset_m > 0.0:  # not before the first run
        # another controller may have led the tool far away
        error_m = min(abs(run.mean_m - run.offset_m), 0.03 * run.offset_m)
        run.error_m += SLOW_RATE * (error_m - run.error_m)
    run.samples += 1
    rate = min(1.0, adaptive.hold.interval_s / (ANSWER_TAUS * adaptive.plant.tau_s))
    run.mean_slope += rate * (adaptive.estimate.slope - run.mean_slope)
    if not is_at_rest(adaptive.kinematics):
        travel_m = adaptive.kinematics.speed_mps * adaptive.hold.interval_s
        run.travel_m += travel_m
        run.path_slope += min(1.0, travel_m / STEADY_M) * (adaptive.estimate.slope - run.path_slope)
    # its own mean is the better known one, but in the test of a descent the middle of a spread is
    if adaptive.response.swing_m == 0.0 and number < run.samples < mean_range.RUN_SAMPLES:
        run.range_m += (run.mean_m - run.range_m) / run.samples


@jit
def is_quiet(run):
    """Whether the ranges have far less than their usual noise, which is not below what the bank assumes."""
    return run.usual_m > MIN_NOISE_M and run.spread_m < 0.5 * run.usual_m


@jit
def observe_motion(run, tool_z_m, climb_mps):
    """Update the motion of the tool in the run; its descent and its ascent since [m]."""
    run.top_z_m, run.low_z_m = max(run.top_z_m, tool_z_m), min(run.low_z_m, tool_z_m)
    run.rate_mps += (abs(climb_mps) - run.rate_mps) / run.samples
    return run.top_z_m - tool_z_m, tool_z_m - run.low_z_m


@jit
def proven_descent_m(params, adaptive, rate_s, sparse):
    """Descent behind an answer that is not tested [m], at the rate of the run for a time `rate_s` at least.

    Where the range responded at r, the ground lay at r. The tool may descend by r − s₀ and another 0.25 s₀,
    less where the next answer takes long. Of a slow sensor chance may have made the answer: r does not count.
    """
    offset_m = params.offset_m
    room_m = MAX_DESCENT * offset_m - adaptive.run.rate_mps * rate_s
    higher_m = 0.0 if sparse else adaptive.response.proven_m - offset_m
    return min(SHIFT_DESCENT * offset_m, room_m) + higher_m


@jit
def sign_of_fault(adaptive, motion_m, sunk_m):
    """Sign of a fault in the run.

    Parameters
    ----------
    adaptive : record of `AdaptiveState`
    motion_m : float64  motion of the run that counts [m]
    sunk_m : float64    descent of the run less its ascent [m]

    Returns
    -------
    int
        NO_SIGN; SIGN_FOR_SHIFT: a slight one, or a long motion, for which the setpoint is shifted up;
        SIGN_FOR_HOLD: one for which the tool is held.
    """
    run, lag_s, band_m = adaptive.run, adaptive.plant.tau_s, mean_range.range_band_m(adaptive)
    number = mean_range.samples_in_mean(adaptive)
    if is_slow(adaptive):  # over falling ground the tool is late by part of the interval
        lag_s += LEVEL_SHARE / mean_range.LAG_TAUS * adaptive.hold.interval_s
    repeats, quiet = is_repeated(adaptive.repeats), is_quiet(run)
    below = abs(adaptive.sample.lead_m) < APART_M
    error_m = abs(run.range_m - run.offset_m) if below else 0.0
    unusual = error_m > 3.0 * run.error_m  # over ground that accelerates it is less
    suspicious = mean_range.is_suspicious(error_m, motion_m, run.rate_mps, band_m, lag_s, run.offset_m)
    grave = (unusual and suspicious) or repeats or quiet or adaptive.rotation.phase == layout.ROTATION_FAILED
    hidden_m = MOTION_BANDS * band_m  # in the noise
    # over ground that falls ever faster a good tool is late; an axis quicker than its model runs away
    excess_mps = -adaptive.kinematics.climb_mps - 1.5 * run.rate_mps
    runs_away = excess_mps * adaptive.plant.tau_s > band_m and motion_m > SHIFT_DESCENT * run.offset_m
    if (grave or runs_away) and motion_m > hidden_m:
        return layout.SIGN_FOR_HOLD
    # ground that rose steadily before the run may rise on
    rise_m = max(run.steady_slope, 0.0) * min(run.travel_m, STEADY_M)
    if below and rise_m > hidden_m and sunk_m + rise_m > MAX_UNSEEN * run.offset_m:
        return layout.SIGN_FOR_SHIFT
    if motion_m <= hidden_m:
        return layout.NO_SIGN
    # with fewer samples in τ the ground changes while an answer is awaited
    few = number < mean_range.MAX_READINGS
    lags = few or error_m <= mean_range.LAG_TAUS * lag_s * run.rate_mps
    # a shift needs a sixth of the error and motion for which the tool is held
    slight = lags or error_m * motion_m <= mean_range.ERROR_MOTION / 6.0 * band_m * run.offset_m
    if not below:  # the ground under the tool is not seen: it may rise as when the run began
        run_s = run.samples * adaptive.hold.interval_s
        motion_m += max(run.slope, 0.0) * path_speed(adaptive.kinematics) * run_s
    if slight and motion_m <= SHIFT_DESCENT * run.offset_m:
        return layout.NO_SIGN
    return layout.SIGN_FOR_SHIFT
