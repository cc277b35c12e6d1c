"""Resets of the whole follower: the records that each of them clears, also those of other owners."""

from surffollow.forecast.attitude.rotation_response import reset_rotation
from surffollow.forecast.estimation.noise import INITIAL_NOISE_M
from surffollow.forecast.sensing.constant_ranges import forget_slopes
from surffollow.forecast.sensing.response import restart_test
from surffollow.forecast.setpoint.setpoint_limits import release_setpoint
from surffollow.forecast.terrain.preview import withdraw_preview
from surffollow.shm import atomics as at
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import DROPOUT, REASON_NO_READING
from surffollow.shm.layout_adaptive_sensing import FRAME_UNKNOWN
from surffollow.shm.layout_follow import FollowState

# where the records are in `FollowState` that resets clear, and their number of words
ADAPTIVE, PAPER, SCALED = (
    (FollowState.offset(name), FollowState.field(name).size // 8) for name in ("adaptive", "paper", "scaled")
)


@jit
def clear_record(state, place):
    """Set a record of (1,) `FollowState` to zero."""
    first, words = place
    for k in range(words):
        at.store_relaxed_i64(state.ctypes.data + first + 8 * k, 0)


@jit
def reset_follower(state, fault):
    """Reset all records of the default follower to zero, but latched faults.

    Parameters
    ----------
    state : (1,) record of `FollowState`
    fault : int64  latched besides; 0: none
    """
    health = state[0].adaptive.health
    faults = health.faults | fault
    clear_record(state, ADAPTIVE)
    health.faults, health.state, health.reason = faults, DROPOUT, REASON_NO_READING


@jit
def reset_learned(adaptive):
    """Reset what was learned of noise and ground: the performance index prefers no model.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (updated)
    """
    weights, lead, gate, estimate = adaptive.weights, adaptive.lead, adaptive.gate, adaptive.estimate
    weights.recent_m2[:] = weights.longer_m2[:] = 1e-6  # (1 mm)²
    lead.excess_m2[:] = lead.effect_m2[:] = lead.left_out[:] = adaptive.shadow.effort[:] = 0.0
    weights.scored = 0
    adaptive.noise.sigma_m = adaptive.noise.range_sigma_m = INITIAL_NOISE_M
    gate.scale_m, gate.slot_likelihood = 2.0 * INITIAL_NOISE_M, 1.0
    estimate.slope_power = estimate.quick_slope_power = estimate.kept_slope_power = 0.0


@jit
def reset_surface(state):
    """SFReset: begin both modes with the next sample.

    Measurements, the fold-back latch, noise, model weights, plant and terrain stay.

    Parameters
    ----------
    state : (1,) record of `FollowState` (updated)
    """
    clear_record(state, PAPER)
    adaptive = state[0].adaptive
    # the estimate and the loss time-out begin with the next sample
    adaptive.estimate.samples = adaptive.estimate.confirmed_ns = 0
    # the tests of the sensor begin anew with the next sample; the usual number of repeated ranges stays
    restart_test(adaptive.response)
    forget_slopes(adaptive.run)
    adaptive.repeats.count = adaptive.repeats.unused = adaptive.descent.unexplained = 0
    adaptive.frame.phase, adaptive.frame.begun_ns = FRAME_UNKNOWN, 0
    reset_rotation(adaptive.rotation)
    release_setpoint(adaptive.setpoint)
    withdraw_preview(adaptive.preview)
    adaptive.plant.begins = 1
    adaptive.health.faults = 0
