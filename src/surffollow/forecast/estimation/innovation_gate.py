"""The innovation gate: outliers stay pending until enough of them agree, then they are a step.

A step toward the tool is confirmed by agreeing samples, one away from it also by distance travelled: it may be a
slot. Outliers that do not agree widen the gate: the ground is rougher than was thought.
"""

from __future__ import annotations

from typing import Any

from surffollow.shm.jit import jit

START, ACCEPTED, PENDING, STEP, RESTART = 0, 1, 2, 3, 4

GATE = 8.0  # in usual innovations
RATE = 0.02  # of the usual innovation, per sample
FIRST_SCALE = 8e-3  # of the stand-off: usual innovation before any is known
CONFIRM = 3  # agreeing samples that confirm a step …
CONFIRM_SLOW = 2  # … and when a sample interval is longer than a quarter of the axis' time constant
SLOW = 0.25
SLOT_SHARE = 0.025  # of the stand-off: wider hollows are ground
STANDING_TAUS = 3.0  # samples that agree for so long are ground, travelled or not
GROWTH = 1.3  # of the usual innovation, per outlier that agrees with none
DISAGREE = 2  # so many outliers that do not agree are the edges of a slot
GAP_TAUS = 3.0  # after a longer gap a step is confirmed without travel


@jit
def reset_gate(m: Any) -> None:
    """Begin at the newest sample."""
    g = m.gate
    g.pending = g.rejected = 0
    g.shift = g.innovation = 0.0
    g.verdict = START
    g.accepted_t = m.sample.t


@jit
def forget_scale(m: Any) -> None:
    """Assume the usual innovation of a start without knowledge."""
    m.gate.scale = FIRST_SCALE * m.reference.standoff


@jit
def judge_innovation(m: Any, predicted: Any, learn: Any) -> None:
    """Judge the newest sample; `predicted` is the blended prediction of its height."""
    g, s = m.gate, m.sample
    nu = s.height - predicted
    width = GATE * max(g.scale, 0.5 * m.noise.sigma)
    g.innovation = nu
    rate = max(RATE, 1.0 / (m.bank.samples + 1))
    if abs(nu) <= width:
        g.pending = g.rejected = 0
        g.verdict = ACCEPTED
        g.accepted_t = s.t
        if learn != 0:
            g.scale += rate * (1.25 * abs(nu) - g.scale)
        return
    gap = s.dt > GAP_TAUS * m.plant.tau
    if g.pending > 0 and abs(s.height - g.pending_last) < width:
        g.pending += 1
        g.pending_way += s.way
    else:
        if g.pending > 0:
            g.rejected += 1
        if g.rejected > DISAGREE and learn != 0:
            g.scale *= GROWTH
        g.pending, g.pending_sum, g.pending_t = 1, 0.0, s.t
        g.pending_way = SLOT_SHARE * m.reference.standoff if gap else 0.0
    g.pending_sum += nu
    g.pending_last = s.height
    g.verdict = PENDING
    need = CONFIRM_SLOW if s.interval > SLOW * m.plant.tau else CONFIRM
    if g.pending < need:
        return
    wide = g.pending_way >= SLOT_SHARE * m.reference.standoff
    standing = s.t - g.pending_t >= STANDING_TAUS * m.plant.tau
    if nu > 0.0 or wide or standing or g.pending > m.bank.samples:
        g.verdict = RESTART if g.pending > m.bank.samples else STEP
        g.shift = g.pending_sum / g.pending
        g.pending = g.rejected = 0
        g.accepted_t = s.t
