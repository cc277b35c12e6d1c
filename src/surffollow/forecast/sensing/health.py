"""Health of the ranging: stuck-at detection, health states with hysteresis, latched faults."""

from surffollow.forecast.attitude.beam_detection import REPEAT_BAND
from surffollow.forecast.attitude.rotation_response import has_failed
from surffollow.forecast.sensing.clock import MAX_GAP_NS
from surffollow.forecast.sensing.kinematics import has_jumped
from surffollow.forecast.sensing.latency_identification import is_late
from surffollow.forecast.sensing.range_prediction import predict_range
from surffollow.forecast.sensing.response import is_unresponsive
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import (
    DROPOUT,
    FAULT,
    FAULT_NOT_FINITE,
    OK,
    OUT_OF_RANGE,
    REASON_CHANNELS,
    REASON_LATE,
    REASON_LOST,
    REASON_NO_READING,
    REASON_NONE,
    REASON_NOT_FINITE,
    REASON_OUTSIDE,
    REASON_PENDING,
    REASON_POSE_JUMP,
    REASON_ROTATION,
    REASON_SENSORS,
    REASON_SILENT,
    REASON_STUCK,
    REASON_TIMESTAMPS,
    STUCK,
    SUSPECT,
)
from surffollow.shm.layout_follow import NO_SENSOR, SENSOR_LOST

BURN_IN_SAMPLES = 200
ENTER_NS = 10_000_000  # a worse state is published after so long
LEAVE_NS = 100_000_000  # a better one after so long
DROPOUT_INTERVALS = 2.5  # of a slow sensor: without a sample for so many usual intervals it drops out …
MAX_DROPOUT_S = 1.0  # … but no longer than this
INTERVAL_READINGS = 8  # readings over which the usual interval of a channel's readings is averaged
WINDOW_EDGE_M = 0.003  # a loss so near an end of the window, as the last sample or the next, is OUT_OF_RANGE
STUCK_SAMPLES = 50  # equal samples …
STUCK_S, STUCK_MIN_SAMPLES = 0.4, 8.0  # … or, of a slow sensor, for so long, and at least so many …
STUCK_TRAVEL_M = 0.005  # … while the tool moves so far along z are a stuck-at fault
FLOOR_RATE = 0.001  # at which the least noise rises to the present one, per sample
STUCK_MARGIN, STUCK_RATIO = 2.0, 4.0  # with a known sensor: this plus so many usual runs of equal samples …
STUCK_MAX_SAMPLES = 200.0  # … but no more than this
STUCK_RESET_RATIO = 4.0  # in repeat limits: then the estimate is discarded
STUCK_MIN_TRAVEL_M = 0.002  # no less, or noise could hide the response
REPEAT_RATE, REPEAT_BURN_IN_RATE = 0.02, 0.05  # at which the longest run fades
CLOSE_CONFIRMATION_SAMPLES = 3  # a single glitch is not the fold-back


@jit
def initial_repeat_limit(prediction):
    """Equal samples in a row that are no fault while nothing is known of the sensor."""
    if prediction.interval_s <= 0.0:
        return 1.0 * STUCK_SAMPLES
    return min(max(STUCK_S / prediction.interval_s, STUCK_MIN_SAMPLES), 1.0 * STUCK_SAMPLES)


@jit
def repeat_limit(adaptive):
    """Equal samples in a row that are no fault: a multiple of the usual number, if that is known."""
    health = adaptive.health
    if health.usual_repeats == 0.0:
        return initial_repeat_limit(adaptive.prediction)
    return min(STUCK_RATIO * health.usual_repeats + STUCK_MARGIN, STUCK_MAX_SAMPLES)


@jit
def update_usual_repeats(adaptive, n):
    """Update the usual number of equal samples with the length of a run."""
    health = adaptive.health
    if health.usual_repeats == 0.0:
        health.usual_repeats = (initial_repeat_limit(adaptive.prediction) - STUCK_MARGIN) / STUCK_RATIO
    if n > health.usual_repeats:
        health.usual_repeats = n
    else:
        health.usual_repeats += (
            REPEAT_RATE if adaptive.weights.scored >= BURN_IN_SAMPLES else REPEAT_BURN_IN_RATE
        ) * (n - health.usual_repeats)


@jit
def repeats_range(health, range_m):
    """Whether a range differs from the first one of the run by less than the sensor's noise allows."""
    near = abs(range_m - health.repeat_range_m) <= REPEAT_BAND * health.noise_floor_m
    return health.repeat_count > 0 and near


@jit
def update_noise_floor(adaptive):
    """Track the least noise of the readings: on rough ground they are noisier than the sensor."""
    health, sigma = adaptive.health, adaptive.noise.sigma_m
    if adaptive.weights.scored < BURN_IN_SAMPLES:
        health.noise_floor_m = 0.0
    elif health.noise_floor_m == 0.0:
        health.noise_floor_m = sigma
    else:
        health.noise_floor_m += min(sigma - health.noise_floor_m, FLOOR_RATE * sigma)


@jit
def update_stuck(adaptive, repeated, range_m, tool_z_m):
    """Count like samples in a row; too many while the tool moved along z are a stuck-at fault.

    A live sensor responds to the motion, or shows its
    noise while the ground rises with the tool. A sensor that is coarser than its noise repeats samples also
    while the tool follows well; the usual number is therefore estimated. The fault lasts until the range
    changes.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (`health` updated)
    repeated : bool     the sample is like the first of the run
    range_m : float64   range of the sample [m]
    tool_z_m : float64  height of the tool at the sample [m]
    """
    health = adaptive.health
    if not repeated or health.repeat_count == 0:
        if health.repeat_count > 0 and not is_stuck_permanently(adaptive):
            update_usual_repeats(adaptive, health.repeat_count)
        health.repeat_count, health.stuck = 1, 0
        health.repeat_z_m, health.repeat_range_m = tool_z_m, range_m
        update_noise_floor(adaptive)
        return
    health.repeat_count += 1
    limit = repeat_limit(adaptive)
    travel_m = min(max(STUCK_TRAVEL_M * limit / STUCK_SAMPLES, STUCK_MIN_TRAVEL_M), STUCK_TRAVEL_M)
    if health.repeat_count > limit and abs(tool_z_m - health.repeat_z_m) > travel_m:
        health.stuck = 1


@jit
def is_stuck(health):
    """Whether there is a stuck-at fault."""
    return health.stuck != 0


@jit
def is_stuck_permanently(adaptive):
    """Whether a stuck-at fault has lasted for too many samples to be quantisation."""
    health = adaptive.health
    return is_stuck(health) and health.repeat_count > STUCK_RESET_RATIO * repeat_limit(adaptive)


@jit
def dropout_tolerance_s(prediction):
    """Time without a sample, beyond the usual delay, that is no drop-out [s]."""
    return min(DROPOUT_INTERVALS * prediction.interval_s, MAX_DROPOUT_S)


@jit
def is_dropout(adaptive):
    """Whether samples of channel 0 are missing."""
    return adaptive.clock.now_ns - adaptive.hold.t_ns > adaptive.latency.delay_s * 1e9 + max(
        MAX_GAP_NS, dropout_tolerance_s(adaptive.prediction) * 1e9
    )


@jit
def is_lost(params, adaptive):
    """Whether no sample entered a confirmed estimate within the loss time-out.

    An estimate of a single sample is not confirmed. A sensor whose range did not respond, and that
    falls silent, has nothing to continue from.
    """
    estimate = adaptive.estimate
    if estimate.samples == 0 or (is_unresponsive(adaptive.response) and is_dropout(adaptive)):
        return True
    return adaptive.clock.now_ns - estimate.confirmed_ns > params.loss_timeout_ns


@jit
def observe_channels(params, health, sense, now_ns):
    """Note when each channel has a reading, and the usual interval of its readings."""
    for c in range(params.n_channels):
        if sense.fresh[c] == 0:
            continue
        gap_ns, usual_ns = now_ns - health.reading_ns[c], health.interval_ns[c]
        if usual_ns != 0:
            health.interval_ns[c] += (min(gap_ns, 2 * usual_ns) - usual_ns) // INTERVAL_READINGS
        elif health.reading_ns[c] != 0:
            health.interval_ns[c] = gap_ns
        health.reading_ns[c] = now_ns


@jit
def silent_channels(params, health, now_ns):
    """Bit per channel of several that is without a reading as long as a drop-out is.

    The time is that of arrival: a wrong timestamp is no missing reading.
    """
    silent = 0
    if params.n_channels > 1:
        for c in range(params.n_channels):
            tolerance_ns = min(DROPOUT_INTERVALS * health.interval_ns[c], MAX_DROPOUT_S * 1e9)
            if now_ns - health.reading_ns[c] > max(MAX_GAP_NS, tolerance_ns):
                silent |= 1 << c
    return silent


@jit
def update_health(params, adaptive, sense, stuck):
    """Determine health and reason, and publish them with hysteresis.

    Parameters
    ----------
    params, adaptive, sense : records of `Params`, `AdaptiveState` (`health` updated), `SenseState`
    stuck : bool  the range does not respond to the tool's motion
    """
    clock, hold, health, estimate = adaptive.clock, adaptive.hold, adaptive.health, adaptive.estimate
    observe_channels(params, health, sense, clock.now_ns)
    silent = silent_channels(params, health, clock.now_ns)
    candidate, reason = OK, REASON_NONE
    if health.faults & FAULT_NOT_FINITE and estimate.samples < STUCK_SAMPLES:
        candidate, reason = FAULT, REASON_NOT_FINITE
    elif stuck:
        candidate, reason = STUCK, REASON_STUCK
    elif estimate.samples == 0 or is_dropout(adaptive):
        next_m = predict_range(adaptive.prediction, adaptive.prediction.interval_s)
        nearest_m, farthest_m = min(hold.range_m, next_m), max(hold.range_m, next_m)
        edge_m = min(nearest_m - params.range_min_m, params.range_max_m - farthest_m)
        if estimate.samples > 0 and edge_m < WINDOW_EDGE_M:
            candidate, reason = OUT_OF_RANGE, REASON_OUTSIDE
        else:
            candidate, reason = DROPOUT, REASON_NO_READING
    elif is_lost(params, adaptive):
        candidate, reason = DROPOUT, REASON_LOST
    elif adaptive.hold.shift_ns > 0:
        candidate, reason = SUSPECT, REASON_TIMESTAMPS
    elif has_jumped(adaptive.kinematics, clock.now_ns):
        candidate, reason = SUSPECT, REASON_POSE_JUMP
    elif adaptive.beams.inconsistent != 0:
        candidate, reason = SUSPECT, REASON_SENSORS
    elif has_failed(adaptive.rotation):
        candidate, reason = SUSPECT, REASON_ROTATION
    elif silent != 0:
        candidate, reason = SUSPECT, REASON_SILENT
    elif is_late(params, adaptive):
        candidate, reason = SUSPECT, REASON_LATE
    elif adaptive.gate.pending > 0:
        candidate, reason = SUSPECT, REASON_PENDING
    if candidate in (DROPOUT, OUT_OF_RANGE) or reason == REASON_SILENT:
        reason |= silent << REASON_CHANNELS
    if candidate == health.state:
        health.reason = reason
        health.candidate = candidate
        health.since_ns = clock.now_ns
        return
    if candidate != health.candidate:
        health.candidate = candidate
        health.since_ns = clock.now_ns
    wait = ENTER_NS if candidate > health.state else LEAVE_NS
    if health.state < DROPOUT and is_lost(params, adaptive):
        wait = 0  # there is no demand: the reason is published at once
    if clock.now_ns - health.since_ns >= wait:
        health.state, health.reason = candidate, reason


@jit
def count_close(health, close):
    """Count samples in a row near the fold-back; whether they are enough to confirm it."""
    health.close_count = health.close_count + 1 if close else 0
    return health.close_count >= CLOSE_CONFIRMATION_SAMPLES


@jit
def latch_fault(health, fault):
    """Latch a fault bit."""
    health.faults |= fault


@jit
def forget(health, fault):
    """Ask for a start without knowledge behind this cycle, for a fault; status bits of the cycle."""
    health.forget = fault
    return NO_SENSOR | SENSOR_LOST
