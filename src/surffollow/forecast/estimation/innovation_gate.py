"""The innovation gate: outliers stay pending until enough of them agree; then they are a step.

A step toward the tool is confirmed by agreeing samples, a step away from it also by distance travelled,
because it may be a slot. The distance depends on the likelihood of slots: slots end, steps stay.
"""

import math

from surffollow.forecast.estimation.noise import INITIAL_NOISE_M
from surffollow.forecast.quantities import (
    CONFIRMATION_SAMPLES,
    MAX_SLOPE,
    PLAUSIBLE_SLOPE,
    QUICK_RATE,
    USUAL_SAMPLES,
)
from surffollow.forecast.sensing.sample_hold import count_m
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_estimation import PENDING_HEIGHTS

# two samples confirm a step where more of them take longer than so many time constants of the axis; where
# the interval is longer than that, the tool rises before the second one
CONFIRMATION_TAUS = 0.5
INNER_GATE = 0.5  # of the gate: beyond, a single sample is not accepted, and two pending ones do not agree


@jit
def update_scale(gate, innovation_m, gate_m):
    """Update the usual innovation."""
    gate.scale_m += QUICK_RATE * (1.25 * min(abs(innovation_m), gate_m) - gate.scale_m)


@jit
def widen_gate(gate, samples):
    """Raise the usual innovation where many outliers in a row agree with none, and lie on both sides.

    They are noise. After few `samples` the estimate itself may lie on one side of them.
    """
    if gate.rejected >= 8 and (gate.opposed >= 3 or samples < USUAL_SAMPLES):
        gate.scale_m *= 1.25


@jit
def gate_sample(params, adaptive, innovation_m, travel_m, steepest_m, gap, rises_on):
    """Whether a sample enters the estimate, and the width of the gate; beyond that width it confirms a step.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`gate` updated)
    innovation_m : float64  innovation ν of the sample [m]
    travel_m : float64      distance travelled d since the sample before [m]
    steepest_m : float64    greatest change of the ground since the last accepted sample [m]
    gap : bool              the samples paused before: a step needs no travel
    rises_on : bool         this sample is nearer, and the one before was nearer than the models follow

    Returns
    -------
    bool, float64 [m]

    Notes
    -----
    With u = max(`gate_scales` · usual |ν|, `gate_m`, two counts) and plausible = 0.2 d, or `steepest_m` while
    no slope is known, G = max(u, plausible). Samples are sparse, and each counts, where the plausible change
    exceeds u.
    """
    samples = adaptive.estimate.samples
    usual, sparse_m = gate_width(params, adaptive), PLAUSIBLE_SLOPE * travel_m
    plausible = sparse_m if samples >= CONFIRMATION_SAMPLES else steepest_m
    width = max(usual, plausible)
    # while no slope is known, samples of nearer ground count on their own
    sparse = (plausible if innovation_m > 0.0 else sparse_m) > usual
    if not sparse and not rises_on and needs_second_sample(adaptive, innovation_m, width):
        return False, width
    if not abs(innovation_m) > width:  # NaN too: the cycle then begins without knowledge
        return True, width
    return hold_pending(params, adaptive, innovation_m, travel_m, width, gap, rises_on), width


@jit
def hold_pending(params, adaptive, innovation_m, travel_m, gate_m, gap, rises_on):
    """Hold an outlier as pending; whether it confirms a step.

    `pending_arc_length_m` and `pending_height_m` are sums over the samples that agree.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`gate` updated)
    innovation_m : float64  innovation of the sample [m], outside the gate
    travel_m : float64      distance travelled since the sample before [m]
    gate_m : float64        width of the gate [m]
    gap : bool              the samples paused before: a step needs no travel
    rises_on : bool         as in `gate_sample`: one sample less is needed

    Notes
    -----
    With the likelihood of slots ρ, the sensor's interval T, the axis' time constant τ and n = `step_samples`:

        need = (2 if ρ < 0.2 or n T > τ/2, else n) + min(outliers that agreed with none, τ / (4 T)) − rises_on
        is_step = ν > 0, or travel ≥ ρ · `step_travel`, or time ≥ 120 ms, or pending > accepted samples

    A step is confirmed when pending ≥ need and is_step. One outlier that disagrees with n others is left out.
    """
    gate, estimate = adaptive.gate, adaptive.estimate
    tau_s, interval_s = adaptive.plant.tau_s, adaptive.prediction.interval_s
    height_m = estimate.height_m + innovation_m
    last_height = gate.kept_height_m[(gate.pending - 1) & (PENDING_HEIGHTS - 1)]
    further = height_m - last_height
    tolerance = max(INNER_GATE * gate_m, params.gate_m, 1.5 * count_m(adaptive.hold))
    if further * innovation_m > 0.0:  # on a flank the outliers of a slow sensor go on in their direction
        tolerance += travel_m
        if innovation_m > 0.0:
            tolerance = max(tolerance, MAX_SLOPE * travel_m)
    agrees = gate.pending > 0 and abs(further) < tolerance
    if not agrees and gate.pending >= params.step_samples and gate.odd == 0:
        gate.odd = 1  # a glitch among many that agree
        gate.pending_travel_m += travel_m
        return False
    gate.odd = 0
    if agrees:
        gate.pending += 1
        gate.pending_travel_m += travel_m
    else:
        if gate.pending > 0:
            gate.rejected += 1
            gate.opposed += 1 if innovation_m * gate.pending_innovation_m < 0.0 else 0
        gate.pending = 1
        gate.pending_innovation_m = gate.pending_arc_length_m = gate.pending_height_m = 0.0
        gate.pending_travel_m = params.step_travel_m if gap else 0.0
        gate.pending_ns = estimate.sample_ns
    gate.pending_innovation_m += innovation_m
    gate.pending_arc_length_m += estimate.arc_length_m
    gate.pending_height_m += height_m
    slot = (gate.pending - 1) & (PENDING_HEIGHTS - 1)
    gate.kept_arc_length_m[slot], gate.kept_height_m[slot] = estimate.arc_length_m, height_m
    # two samples are enough where steps have stayed, and where a third one comes late
    late = params.step_samples * interval_s > CONFIRMATION_TAUS * tau_s
    two = late or gate.slot_likelihood < 0.2
    # in a burst of wrong readings some agree by chance; they delay a step by no more than τ/4
    by_chance = min(gate.rejected, int(0.25 * tau_s / max(interval_s, 1e-6)))
    need = (min(params.step_samples, 2) if two else params.step_samples) + by_chance - rises_on
    # a step away from the tool may be a slot; with a bad start, and at rest for 120 ms, there is no travel
    travelled = gate.pending_travel_m >= params.step_travel_m * gate.slot_likelihood
    stood = estimate.sample_ns - gate.pending_ns >= 120_000_000
    is_step = innovation_m > 0.0 or travelled or stood or gate.pending > estimate.samples
    return gate.pending >= need and is_step


@jit
def needs_second_sample(adaptive, innovation_m, gate_m):
    """Whether a single innovation lies between the inner gate and the gate.

    It is the edge of a slot or a small glitch. A second one on the same side is accepted.
    """
    gate = adaptive.gate
    before = gate.unconfirmed_m
    gate.unconfirmed_m = 0.0
    if not INNER_GATE * gate_m < abs(innovation_m) <= gate_m or before * innovation_m > 0.0:
        return False
    gate.unconfirmed_m = innovation_m
    if gate.pending > 0:  # it agrees with no outlier before
        gate.rejected += 1
        gate.pending = 0
    return True


@jit
def withhold_sample(gate, innovation_m, plausible_m, inside):
    """Note how much nearer a sample is that waits for a second one; 0 where ground cannot rise like that.

    Parameters
    ----------
    gate : record of `Gate` (updated)
    innovation_m : float64  how much nearer it is than the estimate [m]
    plausible_m : float64   greatest rise of the ground since the last accepted sample [m]
    inside : bool           it is inside the gate: no outlier
    """
    gate.nearer = 1 if inside and innovation_m > 0.0 else 0
    gate.withheld_m = innovation_m if 0.0 < innovation_m < plausible_m else 0.0


@jit
def is_slow(adaptive):
    """Whether the sensor's interval is longer than τ/2: a second sample comes late."""
    return adaptive.prediction.interval_s > CONFIRMATION_TAUS * adaptive.plant.tau_s


@jit
def withheld_setpoint(adaptive, standoff_m):
    """Setpoint over a nearer sample of a slow sensor that waits for a second one [m]; −∞: there is none."""
    gate = adaptive.gate
    if gate.withheld_m == 0.0 or not is_slow(adaptive):
        return -math.inf
    return adaptive.estimate.height_m + gate.withheld_m + standoff_m


@jit
def gate_width(params, adaptive):
    """Width of the gate [m]: neighbouring counts of a coarse sensor agree."""
    return max(params.gate_scales * adaptive.gate.scale_m, params.gate_m, 2.0 * count_m(adaptive.hold))


@jit
def update_travel(params, gate, travel_m):
    """Add the distance travelled since the last step; a step that stays lowers the likelihood of slots."""
    before_m = gate.travel_since_step_m
    gate.travel_since_step_m += travel_m
    if before_m < params.step_travel_m <= gate.travel_since_step_m and gate.step_m != 0.0:
        gate.slot_likelihood = max(0.3 * gate.slot_likelihood, 0.01)


@jit
def accept_sample(params, gate):
    """Drop the pending samples; if they were enough for a step, they were a slot."""
    if gate.pending >= params.step_samples:
        gate.slot_likelihood = 1.0
    gate.pending = gate.rejected = gate.opposed = 0
    gate.unconfirmed_m = gate.withheld_m = 0.0
    gate.nearer = 0


@jit
def register_step(params, gate, t_ns):
    """Take the pending samples as a step confirmed at `t_ns`."""
    # ground that is nearer again within the width of a slot: the fall before was a slot, or the path began in
    # one; where the ground outside it begins says nothing about steps
    width_m = gate.travel_since_step_m - gate.pending_travel_m
    fell = gate.step_m < 0.0 or gate.step_ns == 0
    leaves_slot = fell and gate.pending_innovation_m > 0.0 and width_m < params.step_travel_m
    if leaves_slot and gate.step_ns != 0:
        gate.slot_likelihood = 1.0
    gate.travel_since_step_m = 0.0
    gate.nearer = 1 if gate.pending_innovation_m > 0.0 else 0
    gate.step_m = 0.0 if leaves_slot else gate.pending_innovation_m / gate.pending
    gate.step_ns = t_ns
    gate.pending = gate.rejected = gate.opposed = 0
    gate.withheld_m = 0.0


@jit
def reset_gate(gate, fresh):
    """Drop pending samples and the last step; scale and likelihood of slots stay but in a fresh start."""
    if fresh:
        gate.scale_m, gate.slot_likelihood = 2.0 * INITIAL_NOISE_M, 1.0
    gate.pending = gate.rejected = gate.opposed = gate.nearer = 0
    gate.unconfirmed_m = gate.withheld_m = 0.0
    gate.travel_since_step_m = gate.step_m = 0.0
    gate.step_ns = 0


@jit
def discard_slots(gate):
    """Mark the likelihood of slots as not known, and with it all that a fresh start assumes."""
    gate.slot_likelihood = 0.0
