"""Health of the ranging, with hysteresis: what is wrong, shown soon, withdrawn late."""

from __future__ import annotations

from typing import Any

from numba import njit

from surffollow.shm.layout_adaptive import (
    DROPOUT,
    FAULT,
    FAULT_NOT_FINITE,
    OK,
    OUT_OF_RANGE,
    STUCK,
    SUSPECT,
)

ENTER_NS = 10_000_000  # a worse state is shown after so long
LEAVE_NS = 100_000_000  # a better one after so long
DROPOUT_NS = 50_000_000  # no sample for so long beyond the usual delay …
DROPOUT_INTERVALS = 2.5  # … or for so many usual intervals of a slow sensor …
DROPOUT_MOST_NS = 1_000_000_000  # … but never for longer
EDGE_M = 0.003  # a loss that began so near the window's ends is a matter of range
STILL_SAMPLES = 50  # one value so often …
STILL_MOVE_M = 0.005  # … while the tool moved so far along z: the sensor is stuck
CLOSE_SAMPLES = 3  # a lone glitch is not the fold-back


@njit(cache=True, nogil=True)
def watch_stuck(a: Any, repeated: Any, tool_z_m: Any) -> None:
    """Count equal samples in a row while the tool moves."""
    if repeated == 0 or a.still == 0:
        a.still = 1
        a.still_z_m = tool_z_m
    else:
        a.still += 1


@njit(cache=True, nogil=True)
def is_stuck(a: Any, tool_z_m: Any) -> Any:
    """1 when one value came for long although the tool moved along z."""
    return 1 if a.still > STILL_SAMPLES and abs(tool_z_m - a.still_z_m) > STILL_MOVE_M else 0


@njit(cache=True, nogil=True)
def is_missing(a: Any) -> Any:
    """Whether samples of channel 0 stay away for longer than they usually do."""
    usual_ns = min(DROPOUT_INTERVALS * a.trend_dt_s * 1e9, DROPOUT_MOST_NS)
    return a.now_ns - a.held_ns > a.late_s * 1e9 + max(DROPOUT_NS, usual_ns)


@njit(cache=True, nogil=True)
def watch_health(params: Any, a: Any, stuck: Any) -> None:
    """Find the state of the ranging now and show it with hysteresis."""
    wanted = OK
    if a.faults & FAULT_NOT_FINITE and a.samples < STILL_SAMPLES:
        wanted = FAULT
    elif stuck != 0:
        wanted = STUCK
    elif a.samples == 0 or is_missing(a):
        edge = min(a.held_m - params.range_min_m, params.range_max_m - a.held_m)
        wanted = OUT_OF_RANGE if a.samples > 0 and edge < EDGE_M else DROPOUT
    elif a.quarantined > 0:
        wanted = SUSPECT
    if wanted == a.health:
        a.health_next = wanted
        a.health_ns = a.now_ns
        return
    if wanted != a.health_next:
        a.health_next = wanted
        a.health_ns = a.now_ns
    wait = ENTER_NS if wanted > a.health else LEAVE_NS
    if a.now_ns - a.health_ns >= wait:
        a.health = wanted
