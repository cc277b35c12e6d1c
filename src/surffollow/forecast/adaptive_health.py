"""Health of the ranging, with hysteresis: what is wrong, shown soon, withdrawn late."""

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
    STUCK_RUN,
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
PATIENT_SAMPLES = 2.5  # … or for so many usual intervals of a slow sensor …
PATIENT_S = 1.0  # … but never for longer
EDGE_M = 0.003  # a loss that began so near the window's ends is a matter of range
STILL_SAMPLES = 50  # one value so often …
STILL_S, STILL_LEAST = 0.4, 8.0  # … or, of a slow sensor, for so long, but not less often than this …
STILL_MOVE_M = 0.005  # … while the tool moved so far along z: the sensor is stuck
STILL_MORE, STILL_RUNS = 2.0, 3.0  # sooner or later where this and so many usual runs of equal samples are …
STILL_MOST = 150.0  # … fewer or more than those, but never later than this
FOR_GOOD = 4.0  # after so many times the believable run, what it said before is not believed either
LEAST_MOVE_M = 0.002  # sooner, too, but not for less motion than noise may hide
RUN_RATE, RUN_FIRST_RATE, RUN_SAMPLES = 0.02, 0.05, 200  # longest runs are forgotten, the first ones soon
CLOSE_SAMPLES = 3  # a lone glitch is not the fold-back


@jit
def first_still(a: Any) -> Any:
    """How many equal samples in a row are believable of a sensor that has shown nothing yet."""
    if a.trend_dt_s <= 0.0:
        return 1.0 * STILL_SAMPLES
    return min(max(STILL_S / a.trend_dt_s, STILL_LEAST), 1.0 * STILL_SAMPLES)


@jit
def most_still(a: Any) -> Any:
    """How many equal samples in a row are still believable: a multiple of the usual, if that is known."""
    if a.still_usual == 0.0:
        return first_still(a)
    return min(STILL_RUNS * a.still_usual + STILL_MORE, STILL_MOST)


@jit
def learn_run(a: Any, n: Any) -> None:
    """Take the length of a run of equal samples: the longest lately is the usual."""
    if a.still_usual == 0.0:
        a.still_usual = (first_still(a) - STILL_MORE) / STILL_RUNS
    if n > a.still_usual:
        a.still_usual = n
    else:
        a.still_usual += (RUN_RATE if a.scored >= RUN_SAMPLES else RUN_FIRST_RATE) * (n - a.still_usual)


@jit
def watch_stuck(a: Any, repeated: Any, tool_z_m: Any) -> None:
    """Count equal samples in a row; the sensor is stuck when the tool moved along z during too many.

    `tool_z_m` is where the tool was at the sample. A tool that follows well sees equal samples, too, of a
    sensor that is coarser than its noise: how many is learned. What is stuck stays so until it changes.
    """
    if repeated == 0 or a.still == 0:
        if a.still > 0 and has_been_stuck(a) == 0:
            learn_run(a, a.still & (STUCK_RUN - 1))
        a.still = 1
        a.still_z_m = tool_z_m
        return
    a.still += 1
    if a.still >= STUCK_RUN:
        return
    most = most_still(a)
    move_m = min(max(STILL_MOVE_M * most / STILL_SAMPLES, LEAST_MOVE_M), STILL_MOVE_M)
    if a.still > most and abs(tool_z_m - a.still_z_m) > move_m:
        a.still += STUCK_RUN


@jit
def is_stuck(a: Any) -> Any:
    """1 when one value came for long although the tool moved along z."""
    return 1 if a.still >= STUCK_RUN else 0


@jit
def has_been_stuck(a: Any) -> Any:
    """1 when a sensor is stuck for good: a coarse one that was held for stuck changes as the tool stops."""
    return 1 if a.still > STUCK_RUN + FOR_GOOD * most_still(a) else 0


@jit
def patience_s(a: Any) -> Any:
    """For how long a sensor as slow as this one may say nothing beyond its usual delay [s]."""
    return min(PATIENT_SAMPLES * a.trend_dt_s, PATIENT_S)


@jit
def is_missing(a: Any) -> Any:
    """Whether samples of channel 0 stay away for longer than they usually do."""
    return a.now_ns - a.held_ns > a.late_s * 1e9 + max(DROPOUT_NS, patience_s(a) * 1e9)


@jit
def is_unsure(params: Any, a: Any) -> Any:
    """1 when no sample within the loss time-out entered an estimate that others had confirmed.

    A start with a single sample says little: starts that no second sample ever confirms are no estimate.
    """
    return 1 if a.samples == 0 or a.now_ns - a.sure_ns > params.loss_timeout_ns else 0


@jit
def watch_health(params: Any, a: Any, stuck: Any) -> None:
    """Find the state of the ranging now and show it with hysteresis."""
    wanted, reason = OK, REASON_NONE
    if a.faults & FAULT_NOT_FINITE and a.samples < STILL_SAMPLES:
        wanted, reason = FAULT, REASON_NOT_FINITE
    elif stuck != 0:
        wanted, reason = STUCK, REASON_STUCK
    elif a.samples == 0 or is_missing(a):
        edge = min(a.held_m - params.range_min_m, params.range_max_m - a.held_m)
        if a.samples > 0 and edge < EDGE_M:
            wanted, reason = OUT_OF_RANGE, REASON_OUTSIDE
        else:
            wanted, reason = DROPOUT, REASON_NO_READING
    elif is_unsure(params, a) != 0:
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
