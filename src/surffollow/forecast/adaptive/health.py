"""Health of the ranging: stuck-at detection, health states with hysteresis, latched faults."""

from __future__ import annotations

from typing import Any

from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import (
    DROPOUT,
    FAULT,
    FAULT_NOT_FINITE,
    OK,
    OUT_OF_RANGE,
    STUCK,
    STUCK_COUNT,
    SUSPECT,
)
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
def initial_repeat_limit(a: Any) -> Any:
    """How many equal samples in a row are believable of a sensor that has shown nothing yet."""
    if a.trend_dt_s <= 0.0:
        return 1.0 * STUCK_SAMPLES
    return min(max(STUCK_S / a.trend_dt_s, STUCK_MIN_SAMPLES), 1.0 * STUCK_SAMPLES)


@jit
def repeat_limit(a: Any) -> Any:
    """How many equal samples in a row are still believable: a multiple of the usual, if that is known."""
    if a.still_usual == 0.0:
        return initial_repeat_limit(a)
    return min(STUCK_RATIO * a.still_usual + STUCK_MARGIN, STUCK_MAX_SAMPLES)


@jit
def update_usual_repeats(a: Any, n: Any) -> None:
    """Take the length of a run of equal samples: the longest lately is the usual."""
    if a.still_usual == 0.0:
        a.still_usual = (initial_repeat_limit(a) - STUCK_MARGIN) / STUCK_RATIO
    if n > a.still_usual:
        a.still_usual = n
    else:
        a.still_usual += (REPEAT_RATE if a.scored >= REPEAT_BURN_IN_SAMPLES else REPEAT_BURN_IN_RATE) * (
            n - a.still_usual
        )


@jit
def update_stuck(a: Any, repeated: Any, tool_z_m: Any) -> None:
    """Count equal samples in a row; the sensor is stuck when the tool moved along z during too many.

    `tool_z_m` is where the tool was at the sample. A tool that follows well sees equal samples, too, of a
    sensor that is coarser than its noise: how many is learned. What is stuck stays so until it changes.
    """
    if repeated == 0 or a.still == 0:
        if a.still > 0 and is_stuck_permanently(a) == 0:
            update_usual_repeats(a, a.still & (STUCK_COUNT - 1))
        a.still = 1
        a.still_z_m = tool_z_m
        return
    a.still += 1
    if a.still >= STUCK_COUNT:
        return
    most = repeat_limit(a)
    move_m = min(max(STUCK_TRAVEL_M * most / STUCK_SAMPLES, STUCK_MIN_TRAVEL_M), STUCK_TRAVEL_M)
    if a.still > most and abs(tool_z_m - a.still_z_m) > move_m:
        a.still += STUCK_COUNT


@jit
def is_stuck(a: Any) -> Any:
    """1 when one value came for long although the tool moved along z."""
    return 1 if a.still >= STUCK_COUNT else 0


@jit
def is_stuck_permanently(a: Any) -> Any:
    """1 when a sensor is stuck for good: a coarse one that was held for stuck changes as the tool stops."""
    return 1 if a.still > STUCK_COUNT + STUCK_RESET_RATIO * repeat_limit(a) else 0


@jit
def dropout_tolerance_s(a: Any) -> Any:
    """For how long a sensor as slow as this one may say nothing beyond its usual delay [s]."""
    return min(DROPOUT_INTERVALS * a.trend_dt_s, MAX_DROPOUT_S)


@jit
def is_dropout(a: Any) -> Any:
    """Whether samples of channel 0 stay away for longer than they usually do."""
    return a.now_ns - a.held_ns > a.late_s * 1e9 + max(DROPOUT_NS, dropout_tolerance_s(a) * 1e9)


@jit
def is_lost(params: Any, a: Any) -> Any:
    """1 when no sample within the loss time-out entered an estimate that others had confirmed.

    A start with a single sample says little: starts that no second sample ever confirms are no estimate.
    """
    return 1 if a.samples == 0 or a.now_ns - a.sure_ns > params.loss_timeout_ns else 0


@jit
def update_health(params: Any, a: Any, stuck: Any) -> None:
    """Find the state of the ranging now and show it with hysteresis."""
    wanted, reason = OK, REASON_NONE
    if a.faults & FAULT_NOT_FINITE and a.samples < STUCK_SAMPLES:
        wanted, reason = FAULT, REASON_NOT_FINITE
    elif stuck != 0:
        wanted, reason = STUCK, REASON_STUCK
    elif a.samples == 0 or is_dropout(a):
        edge = min(a.held_m - params.range_min_m, params.range_max_m - a.held_m)
        if a.samples > 0 and edge < WINDOW_EDGE_M:
            wanted, reason = OUT_OF_RANGE, REASON_OUTSIDE
        else:
            wanted, reason = DROPOUT, REASON_NO_READING
    elif is_lost(params, a) != 0:
        wanted, reason = DROPOUT, REASON_LOST
    elif a.quarantined > 0:
        wanted, reason = SUSPECT, REASON_PENDING
    if wanted == a.health:
        a.reason = reason
        a.health_next = wanted
        a.health_ns = a.now_ns
        return
    if wanted != a.health_next:
        a.health_next = wanted
        a.health_ns = a.now_ns
    wait = ENTER_NS if wanted > a.health else LEAVE_NS
    if a.now_ns - a.health_ns >= wait:
        a.health, a.reason = wanted, reason
