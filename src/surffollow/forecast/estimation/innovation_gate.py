"""The innovation gate: outliers stay pending until enough of them agree, then they are a step.

A step toward the tool is confirmed by agreeing samples, one away from it also by distance travelled: it may
be a
slot. How much is learned: slots come back, steps do not. Outliers on a steady course, a flank, agree too;
then the
gate opens wide enough for the course to go on. Outliers that do not agree widen the gate: the ground is
rougher than was thought.
"""

from __future__ import annotations

from typing import Any

from surffollow.shm.jit import jit

START, ACCEPTED, PENDING, STEP, RESTART = 0, 1, 2, 3, 4

COURSE_WIDTH = 2.0  # width of the gate after a flank, in its rise per sample


@jit
def reset_gate(m: Any) -> None:
    """Begin at the newest sample."""
    g = m.gate
    g.pending = g.rejected = 0
    g.shift = g.innovation = 0.0
    g.verdict = START
    g.since = g.stepped = 0.0
    g.accepted_t = m.sample.t


@jit
def forget_scale(m: Any) -> None:
    """Assume the usual innovation of a start without knowledge."""
    m.gate.scale = m.noise.sigma
    m.gate.slots = 1.0


@jit
def judge_innovation(m: Any, predicted: Any, learn: Any) -> None:
    """Judge the newest sample; `predicted` is the blended prediction of its height."""
    g, s = m.gate, m.sample
    nu = s.height - predicted
    width = m.tuning.gate_gate * max(g.scale, 0.5 * m.noise.sigma)
    g.innovation = nu
    slot = m.tuning.gate_slot_share * m.reference.standoff
    if g.since < slot <= g.since + s.way and g.stepped != 0.0 and learn != 0:
        g.slots *= m.tuning.gate_stays
    g.since += s.way
    rate = max(m.tuning.gate_rate, 1.0 / (m.bank.samples + 1))
    if abs(nu) <= width:
        if g.pending >= m.tuning.gate_confirm and learn != 0:
            g.slots = 1.0
        g.pending = g.rejected = 0
        g.verdict = ACCEPTED
        g.accepted_t = s.t
        if learn != 0:
            g.scale += rate * (1.25 * abs(nu) - g.scale)
        return
    gap = s.dt > m.tuning.gate_standing_taus * m.plant.tau
    change = s.height - g.pending_last
    same = abs(change) < width
    steady = abs(change - g.pending_change) < width
    if g.pending > 0 and (same or (nu * g.pending_sum > 0.0 and (g.pending == 1 or steady))):
        g.pending += 1
        g.pending_way += s.way
        g.course = 0 if same else 1
        g.pending_change = change
    else:
        if g.pending > 0:
            g.rejected += 1
        if g.rejected > 0 and learn != 0:
            g.scale *= m.tuning.gate_growth
        g.pending, g.pending_sum, g.pending_t = 1, 0.0, s.t
        g.course, g.pending_change = 0, 0.0
        g.pending_way = slot if gap else 0.0
    g.pending_sum += nu
    g.pending_last = s.height
    g.verdict = PENDING
    slow = s.interval > m.tuning.gate_slow * m.plant.tau and g.course == 0
    need = m.tuning.gate_confirm_slow if slow else m.tuning.gate_confirm
    if g.pending < need:
        return
    wide = g.pending_way >= slot * g.slots
    standing = s.t - g.pending_t >= m.tuning.gate_standing_taus * m.plant.tau
    if nu > 0.0 or wide or standing or g.pending > m.bank.samples:
        g.verdict = RESTART if g.pending > m.bank.samples else STEP
        g.shift = g.pending_sum / g.pending
        if g.course != 0:
            g.shift = nu
            if learn != 0:
                g.scale = max(g.scale, COURSE_WIDTH * abs(change) / m.tuning.gate_gate)
        if g.since < slot and g.shift * g.stepped < 0.0:
            g.slots = 1.0
        g.since, g.stepped = 0.0, g.shift
        g.pending = g.rejected = 0
        g.accepted_t = s.t
