"""Health of the ranging: stuck-at fault, fold-back, window, losses, each with its reason."""

from __future__ import annotations

from typing import Any

from surffollow.forecast.estimation.noise import LEAST_SHARE, SIGMA_OF_MAD, running_median
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import (
    DROPOUT,
    FAULT,
    FAULT_CLOSE,
    FAULT_LOST,
    FAULT_NOT_FINITE,
    FAULT_STUCK,
    OK,
    OUT_OF_RANGE,
    STUCK,
    SUSPECT,
)
from surffollow.shm.layout_multimodel import (
    REASON_FIRST,
    REASON_LOST,
    REASON_NO_READING,
    REASON_NONE,
    REASON_NOT_FINITE,
    REASON_OUTSIDE,
    REASON_PENDING,
    REASON_STUCK,
    REASON_TIMESTAMPS,
)

STUCK_SAMPLES = 14  # within the band: one noise run in 5e7 is as quiet
STUCK_BAND = 0.5  # in standard deviations of a range
STUCK_TRAVEL = 3.0  # in the same: the tool must have moved so far up or down
EQUAL_SAMPLES = 50  # of a sensor whose noise is below its resolution …
TRAVEL_SHARE = 0.02  # … and travel, of the stand-off; the branch of the fold-back is judged over it too
LOST_INTERVALS, LOST_TAUS = 4.0, 0.5  # without samples beyond the usual delay: no drop-out yet
FIRST_SAMPLES = 20


@jit
def watch_ranges(m: Any) -> None:
    """Look at the newest range: stuck-at fault and fold-back.

    A sensor is stuck when its ranges lie closer together
    than its own noise allows while the tool moves up or down: a live one answers to the tool's motion, or
    shows its noise when the ground rises with the tool.
    """
    h, s, k = m.health, m.sample, m.kinematics
    if s.fresh == 0:
        return
    standoff = m.reference.standoff
    if s.count > 2 and h.stuck == 0:
        e = abs(s.range - 2.0 * s.range_1 + s.range_2)
        h.flicker = running_median(h.flicker, e, s.count, 0.1 * LEAST_SHARE * standoff)
    noisy = h.flicker > LEAST_SHARE * standoff
    sigma = SIGMA_OF_MAD * h.flicker
    if h.stuck_n > 0 and abs(s.range - h.stuck_range) <= (STUCK_BAND * sigma if noisy else 0.0):
        h.stuck_n += 1
    else:
        h.stuck_n, h.stuck, h.stuck_z, h.stuck_range = 1, 0, k.z, s.range
    moved = abs(k.z - h.stuck_z)
    if noisy and h.stuck_n >= STUCK_SAMPLES and moved > STUCK_TRAVEL * sigma:
        h.stuck = 1
    if h.stuck_n >= EQUAL_SAMPLES and moved > TRAVEL_SHARE * standoff:
        h.stuck = 1
    if h.stuck != 0:
        h.faults |= FAULT_STUCK
    _watch_fold_back(m)


@jit
def _watch_fold_back(m: Any) -> None:
    """Latch or release TOO_CLOSE.

    Nearer than its near limit a triangulating sensor reads like a farther target. The latch is released
    when a move of the tool shows the range to move with it beyond the exit distance.
    """
    h, s, z = m.health, m.sample, m.kinematics.z
    if h.close == 0:
        if s.range < m.reference.too_close:
            h.close, h.close_z, h.close_range = 1, z, s.range
            h.faults |= FAULT_CLOSE
        return
    rise = z - h.close_z
    if abs(rise) < TRAVEL_SHARE * m.reference.standoff:
        return
    if (s.range - h.close_range) * rise > 0.5 * rise * rise and s.range > m.reference.too_close_exit:
        h.close = 0
    h.close_z, h.close_range = z, s.range


@jit
def watch_readings(m: Any, given: Any, seen: Any) -> None:
    """Count readings outside the window: `given` 1 when a finite one came, `seen` 1 when it was inside."""
    if seen != 0:
        m.health.missed = 0
    elif given != 0:
        m.health.missed += 1


@jit
def is_lost(m: Any, loss_timeout: Any) -> Any:
    """1 when no sample entered the estimate within the loss time-out, or there is none to rely on."""
    return 1 if m.bank.samples == 0 or m.kinematics.now - m.gate.accepted_t > loss_timeout else 0


@jit
def assess(m: Any, lost: Any) -> None:
    """Set the state and its reason."""
    h, s = m.health, m.sample
    patience = max(LOST_INTERVALS * s.interval, LOST_TAUS * m.plant.tau)
    silent = m.kinematics.now - s.t - s.delay
    if h.faults & FAULT_NOT_FINITE:
        h.state, h.reason = FAULT, REASON_NOT_FINITE
    elif h.stuck != 0:
        h.state, h.reason = STUCK, REASON_STUCK
    elif h.missed > 2 and silent > patience:
        h.state, h.reason = OUT_OF_RANGE, REASON_OUTSIDE
    elif lost != 0:
        h.state, h.reason = DROPOUT, REASON_LOST
    elif silent > patience:
        h.state, h.reason = DROPOUT, REASON_NO_READING
    elif m.gate.pending > 0 or m.gate.rejected > 0:
        h.state, h.reason = SUSPECT, REASON_PENDING
    elif s.shift > 0.0:
        h.state, h.reason = SUSPECT, REASON_TIMESTAMPS
    elif m.bank.samples < FIRST_SAMPLES:
        h.state, h.reason = SUSPECT, REASON_FIRST
    else:
        h.state, h.reason = OK, REASON_NONE
    if lost != 0 and s.count > 0:
        h.faults |= FAULT_LOST


@jit
def note_not_finite(m: Any) -> None:
    """Latch that the estimate began anew."""
    m.health.faults |= FAULT_NOT_FINITE


@jit
def reset_health(m: Any, scales: Any) -> None:
    """Clear latched faults; the fold-back latch is safety and stays unless the reference scales changed."""
    h = m.health
    h.faults = h.stuck = h.stuck_n = h.missed = 0
    if scales != 0:
        h.close = 0
        h.flicker = 0.0
