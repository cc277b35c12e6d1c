"""Samples outside the innovation gate: they stay pending until enough of them agree; then they are a step.

A step toward the tool is confirmed by agreeing samples, a step away from it also by distance travelled,
because it may be a slot. The distance depends on the likelihood of slots: slots end, steps stay.
"""

from surffollow.forecast.plant.axis_model import is_long
from surffollow.forecast.quantities import CONFIRMATION_SAMPLES, MAX_SLOPE, PAUSE_NS
from surffollow.forecast.sensing.sample_hold import HOLD_TOLERANCE_COUNTS, is_slow, resolution_m
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_estimation import PENDING_HEIGHTS

INNER_GATE = 0.5  # of the gate: beyond, a single sample is not accepted, and two pending ones do not agree


@jit
def possible_rise_m(params, adaptive, travel_m):
    """Rise of nearer ground between two samples: by `MAX_SLOPE`, or as fast as the axis can move [m]."""
    return max(MAX_SLOPE * travel_m, params.plant_v_max_mps * adaptive.hold.interval_s)


@jit
def _agrees(params, adaptive, innovation_m, travel_m):
    """Whether an outlier is as high as the pending one before, but for a slope of 1 between the two.

    Nearer ground may rise by up to `MAX_SLOPE`. Ground that rises, or moves below a tool at rest, may move as
    fast as the axis can.
    """
    pending, inner_m = adaptive.pending, INNER_GATE * adaptive.gate.width_m
    height_m = adaptive.estimate.height_m + innovation_m
    further_m = height_m - pending.kept_height_m[(pending.samples - 1) & (PENDING_HEIGHTS - 1)]
    tolerance = max(inner_m, params.gate_m, HOLD_TOLERANCE_COUNTS * resolution_m(adaptive.hold))
    tolerance += travel_m
    if further_m > 0.0 or adaptive.estimate.rests != 0:
        nearer_m = travel_m if innovation_m > 0.0 else 0.0
        tolerance = max(tolerance, possible_rise_m(params, adaptive, nearer_m))
    return pending.samples > 0 and abs(further_m) < tolerance


@jit
def _add_pending(adaptive, innovation_m, travel_m):
    """Add an outlier to the sums and the ring of the pending samples."""
    pending, estimate = adaptive.pending, adaptive.estimate
    height_m, slot = estimate.height_m + innovation_m, pending.samples & (PENDING_HEIGHTS - 1)
    pending.kept_arc_length_m[slot], pending.kept_height_m[slot] = estimate.arc_length_m, height_m
    pending.samples += 1
    pending.travel_m += travel_m
    pending.innovation_m += innovation_m
    pending.arc_length_m += estimate.arc_length_m
    pending.height_m += height_m


@jit
def reject_pending(pending):
    """Drop the pending samples, and count them as outliers: the next sample does not agree with them."""
    if pending.samples == 0:
        return
    pending.rejected += 1
    innovation_m = pending.innovation_m / pending.samples
    pending.least_m = min(pending.least_m, innovation_m)
    pending.greatest_m = max(pending.greatest_m, innovation_m)
    pending.samples = 0


@jit
def _needed(params, adaptive, rises_on):
    """Number of pending samples that confirm a step."""
    pending, tau_s, interval_s = adaptive.pending, adaptive.plant.tau_s, adaptive.hold.interval_s
    needed = params.step_samples
    late = is_long(needed * interval_s, tau_s)
    if late or adaptive.gate.slot_likelihood < 0.2:  # a third one comes late, or steps have stayed
        needed = min(needed, 2)
    # in a burst of wrong readings some agree by chance; they delay a step by no more than τ/4
    return needed + min(pending.rejected, int(0.25 * tau_s / max(interval_s, 1e-6))) - rises_on


@jit
def confirm_by(params, adaptive, innovation_m, travel_m, rises_on):
    """Hold an outlier as pending; whether the pending samples are a step with it.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`pending` updated)
    innovation_m : float64  innovation ν of the sample [m], outside the gate
    travel_m : float64      distance travelled since the sample before [m]
    rises_on : bool         this sample is nearer, as the one before was, and ground can rise so: one sample
                            less is needed

    Notes
    -----
    With the likelihood of slots ρ, the sensor's interval T, the axis' time constant τ and n = `step_samples`:

        need = (2 if ρ < 0.2 or n T > τ/2, else n) + min(outliers that agreed with none, τ / (4 T)) − rises_on
        is_step = ν > 0, or travel ≥ ρ · `step_travel`, or time ≥ 100 ms, or pending > accepted samples

    A step is confirmed when pending ≥ need and is_step. One outlier that disagrees with n others is left out.
    """
    pending, estimate = adaptive.pending, adaptive.estimate
    agrees = _agrees(params, adaptive, innovation_m, travel_m)
    if not agrees and pending.samples >= params.step_samples and pending.odd == 0:
        pending.odd = 1  # a glitch among many that agree
        pending.travel_m += travel_m
        return False
    pending.odd = 0
    if not agrees:  # with none before it: the pending samples begin with it
        opposed = pending.samples > 0 and innovation_m * pending.innovation_m < 0.0
        pending.opposed += 1 if opposed else 0
        reject_pending(pending)
        pending.t_ns = estimate.sample_ns
        pending.travel_m = pending.innovation_m = pending.arc_length_m = pending.height_m = 0.0
        travel_m = 0.0
    _add_pending(adaptive, innovation_m, travel_m)
    # a step away from the tool may be a slot; with a bad start, and at rest, there is no travel, but a hollow
    # that lasts so long is no slot
    travelled = pending.travel_m >= params.step_travel_m * adaptive.gate.slot_likelihood
    stood = estimate.sample_ns - pending.t_ns >= PAUSE_NS
    is_step = innovation_m > 0.0 or travelled or stood or pending.samples > estimate.samples
    return pending.samples >= _needed(params, adaptive, rises_on) and is_step


@jit
def nearer_wait(adaptive):
    """Whether several samples in a row wait, one of a slow sensor, and lie nearer than the estimate.

    It may be wrong then.
    """
    pending = adaptive.pending
    nearer = pending.samples > 0 and pending.innovation_m > 0.0
    return nearer and (is_slow(adaptive) or pending.samples + pending.rejected >= CONFIRMATION_SAMPLES)


@jit
def pending_slope(pending, least_m):
    """Slope between the first and the newest pending sample; 0 where they differ by less than `least_m`."""
    newest = pending.samples - 1
    if not 0 < newest < PENDING_HEIGHTS:
        return 0.0
    rise_m = pending.kept_height_m[newest] - pending.kept_height_m[0]
    travel_m = pending.kept_arc_length_m[newest] - pending.kept_arc_length_m[0]
    if abs(rise_m) <= least_m or travel_m <= 0.0:
        return 0.0
    return min(max(rise_m / travel_m, -MAX_SLOPE), MAX_SLOPE)


@jit
def drop_pending(pending, accepted=1):
    """Drop the pending samples, and a rejected one per accepted one; in noise some are accepted by chance."""
    pending.samples, pending.rejected = 0, max(pending.rejected - accepted, 0)
    pending.opposed = min(pending.opposed, pending.rejected)
    if pending.rejected == 0:
        pending.least_m = pending.greatest_m = 0.0
