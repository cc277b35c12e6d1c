"""Resets of the whole follower, and the records that each of them clears."""

from surffollow.forecast.attitude.attitude import release_attitude
from surffollow.forecast.attitude.beam_detection import reset_beam_times
from surffollow.forecast.attitude.plane_fit import reset_plane_time
from surffollow.forecast.attitude.rotation_response import reset_rotation
from surffollow.forecast.estimation.estimate import (
    discard_estimate,
    erase_estimate,
    reset_estimate_times,
    unconfirm_estimate,
)
from surffollow.forecast.estimation.innovation_gate import discard_gate, drop_pending
from surffollow.forecast.estimation.model_weights import discard_weights
from surffollow.forecast.estimation.noise import discard_noise
from surffollow.forecast.plant.controller_clock import reset_controller
from surffollow.forecast.plant.plant_identification import reset_plant_time, reset_time_constant
from surffollow.forecast.sensing.health import clear_faults, latch_fault, reset_health_times
from surffollow.forecast.sensing.latency_identification import reset_latency
from surffollow.forecast.sensing.measurement import reset_sample
from surffollow.forecast.sensing.range_prediction import reset_prediction_time
from surffollow.forecast.sensing.response import reset_response
from surffollow.forecast.sensing.sample_hold import reset_hold
from surffollow.forecast.setpoint.preview_control import reset_plan
from surffollow.forecast.setpoint.setpoint_blend import reset_blend, reset_blend_times
from surffollow.forecast.setpoint.setpoint_limits import release_setpoint
from surffollow.forecast.terrain.known_ground import reset_known_ground
from surffollow.forecast.terrain.lookahead_sensor import reset_lookahead, reset_lookahead_times
from surffollow.forecast.terrain.preview import reset_preview, reset_preview_time, withdraw_preview
from surffollow.forecast.terrain.terrain_regression import reset_regression
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import FAULT_CLOCK, FAULT_NOT_FINITE


@jit
def reset_all(params, adaptive):
    """Begin without knowledge: the demand or the estimate is not finite."""
    latch_fault(adaptive.health, FAULT_NOT_FINITE)
    erase_estimate(adaptive.estimate)
    discard_gate(adaptive.gate)
    discard_noise(adaptive.noise)
    discard_weights(adaptive.weights)
    reset_sample(adaptive.sample)
    reset_response(adaptive.response)
    reset_rotation(adaptive.rotation)
    reset_latency(adaptive.latency)
    reset_lookahead(adaptive.lookahead)
    reset_known_ground(adaptive.known)
    reset_regression(adaptive.regression)
    reset_time_constant(params, adaptive.plant)
    reset_blend(adaptive.blend)
    reset_preview(adaptive.preview)
    reset_plan(adaptive.plan)
    release_setpoint(adaptive.setpoint)
    release_attitude(adaptive.attitude)


@jit
def reset_surface(adaptive):
    """SFReset: initialise with the next sample; noise, model weights, plant and terrain stay."""
    unconfirm_estimate(adaptive.estimate)
    reset_response(adaptive.response)
    reset_rotation(adaptive.rotation)
    drop_pending(adaptive.gate)
    release_setpoint(adaptive.setpoint)
    withdraw_preview(adaptive.preview)
    clear_faults(adaptive.health)


@jit
def reset_timestamps(adaptive):
    """Follow a clock that jumped back: discard all times, which may lie ahead for long.

    Times that are compared for equality only, or that an initialisation sets, stay.
    """
    latch_fault(adaptive.health, FAULT_CLOCK)
    reset_health_times(adaptive.health, adaptive.clock.now_ns)
    discard_estimate(adaptive.estimate)
    reset_estimate_times(adaptive.estimate)
    reset_hold(adaptive.hold)
    reset_response(adaptive.response)
    reset_rotation(adaptive.rotation)
    reset_prediction_time(adaptive.prediction)
    release_setpoint(adaptive.setpoint)
    release_attitude(adaptive.attitude)
    reset_controller(adaptive.controller)
    reset_blend_times(adaptive.blend)
    reset_plant_time(adaptive.plant)
    reset_preview_time(adaptive.preview)
    reset_lookahead_times(adaptive.lookahead)
    reset_beam_times(adaptive.beams)
    reset_plane_time(adaptive.plane)
