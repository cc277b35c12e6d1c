"""Response of the range to the tool's own motion: an active test of the sensor.

A descent with a constant range that is not the wanted one, or that is repeated, is tested (signs of a fault:
`constant_ranges`): the tool stops (`RESPONSE_HOLD`), and the range must change by the motion that does not
take place. If it does not, the tool rises (`RESPONSE_LIFT`), and the range must follow. In a longer motion
the setpoint is first shifted up by a little more than the noise hides. A range that grows by the shift ends
the run. An ascent leads away from the ground: it is tested by that shift, and then by a greater one, but
never held.
A descent in which the range varies, and that it does not explain (`descent`), is tested likewise. The range
must then change by more than it varied.
"""

from surffollow.forecast.quantities import APART_M, tolerated_gap_s
from surffollow.forecast.sensing import constant_ranges, mean_range
from surffollow.forecast.sensing.constant_ranges import ANSWER_TAUS, MAX_DESCENT, MIN_MEANS, MOTION_BANDS
from surffollow.forecast.sensing.kinematics import path_speed
from surffollow.forecast.sensing.repeated_ranges import count_repeats, is_repeated
from surffollow.forecast.sensing.sample_hold import is_slow
from surffollow.shm import layout_adaptive_sensing as layout
from surffollow.shm.jit import jit, jit_inlined

STEEP = 0.5  # of the stand-off: a descent that goes farther in the time of an answer is steep
# times the half spread of the ranges before the test of a descent: the answer to a lift, and the lift
SWINGS = (3.0, 4.5)


@jit
def _begin_run(params, adaptive, tool_z_m, range_m):
    """Begin a run of constant ranges with this mean, without a test."""
    response = adaptive.response
    constant_ranges.begin_run(params, adaptive, tool_z_m, range_m)
    response.phase, response.lift_m, response.swing_m = layout.RESPONSE_RUN, 0.0, 0.0


@jit
def _begin_phase(response, phase, tool_z_m):
    """Begin a phase of the test, or a shift in RESPONSE_RUN, at the tool's height, with a sample."""
    response.phase, response.test_ns = phase, response.t_ns
    response.test_z_m, response.lift_m = tool_z_m, 0.0


@jit
def _ceiling_m(params, adaptive, tool_z_m, lift_m):
    """Greatest height of the tool in a test that lifts it by `lift_m` once or twice, from a height [m].

    It may climb in an answer as it did in the run, but no farther than the sensor sees the ground of when the
    run began, or than that ground rises. A good sensor over rising ground answers when the tool stops there.
    A slow one answers late: it is stopped by its second shift only.
    """
    run, offset_m = adaptive.run, params.offset_m
    lasts_s = answer_s(adaptive, MIN_MEANS) + adaptive.plant.tau_s  # the setpoint is ahead of the tool
    climbed_z_m = tool_z_m + 2.0 * lift_m + run.rate_mps * lasts_s
    if adaptive.response.phase == layout.RESPONSE_RUN and is_slow(adaptive):
        return climbed_z_m
    room_m, begun_z_m = params.range_max_m - run.range_m, run.top_z_m
    if adaptive.response.rises != 0:
        begun_z_m = run.low_z_m
    rise_m = max(run.slope, 0.0) * path_speed(adaptive.kinematics) * lasts_s
    # a stand-off is kept to the end of the window for a lift and uneven ground
    seen_z_m = begun_z_m + max(room_m - offset_m, 0.5 * room_m)
    return min(climbed_z_m, max(seen_z_m, tool_z_m + lift_m + rise_m))


@jit
def _begin_lift(params, adaptive, phase, tool_z_m, lift_m):
    """Lift the setpoint by `lift_m`, from the tool's height at the newest sample [m].

    `phase`: RESPONSE_LIFT, or RESPONSE_RUN for a shift.
    """
    response = adaptive.response
    response.excess_m = _excess_m(adaptive, tool_z_m) - response.lift_m
    _begin_phase(response, phase, tool_z_m)
    response.lift_m = response.missing_m = lift_m
    response.ceiling_z_m = _ceiling_m(params, adaptive, tool_z_m, lift_m)


@jit
def answer_s(adaptive, means):
    """Time from a hold or a shift until so many mean ranges are of a tool that has obeyed [s].

    It has stopped, or follows a shift, after 2 τ.
    """
    obeyed_s = adaptive.latency.delay_s + 2.0 * adaptive.plant.tau_s
    return obeyed_s + means * mean_range.samples_in_mean(adaptive) * adaptive.hold.interval_s


@jit
def _update_run(params, adaptive, tool_z_m):
    """Shift the setpoint, or hold the tool, in a motion with a constant range that gives cause to it.

    An ascent leads away from the ground: it counts a fourth, and a shift comes first. In a steep descent a
    hold of a good sensor costs more than half a stand-off: a long one is answered by a shift first. So is a
    descent behind an answer until its error is gone. An axis near its greatest speed takes long for that.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`response` updated)
    tool_z_m : float64  height of the tool at the newest sample [m]
    """
    response, run, tau_s = adaptive.response, adaptive.run, adaptive.plant.tau_s
    number, band_m = mean_range.samples_in_mean(adaptive), mean_range.range_band_m(adaptive)
    descent, ascent = constant_ranges.observe_motion(run, tool_z_m, adaptive.kinematics.climb_mps)
    sunk_m, ascent = descent - ascent, 0.25 * ascent
    rises = ascent > descent and descent < band_m  # it has not turned down since
    sparse = is_slow(adaptive)  # the ground changes while an answer is awaited
    repeated = is_repeated(adaptive.repeats)
    sign = constant_ranges.sign_of_fault(adaptive, ascent if rises else descent, sunk_m)
    if run.mean_m < params.offset_m + max(band_m, mean_range.LAG_TAUS * tau_s * run.rate_mps):
        response.proven_m = 0.0
    returns = response.proven_m > 0.0 and not rises and not repeated
    wait_s, means = answer_s(adaptive, MIN_MEANS), MIN_MEANS
    steep = not rises and ((returns and sparse) or run.rate_mps * wait_s > STEEP * params.offset_m)
    if steep:  # the greater shift is answered sooner
        wait_s, means = answer_s(adaptive, 1.0) - tau_s, 1.0
    stop_s, least_m = adaptive.latency.delay_s + tau_s, MOTION_BANDS * band_m
    if returns:
        least_m = max(least_m, constant_ranges.proven_descent_m(params, adaptive, wait_s + stop_s, sparse))
        sign = layout.SIGN_FOR_SHIFT if descent > least_m else layout.NO_SIGN
    if response.t_ns < response.settled_ns and not repeated:
        sign = layout.NO_SIGN
    if returns and not sparse:
        means *= 2.0  # a tool that comes back shortens the range meanwhile: that is an answer without a test
    # an error of a slow sensor may be lag
    short = rises and sparse and not repeated and ascent <= constant_ranges.SHIFT_DESCENT * params.offset_m
    if run.samples <= means * number or short:
        return
    response.rises = 1 if rises else 0
    far = not sparse and descent + run.rate_mps * stop_s > MAX_DESCENT * params.offset_m
    long = sign != layout.NO_SIGN and run.samples > 2.0 * MIN_MEANS * number
    if response.lift_m == 0.0 and (long or ((steep or returns) and descent > least_m)):
        shift_m = (1.0 if steep else 0.5) * MOTION_BANDS * band_m
        begun_ns = response.t_ns - int(1e9 * run.samples * adaptive.hold.interval_s)
        below = abs(adaptive.sample.lead_m) < APART_M  # the range of a lead has the slope in it
        if not rises and below and begun_ns < response.settled_ns:
            # the run began while the tool came back from a test: what is left of that would hide the answer
            shift_m += max(run.range_m - params.offset_m, 0.0)
        _begin_lift(params, adaptive, layout.RESPONSE_RUN, tool_z_m, shift_m)
    late = response.lift_m > 0.0 and (response.t_ns - response.test_ns) * 1e-9 > wait_s
    if rises:
        if late:  # the greater shift stands out from the lag of the axis
            lift_m = response.lift_m + MOTION_BANDS * band_m + tau_s * run.rate_mps
            _begin_lift(params, adaptive, layout.RESPONSE_LIFT, tool_z_m, lift_m)
    elif late or far or sign == layout.SIGN_FOR_HOLD:
        _begin_phase(response, layout.RESPONSE_HOLD, tool_z_m)


@jit
def _test_descent(params, adaptive, tool_z_m, spread_m):
    """Hold the tool in a descent that the ranges do not explain; the middle of their spread must change."""
    response, descent = adaptive.response, adaptive.descent
    _begin_run(params, adaptive, tool_z_m, 0.5 * (descent.most_m + descent.least_m))
    response.swing_m, response.rises = spread_m, 0
    _begin_phase(response, layout.RESPONSE_HOLD, tool_z_m)


@jit
def _excess_m(adaptive, tool_z_m):
    """Distance by which the setpoint is above the tool beyond what its climb explains [m]."""
    climb_m = adaptive.kinematics.climb_mps * (adaptive.plant.tau_s + adaptive.latency.delay_s)
    return adaptive.setpoint.position_m - tool_z_m - climb_m


@jit
def _update_test(params, adaptive, tool_z_m):
    """Go from a hold to a lift, and end one without response: the sensor is stuck, if the tool obeyed.

    It obeyed a lift from a descent when it and its setpoint have risen by what an answer needs, one from an
    ascent when the setpoint is ahead by little more than before, or it stands at its ceiling. A tool that
    stands there is awaited for the time of a climb at the rate of the run, and of an answer. Otherwise the
    ground rises, another controller leads the tool, or its axis cannot climb faster, and a new run begins in
    the end, unless the range is repeated.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`response` updated)
    tool_z_m : float64  height of the tool at the newest sample [m]
    """
    response, rises = adaptive.response, adaptive.response.rises != 0
    excess_m = _excess_m(adaptive, tool_z_m)
    # behind a descent: it is there, and follows the setpoint
    missing_m = max(response.test_z_m + response.lift_m - tool_z_m, excess_m)
    if rises:
        missing_m = excess_m - response.excess_m
    # as late as the mean range; under a constant one the setpoint oscillates in an ascent: twice as long
    number = (2.0 if rises else 1.0) * MIN_MEANS * mean_range.samples_in_mean(adaptive)
    response.missing_m += (missing_m - response.missing_m) / number
    longest_s = ANSWER_TAUS * adaptive.plant.tau_s
    late_s = (response.t_ns - response.test_ns) * 1e-9 - answer_s(adaptive, MIN_MEANS)
    # by what is left a good sensor would have answered; in an ascent the setpoint of a tool that does not
    # obey stays ahead by all of the lift
    allowed_m = 0.65 * response.lift_m if rises else response.lift_m - _answer_m(adaptive)
    below_m, rate_mps = response.ceiling_z_m - tool_z_m, adaptive.run.rate_mps
    # one that another controller leads climbs farther
    stands = rises and abs(below_m) < allowed_m and abs(adaptive.kinematics.climb_mps) < 0.5 * rate_mps
    if stands:  # there the range of a good sensor shortens as the ground rises
        climb_m = response.ceiling_z_m - response.test_z_m + _answer_m(adaptive)
        longest_s = min(longest_s, max(climb_m / rate_mps - answer_s(adaptive, MIN_MEANS), 0.0))
    if late_s <= (longest_s if rises else 0.0):
        return
    if response.phase == layout.RESPONSE_HOLD:
        lift_m = max(MOTION_BANDS * mean_range.range_band_m(adaptive), SWINGS[1] * response.swing_m)
        _begin_lift(params, adaptive, layout.RESPONSE_LIFT, tool_z_m, lift_m)
        return
    obeyed = stands if rises and below_m < allowed_m else response.missing_m < allowed_m
    applied = adaptive.setpoint.t_ns != 0  # not in FREEZE
    if is_repeated(adaptive.repeats) or (applied and obeyed):
        response.phase, response.test_ns = layout.RESPONSE_FAILED, response.t_ns
    elif late_s > longest_s:
        _begin_run(params, adaptive, tool_z_m, adaptive.run.mean_m)


@jit
def _answer_m(adaptive):
    """Change of the mean range that answers a test [m]."""
    swing_m = SWINGS[0] * adaptive.response.swing_m
    return max(mean_range.TEST_BAND_FACTOR * mean_range.range_band_m(adaptive), swing_m)


@jit
def _responds(adaptive):
    """Whether the mean range has left the band of the run; in a test a wider one."""
    change_m = abs(adaptive.run.mean_m - adaptive.run.range_m)
    if adaptive.response.phase != layout.RESPONSE_RUN:
        return change_m > _answer_m(adaptive)
    return change_m > max(adaptive.run.band_m, mean_range.range_band_m(adaptive))


@jit
def _note_answer(adaptive, deviation_m):
    """Note the answer to a test or a shift: until when the axis speeds up, and the range that is proven.

    A jump from the mean range by more than noise and the way of the tool in its time is no proof, nor is a
    shorter range: where the ground falls, a test makes it longer.
    """
    response, mean_s = adaptive.response, mean_range.samples_in_mean(adaptive) * adaptive.hold.interval_s
    if response.phase == layout.RESPONSE_RUN and response.lift_m == 0.0:
        return
    response.settled_ns = response.t_ns + int(1e9 * answer_s(adaptive, 1.0))
    moved_m = mean_range.BAND_SIGMAS * mean_range.range_sigma_m(adaptive) + adaptive.run.rate_mps * mean_s
    mean_m, proven_m = adaptive.run.mean_m, response.proven_m
    proven_m = mean_m if mean_m > adaptive.run.range_m else min(proven_m, mean_m)
    response.proven_m = proven_m if response.rises == 0 and deviation_m <= moved_m else 0.0


@jit_inlined
def observe_response(params, adaptive, t_ns, range_m, tool_z_m, spread_m):
    """Update the test with a sample of channel 0.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (updated)
    t_ns : int64        timestamp
    range_m : float64   range [m]
    tool_z_m : float64  height of the tool at that time [m]
    spread_m : float64  half the spread of the ranges in a descent that is to be tested [m]; 0: none
    """
    response, sigma_m = adaptive.response, mean_range.range_sigma_m(adaptive)
    noise_m = mean_range.BAND_SIGMAS * sigma_m
    begins = response.t_ns == 0 or t_ns < response.t_ns
    if (t_ns - response.t_ns) * 1e-9 > tolerated_gap_s(adaptive.hold.interval_s):
        if response.phase != layout.RESPONSE_FAILED:
            response.test_ns = t_ns  # an answer takes time with samples
        if response.phase == layout.RESPONSE_RUN:
            response.test_z_m = tool_z_m
    response.t_ns = t_ns
    count_repeats(adaptive, range_m, tool_z_m)
    in_run, most_m = response.phase == layout.RESPONSE_RUN, noise_m
    if constant_ranges.moves_tool(response):  # in a test two samples answer, one does not
        band_m = max(adaptive.run.band_m, mean_range.range_band_m(adaptive))
        most_m = mean_range.samples_in_mean(adaptive) * band_m
    constant_ranges.update_mean(adaptive, range_m, sigma_m, max(most_m, SWINGS[0] * response.swing_m))
    mean_m = adaptive.run.mean_m
    begins = begins or (response.swing_m > 0.0 and adaptive.run.offset_m != params.offset_m)
    if begins or _responds(adaptive):
        if begins:
            response.settled_ns, response.proven_m = 0, 0.0
        else:
            _note_answer(adaptive, abs(range_m - mean_m))
        # of a step the mean sees a part
        step = begins or abs(range_m - mean_m) > noise_m
        _begin_run(params, adaptive, tool_z_m, range_m if step else mean_m)
    elif in_run and spread_m > 0.0:
        _test_descent(params, adaptive, tool_z_m, spread_m)
    elif in_run:
        _update_run(params, adaptive, tool_z_m)
    elif response.phase != layout.RESPONSE_FAILED:
        _update_test(params, adaptive, tool_z_m)


@jit
def restart_test(response):
    """Begin anew with the next sample, without a test."""
    response.t_ns, response.phase = 0, layout.RESPONSE_RUN


@jit
def is_unresponsive(response):
    """Whether the range did not follow a test, and has not changed since."""
    return response.phase == layout.RESPONSE_FAILED
