"""Resets of the whole follower: the records that each of them clears, also those of other owners."""

from surffollow.forecast.attitude.attitude import release_attitude
from surffollow.forecast.attitude.rotation_response import reset_rotation
from surffollow.forecast.estimation.estimate import discard_estimate
from surffollow.forecast.estimation.noise import discard_noise
from surffollow.forecast.plant.plant_identification import reset_time_constant
from surffollow.forecast.sensing.health import latch_fault
from surffollow.forecast.sensing.latency_identification import discard_correction
from surffollow.forecast.sensing.response import reset_response
from surffollow.forecast.sensing.sample_hold import reset_hold
from surffollow.forecast.setpoint.setpoint_limits import release_setpoint
from surffollow.forecast.terrain.known_ground import reset_known_ground
from surffollow.forecast.terrain.preview import withdraw_preview
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import FAULT_CLOCK, FAULT_NOT_FINITE


@jit
def reset_all(params, adaptive):
    """Begin without knowledge: the demand or the estimate is not finite."""
    estimate, gate, sample = adaptive.estimate, adaptive.gate, adaptive.sample
    blend, preview, plan = adaptive.blend, adaptive.preview, adaptive.plan
    latch_fault(adaptive.health, FAULT_NOT_FINITE)
    discard_estimate(estimate)
    estimate.height_m = estimate.slope = estimate.sigma_m = estimate.gain = 0.0
    estimate.arc_length_m = estimate.slope_power = 0.0
    gate.pending = 0
    gate.withheld_m = gate.slot_likelihood = gate.scale_m = 0.0
    discard_noise(adaptive.noise)
    adaptive.weights.weight[:] = 0.0  # new ones would be filtered from them
    sample.spacing_m = sample.lead_m = 0.0
    sample.tip_x_m = sample.tip_y_m = sample.heading_x = sample.heading_y = 0.0
    reset_response(adaptive.response)
    reset_rotation(adaptive.rotation)
    discard_correction(adaptive.latency)
    adaptive.lookahead.lead_m = 0.0
    reset_known_ground(adaptive.known)
    adaptive.known.bias_m = adaptive.known.trusted_from_m = 0.0
    reset_time_constant(params, adaptive.plant)
    blend.filtered_m = blend.setpoint_m = blend.rate_mps = 0.0
    withdraw_preview(preview)
    preview.predicted_from_m = preview.error_m2 = preview.mean_m = preview.offset_m2 = 0.0
    plan.setpoint_m = 0.0
    plan.acceleration_m[:] = 0.0
    plan.multiplier_m[:] = 0.0
    release_setpoint(adaptive.setpoint)
    release_attitude(adaptive.attitude)


@jit
def reset_surface(adaptive):
    """SFReset: initialise with the next sample; noise, model weights, plant and terrain stay."""
    discard_estimate(adaptive.estimate)
    adaptive.estimate.confirmed_ns = 0  # the loss time-out counts from the next sample
    reset_response(adaptive.response)
    reset_rotation(adaptive.rotation)
    adaptive.gate.pending = 0
    adaptive.gate.withheld_m = 0.0
    release_setpoint(adaptive.setpoint)
    withdraw_preview(adaptive.preview)
    adaptive.health.faults = 0


@jit
def reset_timestamps(adaptive):
    """Follow a clock that jumped back: discard all times, which may lie ahead for long.

    Times that are compared for equality only, or that an initialisation sets, stay.
    """
    health, now_ns = adaptive.health, adaptive.clock.now_ns
    estimate, controller = adaptive.estimate, adaptive.controller
    lookahead, beams = adaptive.lookahead, adaptive.beams
    latch_fault(health, FAULT_CLOCK)
    health.since_ns = now_ns
    for c in range(health.reading_ns.size):
        health.reading_ns[c] = min(health.reading_ns[c], now_ns)
    discard_estimate(estimate)
    estimate.sample_ns = estimate.accepted_ns = estimate.confirmed_ns = 0
    reset_hold(adaptive.hold)
    reset_response(adaptive.response)
    reset_rotation(adaptive.rotation)
    adaptive.prediction.t_ns = 0
    release_setpoint(adaptive.setpoint)
    release_attitude(adaptive.attitude)
    controller.period_ns = controller.report_ns = 0
    controller.periods = controller.latch_pending = 0  # setpoints of future periods would never be latched
    adaptive.blend.filtered_ns = adaptive.blend.t_ns = 0
    adaptive.plant.t_ns = 0
    adaptive.preview.suspended_until_ns = 0
    lookahead.seen_ns = 0
    lookahead.lead_m = 0.0
    lookahead.range_ns[:] = 0
    beams.first_ns = 0
    beams.t_ns[:] = 0
    beams.changed_ns[:] = 0
    adaptive.plane.t_ns = 0
