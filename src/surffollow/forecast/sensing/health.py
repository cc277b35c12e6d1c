"""Health of the ranging: drop-outs, unseen ground, health states with hysteresis, latched faults."""

import math

from surffollow.forecast import quantities
from surffollow.forecast.plant.axis_model import PERIOD_S
from surffollow.forecast.quantities import follow_interval, tolerated_gap_s
from surffollow.forecast.sensing.constant_ranges import MAX_UNSEEN, moves_tool
from surffollow.forecast.sensing.frame_check import is_reversed, moves_to_check
from surffollow.forecast.sensing.kinematics import has_jumped, path_speed
from surffollow.forecast.sensing.latency_identification import is_late
from surffollow.forecast.sensing.response import is_unresponsive
from surffollow.forecast.sensing.sample_hold import is_slow
from surffollow.shm import layout_adaptive as layout
from surffollow.shm.jit import jit, jit_inlined
from surffollow.shm.layout_adaptive_sensing import RESPONSE_RUN, ROTATION_FAILED
from surffollow.shm.layout_follow import NO_SENSOR, SENSOR_LOST


@jit
def missing_s(adaptive, since_ns, least_ns=quantities.MAX_GAP_NS):
    """Time for which a sample after this time is missing, beyond the usual delay and gap [s]; ≤ 0: no."""
    tolerance_s = adaptive.latency.delay_s + tolerated_gap_s(adaptive.hold.interval_s, least_ns)
    return (adaptive.clock.now_ns - since_ns) * 1e-9 - tolerance_s


@jit
def is_dropout(adaptive):
    """Whether samples of channel 0 are missing."""
    return missing_s(adaptive, adaptive.hold.t_ns) > 0.0


@jit
def repeats_itself(adaptive):
    """Whether the range repeats itself for as long as a drop-out lasts."""
    return adaptive.repeats.unused != 0 and missing_s(adaptive, adaptive.estimate.accepted_ns) > 0.0


@jit
def rise_rate(adaptive):
    """Rate at which ground that is not seen may rise [m/s].

    As steeply as that of the last metre, as at present, or as when the run of ranges began that is tested.
    """
    estimate, response = adaptive.estimate, adaptive.response
    slope = max(math.sqrt(estimate.slope_power), estimate.slope)
    if response.phase != RESPONSE_RUN:
        slope = max(slope, adaptive.run.slope)
    return slope * path_speed(adaptive.kinematics)


@jit
def uncertain_clearance(adaptive, silent, repeats):
    """Clearance that may be lost unseen [m].

    In a test of the response it is that since the run of ranges began which the test is about: all ranges
    since then are uncertain, and the tool has moved. A test of a slow sensor may fail by chance, since the
    ground changes while an answer is awaited: it counts when the sensor falls silent in it. In silence
    without a test it is that since the newest sample, and under a range that repeats itself that since the
    newest sample that entered the estimate.

    Parameters
    ----------
    adaptive : record of `AdaptiveState`
    silent : bool   samples are missing
    repeats : bool  the range repeats itself
    """
    response, run, setpoint = adaptive.response, adaptive.run, adaptive.setpoint
    tested = moves_tool(response) and (silent or not is_slow(adaptive))
    if not tested and not silent and not repeats:
        return 0.0
    seen_ns = adaptive.estimate.accepted_ns if repeats and not tested else adaptive.hold.t_ns
    begin_m, unseen_s = adaptive.blend.tracked_m, (adaptive.clock.now_ns - seen_ns) * 1e-9
    if tested:
        unseen_s += run.samples * adaptive.hold.interval_s
        begin_m = run.low_z_m if response.rises != 0 else run.top_z_m
    descent_m = begin_m - setpoint.position_m if setpoint.t_ns != 0 else 0.0
    return descent_m + rise_rate(adaptive) * unseen_s


@jit
def update_unseen(params, adaptive, stuck):
    """Note whether so great a share of the stand-off may be lost unseen that no demand is valid.

    That lasts until the sensor shows the ground again, also when the tool stops.
    """
    health, silent = adaptive.health, is_dropout(adaptive)
    if not silent and not stuck:
        health.unseen = 0
    elif uncertain_clearance(adaptive, silent, repeats_itself(adaptive)) > MAX_UNSEEN * params.offset_m:
        health.unseen = 1


@jit
def is_lost(params, adaptive):
    """Whether no sample entered a confirmed estimate within the loss time-out.

    An estimate of a single sample is not confirmed, and none is in a frame that is wrong. A sensor whose
    range did not respond, and that falls silent, has nothing to continue from. Before that, ground that it
    did not see may have come near.
    """
    health, estimate = adaptive.health, adaptive.estimate
    if health.upward != 0 or health.unseen != 0 or is_reversed(adaptive.frame) or estimate.samples == 0:
        return True
    if is_unresponsive(adaptive.response) and is_dropout(adaptive):
        return True
    # frames that jump more often than samples arrive: the tool would hold its height for ever
    held = adaptive.clock.now_ns - estimate.in_frame_ns > 2 * params.loss_timeout_ns
    return held or adaptive.clock.now_ns - estimate.confirmed_ns > params.loss_timeout_ns


@jit
def observe_channels(params, health, sense, now_ns):
    """Note when each channel has a reading; bit per channel of several without one as long as a drop-out is.

    The time is that of arrival: a wrong timestamp is no missing reading.
    """
    silent = 0
    for c in range(params.n_channels):
        gap_s, usual_s = (now_ns - health.reading_ns[c]) * 1e-9, health.interval_s[c]
        if sense.fresh[c] != 0:
            if health.reading_ns[c] != 0:
                health.interval_s[c] = follow_interval(usual_s, gap_s)
            health.reading_ns[c] = now_ns
        elif params.n_channels > 1 and gap_s > tolerated_gap_s(usual_s):
            silent |= 1 << c
    return silent


@jit
def beams_left_out(params, adaptive):
    """Bit per beam that was not used for long, although it reads; and of these, per beam that is too old.

    The others outvote it, or its readings are older than theirs. Without it there may be no plane at all. An
    edge leaves out a beam for less than LONG_GAP_NS.
    """
    health, now_ns, left_out, old = adaptive.health, adaptive.clock.now_ns, 0, 0
    for c in range(params.n_channels):
        late = adaptive.beams.old[c] != 0
        if adaptive.beams.accepted[c] != 0 or (adaptive.plane.count == 0 and not late):
            health.used_ns[c] = now_ns
        elif now_ns - health.used_ns[c] > quantities.LONG_GAP_NS:
            left_out |= 1 << c
            old |= (1 if late else 0) << c
    return left_out, old


@jit
def count_outside(health, sense):
    """Count cycles with readings of channel 0 outside the window since the last one inside it."""
    found = sense.outside != health.outside_seen
    health.outside_seen = sense.outside
    if sense.fresh[0] != 0:
        health.outside = 0
    elif found:
        health.outside += 1


@jit
def is_outside(params, adaptive):
    """Whether readings lie outside the window: several do, or the last sample or the next is within 3 mm."""
    if adaptive.health.outside >= quantities.CONFIRMATION_SAMPLES:
        return True
    hold, motion = adaptive.hold, adaptive.kinematics
    rate_mps = motion.climb_mps - adaptive.estimate.slope * path_speed(motion)
    next_m = hold.range_m + rate_mps * hold.interval_s
    nearest_m, farthest_m = min(hold.range_m, next_m), max(hold.range_m, next_m)
    return min(nearest_m - params.range_min_m, params.range_max_m - farthest_m) < 0.003


@jit_inlined
def present_health(params, adaptive, stuck, lost, silent, left_out, old):
    """Health and its reason without hysteresis; the gravest one.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState`
    stuck, lost : bool           the range does not respond or repeats itself; as `is_lost` says
    silent, left_out, old : int  bit per channel without readings, per beam not used, and per one too old

    Returns
    -------
    int, int  numbers of HEALTH_NAMES and REASON_NAMES
    """
    health, samples, dropout = adaptive.health, adaptive.estimate.samples, is_dropout(adaptive)
    silent_bits = silent << layout.REASON_CHANNELS
    begun_anew = health.faults & layout.FAULT_NOT_FINITE != 0 and samples < quantities.USUAL_SAMPLES
    outside = samples > 0 and dropout and is_outside(params, adaptive)
    single = adaptive.hold.t_ns != 0 and adaptive.hold.interval_s == 0.0
    failed = adaptive.rotation.phase == ROTATION_FAILED
    tested = moves_tool(adaptive.response) or moves_to_check(adaptive.frame)
    for holds, state, reason in (  # the gravest first
        (health.upward != 0, layout.DROPOUT, layout.REASON_UPWARD),
        (is_reversed(adaptive.frame), layout.FAULT, layout.REASON_REVERSED),
        (begun_anew, layout.FAULT, layout.REASON_NOT_FINITE),
        (stuck and not dropout, layout.STUCK, layout.REASON_STUCK),
        (outside, layout.OUT_OF_RANGE, layout.REASON_OUTSIDE | silent_bits),
        (dropout and single, layout.DROPOUT, layout.REASON_SINGLE),
        (samples == 0 or dropout, layout.DROPOUT, layout.REASON_NO_READING | silent_bits),
        (lost, layout.DROPOUT, layout.REASON_LOST | silent_bits),
        (adaptive.hold.shift_ns > 0, layout.SUSPECT, layout.REASON_TIMESTAMPS),
        (has_jumped(adaptive), layout.SUSPECT, layout.REASON_POSE_JUMP),
        (adaptive.beams.inconsistent != 0, layout.SUSPECT, layout.REASON_SENSORS),
        (failed, layout.SUSPECT, layout.REASON_ROTATION),
        (silent != 0, layout.SUSPECT, layout.REASON_SILENT | silent_bits),
        (old != 0, layout.SUSPECT, layout.REASON_OLD | old << layout.REASON_CHANNELS),
        (left_out != 0, layout.SUSPECT, layout.REASON_LEFT_OUT | left_out << layout.REASON_CHANNELS),
        (is_late(adaptive), layout.SUSPECT, layout.REASON_LATE),
        (adaptive.repeats.unused != 0, layout.SUSPECT, layout.REASON_REPEATED),
        (adaptive.descent.unexplained != 0, layout.SUSPECT, layout.REASON_DESCENT),
        (adaptive.pending.samples > 0, layout.SUSPECT, layout.REASON_PENDING),
        (tested, layout.OK, layout.REASON_TESTED),
    ):
        if holds:
            return state, reason
    return layout.OK, layout.REASON_NONE


@jit_inlined
def update_health(params, adaptive, sense, close):
    """Publish health and reason with hysteresis, and latch faults.

    Parameters
    ----------
    params, adaptive, sense : records of `Params`, `AdaptiveState` (`health` updated), `SenseState`
    close : bool  the sensor may be in its fold-back

    Returns
    -------
    bool, bool  the range does not respond or repeats itself; there is no demand without other samples
    """
    health, now_ns = adaptive.health, adaptive.clock.now_ns
    stuck = repeats_itself(adaptive) or is_unresponsive(adaptive.response)
    update_unseen(params, adaptive, stuck)
    lost = is_lost(params, adaptive)
    count_outside(health, sense)
    silent = observe_channels(params, health, sense, now_ns)
    left_out, old = beams_left_out(params, adaptive)
    state, reason = present_health(params, adaptive, stuck, lost, silent, left_out, old)
    # better states that alternate are an improvement, and worse ones a decline
    before, published = health.candidate, health.state
    if (state > published) != (before > published) or (state < published) != (before < published):
        health.since_ns = now_ns
    health.candidate = state
    # a worse state is published after a controller period
    wait_ns = int(PERIOD_S * 1e9) if state > health.state else quantities.PAUSE_NS
    # there is no demand, or again one toward the surface: that is published at once
    if (health.state < layout.DROPOUT and lost) or (health.state == layout.STUCK and not stuck):
        wait_ns = 0
    if state == health.state or now_ns - health.since_ns >= wait_ns:
        health.state, health.reason = state, reason
    health.faults |= layout.FAULT_STUCK if stuck else 0
    health.faults |= layout.FAULT_CLOSE if close else 0
    health.faults |= layout.FAULT_REVERSED if is_reversed(adaptive.frame) else 0
    health.faults |= layout.FAULT_LOST if lost and not stuck and adaptive.estimate.samples > 0 else 0
    return stuck, lost


@jit
def count_close(health, close):
    """Count samples in a row near the fold-back; whether they are enough to confirm it."""
    health.close_count = health.close_count + 1 if close else 0
    return health.close_count >= quantities.CONFIRMATION_SAMPLES


@jit
def note_beam(health, upward):
    """Note whether the beam of a sample points upward, and ends on no ground; returns that."""
    health.upward = 1 if upward else 0
    return upward


@jit
def restart(health, fault):
    """Ask for a start without knowledge behind this cycle, for a fault; status bits of the cycle."""
    health.restart = fault
    return NO_SENSOR | SENSOR_LOST
