"""Health of the ranging: stuck-at detection, health states with hysteresis, latched faults."""

from __future__ import annotations

from typing import Any

from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import DROPOUT, FAULT, FAULT_NOT_FINITE, OK, OUT_OF_RANGE, STUCK, SUSPECT
from surffollow.shm.layout_adaptive_sensing import STUCK_COUNT
from surffollow.shm.layout_multimodel import (
    REASON_LOST,
    REASON_NO_READING,
    REASON_NONE,
    REASON_NOT_FINITE,
    REASON_OUTSIDE,
    REASON_PENDING,
    REASON_STUCK,
)

ENTER_NS = 10_000_000  # a worse state is shown after so long
LEAVE_NS = 100_000_000  # a better one after so long
DROPOUT_NS = 50_000_000  # no sample for so long beyond the usual delay …
DROPOUT_INTERVALS = 2.5  # … or for so many usual intervals of a slow sensor …
MAX_DROPOUT_S = 1.0  # … but never for longer
WINDOW_EDGE_M = 0.003  # a loss that began so near the window's ends is a matter of range
STUCK_SAMPLES = 50  # one value so often …
STUCK_S, STUCK_MIN_SAMPLES = 0.4, 8.0  # … or, of a slow sensor, for so long, but not less often than this …
STUCK_TRAVEL_M = 0.005  # … while the tool moved so far along z: the sensor is stuck
STUCK_MARGIN, STUCK_RATIO = (
    2.0,
    3.0,
)  # sooner or later where this and so many usual runs of equal samples are …
STUCK_MAX_SAMPLES = 150.0  # … fewer or more than those, but never later than this
STUCK_RESET_RATIO = 4.0  # after so many times the believable run, what it said before is not believed either
STUCK_MIN_TRAVEL_M = 0.002  # sooner, too, but not for less motion than noise may hide
REPEAT_RATE, REPEAT_BURN_IN_RATE, REPEAT_BURN_IN_SAMPLES = (
    0.02,
    0.05,
    200,
)  # longest runs are forgotten, the first ones soon
CLOSE_CONFIRMATION_SAMPLES = 3  # a lone glitch is not the fold-back


@jit
def initial_repeat_limit(prediction: Any) -> Any:
    """How many equal samples in a row are believable of a sensor that has shown nothing yet."""
    if prediction.interval_s <= 0.0:
        return 1.0 * STUCK_SAMPLES
    return min(max(STUCK_S / prediction.interval_s, STUCK_MIN_SAMPLES), 1.0 * STUCK_SAMPLES)


@jit
def repeat_limit(adaptive: Any) -> Any:
    """How many equal samples in a row are still believable: a multiple of the usual, if that is known."""
    health = adaptive.health
    if health.usual_repeats == 0.0:
        return initial_repeat_limit(adaptive.prediction)
    return min(STUCK_RATIO * health.usual_repeats + STUCK_MARGIN, STUCK_MAX_SAMPLES)


@jit
def update_usual_repeats(adaptive: Any, n: Any) -> None:
    """Take the length of a run of equal samples: the longest lately is the usual."""
    health = adaptive.health
    if health.usual_repeats == 0.0:
        health.usual_repeats = (initial_repeat_limit(adaptive.prediction) - STUCK_MARGIN) / STUCK_RATIO
    if n > health.usual_repeats:
        health.usual_repeats = n
    else:
        health.usual_repeats += (
            REPEAT_RATE if adaptive.weights.scored >= REPEAT_BURN_IN_SAMPLES else REPEAT_BURN_IN_RATE
        ) * (n - health.usual_repeats)


@jit
def update_stuck(adaptive: Any, repeated: Any, tool_z_m: Any) -> None:
    """Count equal samples in a row; the sensor is stuck when the tool moved along z during too many.

    `tool_z_m` is where the tool was at the sample. A tool that follows well sees equal samples, too, of a
    sensor that is coarser than its noise: how many is learned. What is stuck stays so until it changes.
    """
    health = adaptive.health
    if repeated == 0 or health.repeat_count == 0:
        if health.repeat_count > 0 and is_stuck_permanently(adaptive) == 0:
            update_usual_repeats(adaptive, health.repeat_count & (STUCK_COUNT - 1))
        health.repeat_count = 1
        health.repeat_z_m = tool_z_m
        return
    health.repeat_count += 1
    if health.repeat_count >= STUCK_COUNT:
        return
    most = repeat_limit(adaptive)
    move_m = min(max(STUCK_TRAVEL_M * most / STUCK_SAMPLES, STUCK_MIN_TRAVEL_M), STUCK_TRAVEL_M)
    if health.repeat_count > most and abs(tool_z_m - health.repeat_z_m) > move_m:
        health.repeat_count += STUCK_COUNT


@jit
def is_stuck(health: Any) -> Any:
    """1 when one value came for long although the tool moved along z."""
    return 1 if health.repeat_count >= STUCK_COUNT else 0


@jit
def is_stuck_permanently(adaptive: Any) -> Any:
    """1 when a sensor is stuck for good: a coarse one that was held for stuck changes as the tool stops."""
    return 1 if adaptive.health.repeat_count > STUCK_COUNT + STUCK_RESET_RATIO * repeat_limit(adaptive) else 0


@jit
def dropout_tolerance_s(prediction: Any) -> Any:
    """For how long a sensor as slow as this one may say nothing beyond its usual delay [s]."""
    return min(DROPOUT_INTERVALS * prediction.interval_s, MAX_DROPOUT_S)


@jit
def is_dropout(adaptive: Any) -> Any:
    """Whether samples of channel 0 stay away for longer than they usually do."""
    return adaptive.clock.now_ns - adaptive.hold.t_ns > adaptive.latency.delay_s * 1e9 + max(
        DROPOUT_NS, dropout_tolerance_s(adaptive.prediction) * 1e9
    )


@jit
def is_lost(params: Any, adaptive: Any) -> Any:
    """1 when no sample within the loss time-out entered an estimate that others had confirmed.

    A start with a single sample says little: starts that no second sample ever confirms are no estimate.
    """
    estimate = adaptive.estimate
    return (
        1
        if estimate.samples == 0 or adaptive.clock.now_ns - estimate.confirmed_ns > params.loss_timeout_ns
        else 0
    )


@jit
def update_health(params: Any, adaptive: Any, stuck: Any) -> None:
    """Find the state of the ranging now and show it with hysteresis."""
    clock, hold, health, estimate = adaptive.clock, adaptive.hold, adaptive.health, adaptive.estimate
    wanted, reason = OK, REASON_NONE
    if health.faults & FAULT_NOT_FINITE and estimate.samples < STUCK_SAMPLES:
        wanted, reason = FAULT, REASON_NOT_FINITE
    elif stuck != 0:
        wanted, reason = STUCK, REASON_STUCK
    elif estimate.samples == 0 or is_dropout(adaptive):
        edge = min(hold.range_m - params.range_min_m, params.range_max_m - hold.range_m)
        if estimate.samples > 0 and edge < WINDOW_EDGE_M:
            wanted, reason = OUT_OF_RANGE, REASON_OUTSIDE
        else:
            wanted, reason = DROPOUT, REASON_NO_READING
    elif is_lost(params, adaptive) != 0:
        wanted, reason = DROPOUT, REASON_LOST
    elif adaptive.gate.pending > 0:
        wanted, reason = SUSPECT, REASON_PENDING
    if wanted == health.state:
        health.reason = reason
        health.candidate = wanted
        health.since_ns = clock.now_ns
        return
    if wanted != health.candidate:
        health.candidate = wanted
        health.since_ns = clock.now_ns
    wait = ENTER_NS if wanted > health.state else LEAVE_NS
    if clock.now_ns - health.since_ns >= wait:
        health.state, health.reason = wanted, reason


@jit
def count_close(health: Any, close: Any) -> Any:
    """Count samples in a row near the fold-back; 1 when they are enough to confirm it."""
    health.close_count = health.close_count + 1 if close else 0
    return 1 if health.close_count >= CLOSE_CONFIRMATION_SAMPLES else 0


@jit
def latch_fault(health: Any, fault: Any) -> None:
    """Latch a fault bit."""
    health.faults |= fault


@jit
def clear_faults(health: Any) -> None:
    """Clear all latched faults."""
    health.faults = 0


@jit
def restart_hysteresis(health: Any, now_ns: Any) -> None:
    """Count the hysteresis from now on: the clock jumped."""
    health.since_ns = now_ns
