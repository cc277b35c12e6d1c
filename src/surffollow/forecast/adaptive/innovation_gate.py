"""The innovation gate: outliers stay pending until enough of them agree; then they are a step.

A step toward the tool is confirmed by agreeing samples, a step away from it also by distance travelled,
because it may be a slot. The distance depends on the likelihood of slots: slots end, steps stay.
"""

from __future__ import annotations

from typing import Any

from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import PENDING_HEIGHTS

SCALE_RATE = 0.02
PERMANENT_STEPS = 0.2
SLOT_DECAY, MIN_SLOT_LIKELIHOOD = 0.3, 0.01  # a step that stays makes the next one likelier to
STANDING_CONFIRMATION_NS = 120_000_000  # samples that agree for so long are ground, travelled or not
SCALE_GROWTH = 1.3
REJECTED_TOLERANCE = 2  # a slot has two: readings across them agree with nothing
INNER_GATE = 0.5  # of the gate: beyond, one sample alone is not believed
INITIAL_INNER_GATE = 0.125  # the same for the second sample: the first may have been the bad one


@jit
def update_scale(a: Any, nu_m: Any, gate_m: Any) -> None:
    """How large innovations usually are."""
    a.scale_m += SCALE_RATE * (1.25 * min(abs(nu_m), gate_m) - a.scale_m)


@jit
def hold_pending(params: Any, a: Any, nu_m: Any, way_m: Any, gate_m: Any, gap: Any, adapt: Any) -> Any:
    """Hold back an outlying innovation; 1 when with it a step is believed.

    `a.quarantine_s_m` and `a.quarantine_h_m` sum way and height of the samples that agree.
    """
    last = a.kept_h_m[(a.quarantined - 1) & (PENDING_HEIGHTS - 1)]
    if a.quarantined > 0 and abs(a.height_m + nu_m - last) < gate_m:
        a.quarantined += 1
        a.quarantine_way_m += way_m
    else:
        if a.quarantined > 0:
            a.disagreed += 1
        if a.disagreed > REJECTED_TOLERANCE and adapt != 0:
            # outliers that do not agree with each other: the ground is rougher than thought
            a.scale_m *= SCALE_GROWTH
        a.quarantined = 1
        a.quarantine_m = a.quarantine_s_m = a.quarantine_h_m = 0.0
        a.quarantine_way_m = params.step_way_m if gap else 0.0
        a.quarantine_ns = a.sample_ns
    a.quarantine_m += nu_m
    a.quarantine_s_m += a.path_m
    a.quarantine_h_m += a.height_m + nu_m
    slot = (a.quarantined - 1) & (PENDING_HEIGHTS - 1)
    a.kept_s_m[slot], a.kept_h_m[slot] = a.path_m, a.height_m + nu_m
    # where steps have always stayed, and on a step's way up or down, two samples tell enough
    goes_on = a.since_step_m < params.step_way_m and nu_m * a.step_m > 0.0
    few = a.returned < PERMANENT_STEPS or goes_on
    need = min(params.step_samples, 2) if few else params.step_samples
    if a.quarantined < need:
        return 0
    if nu_m > 0.0 or goes_on or a.quarantine_way_m >= params.step_way_m * a.returned:
        return 1
    # a start with a bad sample is outvoted; where the tool stands, no way will ever tell
    outvoted = a.quarantined > a.samples
    return 1 if outvoted or a.sample_ns - a.quarantine_ns >= STANDING_CONFIRMATION_NS else 0


@jit
def needs_second_sample(a: Any, nu_m: Any, gate_m: Any) -> Any:
    """1 for a lone innovation near the gate, on a slot's edge or a small glitch; a second is believed."""
    before = a.doubted_m
    a.doubted_m = 0.0
    least = INNER_GATE if a.samples > 1 else INITIAL_INNER_GATE
    if not least * gate_m < abs(nu_m) <= gate_m or before * nu_m > 0.0:
        return 0
    a.doubted_m = nu_m
    return 1
