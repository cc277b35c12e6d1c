"""The innovation gate: what becomes of a sample.

    ========= ================================================== ===========================================
    |ν|       samples before                                     decision
    ========= ================================================== ===========================================
    ≤ G₀/2                                                       ACCEPTED
    G₀/2 … G  none withheld on its side, and none rises          WITHHELD, unless samples are sparse
    G₀/2 … G  one withheld on its side, or one that rises        ACCEPTED
    > G       too few that agree (`pending_samples`)             PENDING
    > G       enough that agree                                  STEP: every model is shifted
    > G       the same, and more than all accepted ones          RESTART: the first samples were bad
    ========= ================================================== ===========================================

ν is the innovation, G₀ the usual width of the gate and G that for this sample (`_decide`). A single sample
beyond G₀/2 is the edge of a slot or a glitch.
"""

import math

from surffollow.forecast import quantities
from surffollow.forecast.estimation import pending_samples
from surffollow.forecast.modes import adapts
from surffollow.forecast.sensing.sample_hold import is_slow, resolution_m
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_estimation import ACCEPTED, PENDING, RESTART, STEP, WITHHELD


@jit
def gate_sample(params, adaptive, innovation_m, travel_m, change_limit_m):
    """Decide on a sample, and note what the next one needs of it.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`gate`, `pending` updated)
    innovation_m : float64  innovation ν of the sample [m]
    travel_m : float64      distance travelled d since the sample before [m]
    change_limit_m : float64  greatest change of the ground since the last accepted sample [m]

    Returns
    -------
    int64
        WITHHELD, PENDING, ACCEPTED, STEP or RESTART.
    """
    gate, pending, estimate = adaptive.gate, adaptive.pending, adaptive.estimate
    rises_on = gate.nearer != 0 and innovation_m > 0.0
    gate.rise_limit_m = quantities.MAX_SLOPE * change_limit_m if rises_on else change_limit_m
    _update_travel(params, gate, travel_m)
    decision = _decide(params, adaptive, innovation_m, travel_m, change_limit_m, rises_on)
    if decision == ACCEPTED:
        if pending.samples >= params.step_samples:  # enough for a step: they were a slot
            gate.slot_likelihood = 1.0
        pending_samples.drop_pending(pending)
        gate.nearer, gate.unconfirmed_m, gate.withheld_m = 0, 0.0, 0.0
    elif decision < ACCEPTED:  # it waits
        adapt, noisy_s = adapts(params, adaptive), pending.rejected * adaptive.hold.interval_s
        if adapt and decision == WITHHELD and estimate.samples > 1:
            update_scale(gate, innovation_m)  # frequent ones mean rough ground
        _note_nearer(gate, innovation_m, decision == WITHHELD)
        # many that agree with none, and lie on both sides, are noise. After few samples the estimate itself
        # may lie on one side of them
        both_sides = pending.opposed >= 3 or estimate.samples < quantities.USUAL_SAMPLES
        if adapt and noisy_s > adaptive.plant.tau_s and pending.rejected >= 8 and both_sides:
            gate.scale_m *= 1.25
    return decision


@jit
def _decide(params, adaptive, innovation_m, travel_m, change_limit_m, rises_on):
    """Decision on a sample.

    With G₀ = max(`gate_scales` · usual |ν|, `gate_m`, two counts) and plausible = 0.2 d, or `change_limit_m`
    while no slope is known, G = max(G₀, plausible); until then the inner gate is G/2. Samples are sparse, and
    each counts, where the plausible change exceeds G₀. Behind a drop-out a second one comes soon: they are
    sparse if they usually are.
    """
    gate, samples = adaptive.gate, adaptive.estimate.samples
    usual, sparse_m = gate_width(params, adaptive), quantities.PLAUSIBLE_SLOPE * travel_m
    usual_way_m = quantities.DROPOUT_INTERVALS * adaptive.kinematics.speed_mps * adaptive.hold.interval_s
    begins = samples < quantities.CONFIRMATION_SAMPLES
    plausible = change_limit_m if begins else sparse_m
    gate.width_m = max(usual, plausible)
    sparse = min(sparse_m, quantities.PLAUSIBLE_SLOPE * usual_way_m) > usual
    # while no slope is known, samples of nearer ground count on their own
    sparse = sparse or (begins and innovation_m > 0.0 and plausible > usual)
    inner_m = pending_samples.INNER_GATE * (gate.width_m if begins else usual)
    if not sparse and not rises_on and _needs_second_sample(gate, innovation_m, inner_m):
        pending_samples.reject_pending(adaptive.pending)
        return WITHHELD
    if not abs(innovation_m) > gate.width_m:  # NaN too: the cycle then begins without knowledge
        return ACCEPTED
    # a glitch behind a sample that waited is beyond any rise of the ground from the gate on
    rise_m = pending_samples.possible_rise_m(params, adaptive, travel_m)
    rises_on = rises_on and innovation_m < gate.width_m + rise_m
    if not pending_samples.confirm_by(params, adaptive, innovation_m, travel_m, rises_on):
        return PENDING
    return RESTART if adaptive.pending.samples > samples else STEP


@jit
def _needs_second_sample(gate, innovation_m, inner_m):
    """Whether a single innovation lies between the inner gate and the gate; a second one is accepted."""
    before = gate.unconfirmed_m
    gate.unconfirmed_m = 0.0
    if not inner_m < abs(innovation_m) <= gate.width_m or before * innovation_m > 0.0:
        return False
    gate.unconfirmed_m = innovation_m
    return True


@jit
def _update_travel(params, gate, travel_m):
    """Add the distance travelled since the last step; a step that stays lowers the likelihood of slots."""
    before_m = gate.travel_since_step_m
    gate.travel_since_step_m += travel_m
    if before_m < params.step_travel_m <= gate.travel_since_step_m and gate.step_m != 0.0:
        gate.slot_likelihood = max(0.3 * gate.slot_likelihood, 0.01)


@jit
def register_step(params, gate, pending, t_ns):
    """Take the pending samples as a step confirmed at `t_ns`."""
    # ground that is nearer again within the width of a slot: the fall before was a slot, or the path began in
    # one; where the ground outside it begins says nothing about steps
    width_m = gate.travel_since_step_m - pending.travel_m
    fell = gate.step_m < 0.0 or gate.step_ns == 0
    leaves_slot = fell and pending.innovation_m > 0.0 and width_m < params.step_travel_m
    # among outliers that agreed with none a step may be one of a burst, and says nothing about steps;
    # but those on an edge lie between the heights before and behind it
    step_m = pending.innovation_m / pending.samples
    below = pending.least_m < min(step_m, 0.0) - gate.width_m
    above = pending.greatest_m > max(step_m, 0.0) + gate.width_m
    burst = pending.rejected >= quantities.CONFIRMATION_SAMPLES and (below or above)
    if (leaves_slot and gate.step_ns != 0) or burst:
        gate.slot_likelihood = 1.0
    gate.travel_since_step_m = 0.0
    gate.nearer = 1 if pending.innovation_m > 0.0 else 0
    gate.step_m = 0.0 if leaves_slot or burst else step_m
    gate.step_ns = t_ns
    gate.withheld_m = 0.0
    pending_samples.drop_pending(pending)


@jit
def _note_nearer(gate, innovation_m, inside):
    """Note how much nearer a waiting sample is; nothing where ground cannot rise like that.

    `inside`: it is inside the gate, no outlier, and the next one may be nearer, too.
    """
    gate.nearer = 1 if inside and innovation_m > 0.0 else 0
    gate.withheld_m = innovation_m if 0.0 < innovation_m < gate.rise_limit_m else 0.0


@jit
def note_remainder(params, adaptive, remainder_m):
    """Note what is left of an innovation after the update, if the models follow too slowly [m]."""
    if remainder_m > pending_samples.INNER_GATE * gate_width(params, adaptive):
        _note_nearer(adaptive.gate, remainder_m, True)


@jit
def update_scale(gate, innovation_m):
    """Update the usual innovation with one that counts at most the width of the gate."""
    scale_m = quantities.MEAN_TO_SIGMA * min(abs(innovation_m), gate.width_m)
    gate.scale_m += quantities.QUICK_RATE * (scale_m - gate.scale_m)


@jit
def gate_width(params, adaptive):
    """Usual width of the gate [m]: neighbouring counts of a coarse sensor agree."""
    return max(params.gate_scales * adaptive.gate.scale_m, params.gate_m, 2.0 * resolution_m(adaptive.hold))


@jit
def is_outlier(params, adaptive, innovation_m, travel_m):
    """Whether a sample with this innovation, so far behind the one before, lies beyond the inner gate."""
    width_m = max(gate_width(params, adaptive), quantities.PLAUSIBLE_SLOPE * travel_m)
    return abs(innovation_m) > pending_samples.INNER_GATE * width_m


@jit
def withheld_setpoint(adaptive, standoff_m):
    """Setpoint over a nearer sample of a slow sensor that waits for a second one [m]; −∞: there is none."""
    gate = adaptive.gate
    if gate.withheld_m == 0.0 or not is_slow(adaptive):
        return -math.inf
    return adaptive.estimate.height_m + gate.withheld_m + standoff_m


@jit
def reset_gate(gate, pending):
    """Drop pending samples and the last step; scale and likelihood of slots stay."""
    pending_samples.drop_pending(pending, pending.rejected)
    gate.unconfirmed_m = gate.withheld_m = gate.travel_since_step_m = gate.step_m = 0.0
    gate.nearer = gate.step_ns = 0
