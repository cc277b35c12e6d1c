"""Response of the range to the tool's own motion: an active test of the sensor.

A sensor that no longer sees the ground (stuck, or blocked by something that moves with it) reads a constant
range with any noise. The tool then makes the ground move by itself: what it descends, the height falls, and
what it climbs, the height rises.
A follower that tracks a plane well reads a constant range, too, but that is the wanted one, with the usual
noise. A descent with a constant range that is not the wanted one, or with far less noise, is tested: the tool
stops (`RESPONSE_HOLD`), and the range must change by the motion that does not take place. If it does not, the
tool rises (`RESPONSE_LIFT`), and the range must follow.
In a longer motion the setpoint is shifted up by a little more than the noise hides. A range that grows by
the shift ends the run; without that, or after a descent by half the stand-off, a hold follows. An ascent
leads away from the ground: it is tested by that shift, and then by a greater one, but never held.
"""

from surffollow.forecast.estimation.noise import MIN_NOISE_M
from surffollow.forecast.terrain.terrain_buffer import MIN_LEAD_M
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_sensing import (
    RESPONSE_FAILED,
    RESPONSE_HOLD,
    RESPONSE_LIFT,
    RESPONSE_RUN,
    ROTATION_FAILED,
)

MOTION_BANDS = 4.0  # motion of a test: shorter descents, and ranges that change less, hide in the noise
ERROR_MOTION = 0.36  # of a band times the reach: error times motion; a small one needs a long one
FAR_DESCENT = 0.5  # of the stand-off: beyond, a constant range is always tested, before the tool can touch
ASCENT_SHARE = 0.25  # of an ascent counts
SHIFT_ERROR_MOTION = 0.06  # error times descent as above from which a fast sensor is tested by a shift
SHIFT_DESCENT = 0.25  # of the stand-off: beyond, the setpoint is shifted up …
SHIFT_BANDS = 2.0  # … by so many bands; an answer spares the hold
LAG_TAUS = 0.3  # errors that so great a lag of the axis model explains are no sign of a fault
QUIET_SHARE = 0.5  # of the usual noise
NOISE_RATE, USUAL_RATE = 0.03, 0.003  # of the noise and of the usual noise, per sample
SECOND_DIFFERENCE = 1.954  # mean absolute second difference of white Gaussian noise, in standard deviations
MIN_MEANS, MIN_LONG_MEANS = 2.0, 4.0  # independent means in an answer or a run; in a run without a suspicion
RUN_SAMPLES = 64  # in the mean of a run
MIN_MEAN, MAX_MEAN = 2.0, 8.0  # samples in the mean range: those of a time constant
BAND_SIGMAS = 3.0  # of the mean: the range has changed …
TEST_BAND_FACTOR = 1.5  # … beyond the chance of many looks, in bands: during a test and after it
OUTLIER_SIGMAS = 3.0  # one sample moves the mean by no more
STOP_TAUS = 2.0  # until the tool has stopped, or follows a shift, behind the delay of the samples
ANSWER_TAUS = 10.0  # in which a range may change under a tool that climbs: on ground that bends it may stay
MAX_PHASE_TAUS = 50.0  # after which a tool that does not do as it is asked ends the test


@jit
def _begin_run(response, t_ns, tool_z_m):
    """Begin a run of constant ranges at the present mean."""
    response.phase, response.count = RESPONSE_RUN, 0
    response.run_range_m, response.run_samples = response.mean_m, 0
    response.top_z_m = response.low_z_m = tool_z_m
    response.top_ns = response.low_ns = t_ns
    response.lift_m = 0.0


@jit
def _observe_noise(response, range_m):
    """Update the noise and the usual noise of the ranges; noise far below the usual one is not learned."""
    second = abs(range_m - 2.0 * response.recent_m[0] + response.recent_m[1]) / SECOND_DIFFERENCE
    response.recent_m[1] = response.recent_m[0]
    response.recent_m[0] = range_m
    response.samples += 1
    if response.samples <= 2:
        return
    rate = max(NOISE_RATE, 1.0 / (response.samples - 2))
    response.noise_m += rate * (min(second, 4.0 * max(response.noise_m, MIN_NOISE_M)) - response.noise_m)
    if response.samples * NOISE_RATE < 2.0:
        response.usual_m = response.noise_m
    elif response.noise_m > QUIET_SHARE * response.usual_m:
        response.usual_m += USUAL_RATE * min(response.noise_m - response.usual_m, response.usual_m)


@jit
def _update_mean(response, range_m, sigma_m, number):
    """Update the mean of `number` ranges, and that of the run, with a range of standard deviation σ [m]."""
    least = min(range_m, response.recent_m[0], response.recent_m[1]) - response.mean_m
    greatest = max(range_m, response.recent_m[0], response.recent_m[1]) - response.mean_m
    outlier = OUTLIER_SIGMAS * sigma_m
    moved = least > outlier or greatest < -outlier  # three in a row are no outliers
    if moved and response.samples > 2:
        response.mean_m = range_m
    response.mean_m += min(max(range_m - response.mean_m, -outlier), outlier) / number
    response.run_samples += 1
    if number < response.run_samples < RUN_SAMPLES:  # its own mean is the better known one
        share = 1.0 / response.run_samples
        response.run_range_m += share * (response.mean_m - response.run_range_m)


@jit
def _is_noisy(response):
    """Whether the ranges have about the usual noise."""
    return response.noise_m >= QUIET_SHARE * response.usual_m


@jit
def _responds(response, band_m):
    """Whether the mean range has left the band of the run, or the noise is back after a failed test."""
    factor = 1.0 if response.phase == RESPONSE_RUN else TEST_BAND_FACTOR
    noise_is_back = response.phase == RESPONSE_FAILED and response.quiet != 0 and _is_noisy(response)
    return abs(response.mean_m - response.run_range_m) > factor * band_m or noise_is_back


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


@jit
def _excess_lead_m(adaptive, tool_z_m):
    """Distance by which the setpoint is ahead of the tool beyond what its climb explains [m]."""
    climb_m = adaptive.kinematics.climb_mps * (adaptive.plant.tau_s + adaptive.latency.delay_s)
    return adaptive.setpoint.position_m - tool_z_m - climb_m


@jit
def _update_run(params, adaptive, t_ns, tool_z_m, number, band_m):
    """Shift the setpoint, or begin a hold, in a motion with a constant range that gives cause to it.

    An ascent leads away from the ground: it counts a fourth. After a shift without answer it is tested by a
    greater one, under a slow sensor not at all.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`response` updated)
    t_ns : int64        timestamp of the sample
    tool_z_m : float64  height of the tool at that time [m]
    number : float64    ranges in their mean
    band_m : float64    the mean has changed when it changes by more [m]
    """
    response, tau, standoff_m = adaptive.response, adaptive.plant.tau_s, params.offset_m
    interval = max(adaptive.prediction.interval_s, 1e-6)
    if tool_z_m > response.top_z_m:
        response.top_z_m, response.top_ns = tool_z_m, t_ns
    if tool_z_m < response.low_z_m:
        response.low_z_m, response.low_ns = tool_z_m, t_ns
    descent, ascent = response.top_z_m - tool_z_m, tool_z_m - response.low_z_m
    fast = number >= MAX_MEAN  # with fewer samples in τ the ground changes while an answer is awaited
    rises = ASCENT_SHARE * ascent > descent and descent < band_m  # it has not turned down since
    if rises and number <= MIN_MEAN:
        return
    if rises:
        band_m = max(band_m, BAND_SIGMAS * response.usual_m / number**0.5)  # a coarse sensor has a small σ
    motion, moved, since_ns = descent, descent, t_ns - response.top_ns
    if rises:
        motion, moved, since_ns = ASCENT_SHARE * ascent, ascent, t_ns - response.low_ns
    rate = moved / max(since_ns * 1e-9, interval)
    below = abs(adaptive.sample.lead_m) < MIN_LEAD_M
    error = abs(response.run_range_m - standoff_m) if below else 0.0
    wrong = is_suspicious(error, motion, rate, band_m, tau, standoff_m)
    noisy, perceptible = _is_noisy(response), motion > MOTION_BANDS * band_m
    long = response.run_samples > MIN_LONG_MEANS * number
    doubtful = (
        fast
        and perceptible
        and error > LAG_TAUS * tau * rate
        and error * motion > SHIFT_ERROR_MOTION * band_m * standoff_m
    )
    suspicious = (wrong or not noisy or adaptive.rotation.phase == ROTATION_FAILED) and perceptible
    shifts = doubtful or motion > SHIFT_DESCENT * standoff_m or (rises and suspicious)
    if long and response.lift_m == 0.0 and shifts:
        response.lift_m, response.test_ns = SHIFT_BANDS * band_m, t_ns
    since_s = (t_ns - response.test_ns) * 1e-9
    late = response.lift_m > 0.0 and since_s > stop_s(adaptive) + MIN_MEANS * number * interval
    far = long and motion > FAR_DESCENT * standoff_m
    at_once = far or (suspicious and response.run_samples > MIN_MEANS * number)
    if late or (at_once and not rises):
        response.phase, response.count = RESPONSE_LIFT if rises else RESPONSE_HOLD, 0
        response.test_ns, response.test_z_m = t_ns, tool_z_m
        response.rate_mps, response.quiet = -rate if rises else rate, 0 if noisy else 1
        if rises:
            response.added_m = MOTION_BANDS * band_m + tau * rate  # it stands out from the lag of the axis
            response.lift_m += response.added_m
            response.lead_m = _excess_lead_m(adaptive, tool_z_m)


@jit
def stop_s(adaptive):
    """Time from the sample that causes a hold or a shift until the tool has obeyed [s]."""
    return adaptive.latency.delay_s + STOP_TAUS * adaptive.plant.tau_s


@jit
def _update_test(adaptive, t_ns, tool_z_m, number, band_m):
    """Go from a hold to a lift, and from a lift, or the greater shift of an ascent, to its end.

    Parameters
    ----------
    adaptive, t_ns, tool_z_m, number, band_m : as in `_update_run`
    """
    response, tau_s = adaptive.response, adaptive.plant.tau_s
    since_s = (t_ns - response.test_ns) * 1e-9
    if response.phase == RESPONSE_HOLD:
        missing = response.rate_mps * (since_s - stop_s(adaptive))
        if missing > MOTION_BANDS * band_m or since_s > MAX_PHASE_TAUS * tau_s:
            response.phase, response.test_ns, response.test_z_m = RESPONSE_LIFT, t_ns, tool_z_m
            response.lift_m, response.count = MOTION_BANDS * band_m, 0
    elif response.phase == RESPONSE_LIFT:
        if response.rate_mps < 0.0:
            _update_ascent(adaptive, t_ns, tool_z_m, band_m)
        elif tool_z_m - response.test_z_m > 0.5 * response.lift_m:
            response.count += 1
            if response.count > MIN_MEANS * number:
                response.phase = RESPONSE_FAILED
        elif since_s > MAX_PHASE_TAUS * tau_s:
            _begin_run(response, t_ns, tool_z_m)


@jit
def _update_ascent(adaptive, t_ns, tool_z_m, band_m):
    """End the greater shift of an ascent, to which the range has not responded.

    A tool that obeys has risen by it, and the setpoint is ahead of it by no more than before. Otherwise
    another controller leads the tool, or its axis cannot climb faster, and a new run begins.

    Parameters
    ----------
    adaptive, t_ns, tool_z_m, band_m : as in `_update_run`
    """
    response = adaptive.response
    since_s = (t_ns - response.test_ns) * 1e-9
    if tool_z_m < response.test_z_m - band_m:  # it has turned down
        response.phase, response.test_ns, response.test_z_m = RESPONSE_HOLD, t_ns, tool_z_m
        response.rate_mps = band_m / since_s
    elif since_s > stop_s(adaptive) + ANSWER_TAUS * adaptive.plant.tau_s:
        applied = adaptive.setpoint.t_ns != 0  # not in FREEZE
        if not applied or _excess_lead_m(adaptive, tool_z_m) - response.lead_m > 0.5 * response.added_m:
            _begin_run(response, t_ns, tool_z_m)
        else:
            response.phase = RESPONSE_FAILED


@jit
def observe_response(params, adaptive, t_ns, range_m, tool_z_m, gap_s):
    """Update the test with a sample of channel 0.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (updated)
    t_ns : int64             timestamp
    range_m : float64        range [m]
    tool_z_m : float64       height of the tool at that time [m]
    gap_s : float64          a longer time without samples begins a new run [s]
    """
    response, tau = adaptive.response, adaptive.plant.tau_s
    sigma = max(adaptive.noise.sigma_m, MIN_NOISE_M)
    dt = (t_ns - response.t_ns) * 1e-9
    if response.t_ns == 0 or dt <= 0.0 or dt > gap_s:
        response.mean_m, response.settled_ns = range_m, 0
        _begin_run(response, t_ns, tool_z_m)
    response.t_ns = t_ns
    number = min(max(tau / max(adaptive.prediction.interval_s, 1e-6), MIN_MEAN), MAX_MEAN)
    _update_mean(response, range_m, sigma, number)
    _observe_noise(response, range_m)
    band = BAND_SIGMAS * sigma / number**0.5
    if _responds(response, band):
        if response.phase != RESPONSE_RUN or response.lift_m > 0.0:
            interval = max(adaptive.prediction.interval_s, 1e-6)
            response.settled_ns = t_ns + int(1e9 * (stop_s(adaptive) + number * interval))
        _begin_run(response, t_ns, tool_z_m)
        response.usual_m = min(response.usual_m, response.noise_m / QUIET_SHARE)
    elif response.phase == RESPONSE_RUN and t_ns < response.settled_ns:
        _begin_run(response, t_ns, tool_z_m)  # the tool is on its way back from a test
    elif response.phase == RESPONSE_RUN:
        _update_run(params, adaptive, t_ns, tool_z_m, number, band)
    else:
        _update_test(adaptive, t_ns, tool_z_m, number, band)


@jit
def is_unresponsive(response):
    """Whether the range did not follow a test, and has not changed since."""
    return response.phase == RESPONSE_FAILED


@jit
def reset_response(response):
    """Begin anew with the next sample."""
    response.t_ns = response.samples = 0
    response.phase = RESPONSE_RUN
