"""The estimate: propagate, gate, update and blend the model bank with one sample."""

import math

from surffollow.forecast import elementary
from surffollow.forecast.estimation import (
    earlier_bank,
    innovation_gate,
    model_bank,
    model_weights,
    noise,
    pending_samples,
)
from surffollow.forecast.modes import adapts
from surffollow.forecast.plant import shadow_axes
from surffollow.forecast.plant.axis_model import is_long
from surffollow.forecast.quantities import CONFIRMATION_SAMPLES
from surffollow.forecast.reset import reset_learned
from surffollow.forecast.sensing import kinematics
from surffollow.forecast.sensing.sample_hold import is_slow
from surffollow.forecast.terrain.terrain_buffer import sensor_leads, store_ground_under
from surffollow.shm.jit import jit, jit_inlined
from surffollow.shm.layout_adaptive_estimation import ACCEPTED, N_MODELS, PENDING_HEIGHTS, RESTART, STEP

MAX_TRAVEL_M = 0.5  # over ground of this length without samples the estimate is of no use


@jit_inlined
def blend_models(adaptive):
    """Blend height, slope and variance of the models at the newest sample.

    σ² = Σ w_i (P_i + (h_i − h)²)
    """
    bank, weights, estimate = adaptive.bank, adaptive.weights, adaptive.estimate
    h, spread, variance = model_weights.blended(adaptive, bank.height_m), 0.0, 0.0
    for i in range(N_MODELS):
        e = bank.height_m[i] - h
        variance += weights.weight[i] * max(bank.p00[i], 0.0)
        spread += weights.weight[i] * e * e
    estimate.height_m, estimate.slope = h, model_weights.blended(adaptive, bank.slope)
    estimate.sigma_m = math.sqrt(variance + spread)


@jit
def reset_estimate(params, adaptive, t_ns, travel_m, h_m, standoff_m, fresh):
    """Initialise with level ground at the first height.

    Performance index, weights, noise, usual innovation and likelihood of slots stay, unless it is a fresh
    start. The index fades soon: each new error counts as in a mean over the samples since (`update_index`).
    A follower that does not adapt keeps the weights as they are.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (updated)
    t_ns : int64          timestamp of the sample
    travel_m : float64    distance travelled by the footprint since the sample before [m], ≥ 0
    h_m : float64         height of the footprint [m]
    standoff_m : float64  desired height of the tool above the ground [m]
    fresh : bool          nothing is known, or it was learned from bad samples
    """
    estimate = adaptive.estimate
    model_bank.reset_bank(adaptive.bank, h_m, noise.INITIAL_NOISE_M * noise.INITIAL_NOISE_M)
    shadow_axes.reset_shadows(adaptive.shadow, t_ns, h_m + standoff_m)
    if fresh:
        reset_learned(adaptive)
    estimate.samples, estimate.kept_slope = 1, 0.0
    if fresh or adapts(params, adaptive):
        model_weights.update_weights(params, adaptive, math.inf)  # without their filter
    innovation_gate.reset_gate(adaptive.gate, adaptive.pending)
    earlier_bank.drop_bank(adaptive.earlier)
    estimate.sample_ns = estimate.accepted_ns = t_ns
    if estimate.confirmed_ns == 0:
        estimate.confirmed_ns = estimate.in_frame_ns = t_ns
    estimate.settle_ns = t_ns + 60_000_000  # the performance index waits until setpoints have acted
    estimate.arc_length_m += MAX_TRAVEL_M + min(travel_m, MAX_TRAVEL_M)  # no cell from before is near
    blend_models(adaptive)


@jit
def confirm_step(params, adaptive, stretch):
    """Shift every model to the mean of the pending samples; these enter the terrain buffer.

    `stretch` is the length on the path of the models per distance travelled.
    """
    pending, estimate = adaptive.pending, adaptive.estimate
    n = pending.samples
    s, h = pending.arc_length_m / n, pending.height_m / n
    before = estimate.height_m
    model_bank.shift_bank(adaptive.bank, h, stretch * (estimate.arc_length_m - s))
    blend_models(adaptive)
    noise.shift_heights(adaptive.noise, estimate.height_m - before)
    for k in range(max(0, n - PENDING_HEIGHTS), n - 1):
        slot = k & (PENDING_HEIGHTS - 1)
        store_ground_under(adaptive, pending.kept_arc_length_m[slot], pending.kept_height_m[slot])
    innovation_gate.register_step(params, adaptive.gate, pending, estimate.sample_ns)


@jit
def change_path(adaptive, rests):
    """Begin the path of a tool that stops or starts; slopes over distance are kept over a rest.

    The path of a tool at rest is time. Its slopes are rates at which the ground moves: 0 until it does.
    """
    estimate = adaptive.estimate
    estimate.rests = 1 if rests else 0
    earlier_bank.drop_bank(adaptive.earlier)
    if rests:
        estimate.kept_slope, estimate.kept_slope_power = estimate.slope, estimate.slope_power
        estimate.slope = estimate.slope_power = 0.0
    else:
        estimate.slope = estimate.kept_slope
        # a start on steep ground needs the wider clamp
        estimate.slope_power = max(estimate.slope_power, estimate.kept_slope_power)
    model_bank.begin_path(adaptive.bank, estimate.slope)


@jit
def turn_estimate(adaptive, cosine):
    """Turn the direction of travel by an angle of this cosine; −1: the tool goes back."""
    model_bank.turn_bank(adaptive.bank, cosine)
    model_bank.turn_bank(adaptive.earlier.bank, cosine)
    adaptive.estimate.slope *= cosine
    adaptive.estimate.kept_slope *= cosine


@jit
def discard_estimate(estimate):
    """Initialise with the next sample."""
    estimate.samples = 0


@jit_inlined
def update_estimate(params, adaptive, t_ns, travel_m, h_m, standoff_m):
    """Propagate the bank to a sample, gate it and update; whether it entered the estimate.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (updated)
    t_ns : int64             timestamp, later than that of the sample before
    travel_m : float64       distance travelled by the footprint since the sample before [m], ≥ 0
    h_m : float64            height of the footprint [m]
    standoff_m : float64     desired height of the tool above the ground [m]
    """
    gate, bank, estimate, motion = adaptive.gate, adaptive.bank, adaptive.estimate, adaptive.kinematics
    dt, since_accepted_ns = (t_ns - estimate.sample_ns) * 1e-9, t_ns - estimate.accepted_ns
    unseen = adaptive.health.unseen != 0 or since_accepted_ns > params.loss_timeout_ns
    outdated = travel_m > MAX_TRAVEL_M or unseen
    if estimate.samples == 0 or outdated or kinematics.is_other_frame(motion, t_ns):
        fresh = gate.slot_likelihood == 0.0
        reset_estimate(params, adaptive, t_ns, travel_m, h_m, standoff_m, fresh)
        return True
    adapt = adapts(params, adaptive)  # else index, weights and noise stay as they are
    # bank and index are updated at rest, too
    travel = max(travel_m, kinematics.MIN_DIRECTION_SPEED_MPS * dt)
    over_ns = t_ns - int(shadow_axes.compared_lag_s(adaptive) * 1e9)
    comparable = shadow_axes.propagate_shadows(params, adaptive, over_ns)
    estimate.sample_ns = t_ns
    estimate.arc_length_m += travel_m if sensor_leads(adaptive) else travel
    rests = kinematics.is_at_rest(motion)
    if rests != (estimate.rests != 0):
        change_path(adaptive, rests)
    # ground that moves changes at least as much as other ground does over this distance
    moved_m = max(travel, kinematics.GROUND_SPEED_MPS * dt)
    way = moved_m if rests else travel
    # what a slow sensor sees of ground that moves is too little to follow it
    stretch = 1.0 if is_slow(adaptive) else moved_m / way
    model_bank.propagate_bank(bank, way, moved_m, stretch)
    earlier_bank.take_back(params, adaptive, h_m, travel, way, moved_m, stretch)
    estimate.height_m = model_weights.blended(adaptive, bank.height_m)
    innovation = h_m - estimate.height_m
    # a fall that was expected is part of the innovation, too
    change_limit_m = (travel + max(-estimate.slope, 0.0) * way) * (since_accepted_ns * 1e-9 / dt)
    rose = gate.nearer != 0
    decision = innovation_gate.gate_sample(params, adaptive, innovation, travel, change_limit_m)
    if decision < ACCEPTED:
        return False
    if decision == RESTART:
        only_bad = adaptive.weights.scored <= estimate.samples  # what is known is of the bad samples alone
        pending_m = adaptive.pending.height_m / adaptive.pending.samples
        least_m = pending_samples.INNER_GATE * innovation_gate.gate_width(params, adaptive)
        quick = not is_long(params.step_samples * adaptive.hold.interval_s, adaptive.plant.tau_s)
        slope = 0.0 if rests or quick else pending_samples.pending_slope(adaptive.pending, least_m)
        behind_m = estimate.arc_length_m - adaptive.pending.arc_length_m / adaptive.pending.samples
        reset_estimate(params, adaptive, t_ns, 0.0, pending_m + slope * behind_m, standoff_m, only_bad)
        if slope != 0.0:  # on steep ground each sample would be a step from level ground again
            model_bank.begin_path(bank, slope)
            blend_models(adaptive)
        return True
    if decision == STEP:
        if rose and innovation > 0.0 and estimate.slope < 0.0:  # the models fall on where the ground rises
            model_bank.begin_path(bank, 0.0)
        confirm_step(params, adaptive, way / travel)
        innovation = h_m - estimate.height_m
    if adapt:
        innovation_gate.update_scale(gate, innovation)
        # setpoints are for the footprint, or for the ground ahead of it where the sensor trails
        if comparable and over_ns > estimate.settle_ns:
            model_weights.update_index(params, adaptive, way, dt, h_m + standoff_m)
        noise.update_noise(adaptive, h_m)
    earlier_bank.keep_bank(adaptive)
    r = noise.assumed_noise_m(adaptive.noise) ** 2
    if adapt:
        model_bank.adapt_waves(bank, h_m, r, way)
    model_bank.update_bank(bank, h_m, r)
    blend_models(adaptive)
    innovation_gate.note_remainder(params, adaptive, h_m - estimate.height_m)
    share = 1.0 - elementary.exp(-stretch * way / 1.0)  # a mean over a metre
    estimate.slope_power += share * (estimate.slope * estimate.slope - estimate.slope_power)
    quick = bank.slope[model_bank.QUICK]
    estimate.quick_slope_power += share * (quick * quick - estimate.quick_slope_power)
    if adaptive.weights.scored == 0:
        shadow_axes.reset_shadows(adaptive.shadow, adaptive.shadow.t_ns, estimate.height_m + standoff_m)
    estimate.samples += 1
    estimate.accepted_ns = t_ns
    if estimate.samples >= CONFIRMATION_SAMPLES:
        estimate.confirmed_ns = t_ns
        # while samples are from before the newest jump of the frame, the tool holds its height
        if t_ns >= motion.jump_ns:
            estimate.in_frame_ns = t_ns
    return True
