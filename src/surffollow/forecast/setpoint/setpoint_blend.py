"""Blend the models' setpoints by weight, filter the blend with a deadband, and limit its descent."""

import math

from surffollow.forecast import elementary, quantities
from surffollow.forecast.estimation import innovation_gate, model_bank, model_weights
from surffollow.forecast.estimation.pending_samples import nearer_wait
from surffollow.forecast.plant import axis_model, controller_clock
from surffollow.forecast.plant.shadow_axes import MAX_LAG_S
from surffollow.forecast.sensing import measurement
from surffollow.forecast.sensing.health import missing_s, rise_rate
from surffollow.forecast.sensing.kinematics import GROUND_SPEED_MPS, is_at_rest, path_speed, spans_jump
from surffollow.forecast.sensing.sample_hold import is_slow
from surffollow.forecast.setpoint.tested_setpoint import setpoint_range
from surffollow.forecast.terrain.known_ground import MAX_UNCONFIRMED_DESCENT_M
from surffollow.forecast.terrain.terrain_buffer import sensor_leads
from surffollow.shm.jit import jit, jit_inlined
from surffollow.shm.layout_adaptive_estimation import N_MODELS, WAVES


@jit
def slope_limit(power):
    """Greatest slope that is plausible beside a mean squared one."""
    return max(quantities.PLAUSIBLE_SLOPE, 3.0 * math.sqrt(power))


@jit
def compute_setpoints(adaptive, ahead_m, lead_length_m, max_slope, standoff_m):
    """Setpoints of all models `ahead_m` beyond the newest footprint; their blend and its slope.

    A model adds its slope times `lead_length_m`, less the part that it leaves out. The change of height is
    clamped to `max_slope` of the distance, plus 1 mm. Ground that is not seen may rise again where it fell:
    over the trail of a sensor, and over a share of the travel since the newest sample of a slow one, slopes
    and curves that fall count as level. Waves rise by themselves, but one that is steeper than the ground
    fits a long fall by chance. The ground's slope is that of one model, independent of its weight: waves that
    count as level get none. This is not known of a slow sensor.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (`bank`, `blend` updated)
    ahead_m : float64        distance beyond the newest footprint [m], negative behind it
    lead_length_m : float64  v τ: distance travelled in the axis' time constant, less in a drop-out [m];
                             negative: the tool goes back
    max_slope : float64      limit of the mean slope
    standoff_m : float64     desired height of the tool above the ground [m]

    Returns
    -------
    float64 [m], float64
    """
    bank, blend, sign = adaptive.bank, adaptive.blend, math.copysign(1.0, ahead_m)
    model_bank.extrapolate_bank(bank, ahead_m)
    margin = 1e-3 + max_slope * (abs(ahead_m) + abs(lead_length_m))
    unseen_m = min(max(-adaptive.sample.lead_m, 0.0), ahead_m)
    steepest = slope_limit(adaptive.estimate.quick_slope_power)
    if is_slow(adaptive):
        # with 0 valleys cost 17 instead of 3 mm of clearance (bench_hazards.py, "valley and slow"), with 1 a
        # winch's error is 15 % greater (bench_scales.py)
        unseen_m, steepest = max(unseen_m, quantities.LEVEL_SHARE * ahead_m), math.inf
    # a tool that goes back comes to ground that was seen
    level_share = unseen_m / (ahead_m + lead_length_m) if ahead_m > 0.0 and lead_length_m >= 0.0 else 0.0
    slope, curvature, omega = bank.slope, bank.curvature, bank.wave_number
    for i in range(N_MODELS):
        rise, left_out = bank.rise_m[i], adaptive.lead.left_out[i]
        change = rise + lead_length_m * bank.slope_ahead[i]
        growth = bank.slope_ahead[i] + (1.0 - left_out) * lead_length_m * bank.bend_ahead[i]
        growth = sign * math.copysign(max_slope, change) if abs(change) > margin else growth
        change, rise = min(max(change, -margin), margin), min(max(rise, -margin), margin)
        # the greatest slope of a wave is √(θ² + κ²/ω²)
        rises = i >= WAVES and curvature[i] ** 2 <= (steepest**2 - slope[i] ** 2) * omega[i] ** 2
        kept = 1.0 if rises else 1.0 - level_share  # of what falls
        growth *= kept if change < 0.0 else 1.0
        change *= kept if change < 0.0 else 1.0
        rise *= kept if rise < 0.0 else 1.0
        h = bank.height_m[i] + standoff_m
        blend.model_m[i] = h + change - left_out * (change - rise)
        blend.model_slope[i] = growth
        blend.axis_m[i] = h + change
        if i < WAVES:
            blend.axis_m[N_MODELS + i] = h + rise
    # behind the loop above, which vectorises
    return model_weights.blended(adaptive, blend.model_m), model_weights.blended(adaptive, blend.model_slope)


@jit_inlined
def blend_setpoints(params, adaptive, ahead_m, standoff_m, renew):
    """Blend the models' setpoints, or continue the blend at the rate that the models predict.

    The axis lags by τ. Its setpoint is the height plus τ times the rate of the height. In a drop-out slopes
    fade over `dropout_travel_m`, a step away from the tool that was confirmed just before is taken back, and
    the setpoint descends no farther than that of the last sample less a margin. The ground is level over the
    part of a sensor's trail that the tool does not travel in MAX_LAG_S.
    While the tool goes back since the newest sample, ground ahead of it lies behind the footprint.
    Of a sensor that leads the setpoints of the models are for its footprint, the blend is for the tool.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (updated)
    ahead_m : float64     from the newest footprint to the point under the tool when the demand acts [m]
    standoff_m : float64  desired height of the tool above the ground [m]
    renew : bool          a sample, a pose or a controller period is new: the models are blended

    Returns
    -------
    float64 [m]
    """
    clock, kinematics, gate = adaptive.clock, adaptive.kinematics, adaptive.gate
    estimate, blend = adaptive.estimate, adaptive.blend
    if not renew:
        return blend.setpoint_m + blend.rate_mps * (clock.now_ns - blend.t_ns) * 1e-9
    dropout = missing_s(adaptive, estimate.accepted_ns, quantities.MISSING_NS)
    turned = measurement.has_turned_back(adaptive)
    speed_mps, footprint_m = path_speed(kinematics), 0.0
    if is_at_rest(kinematics):
        since_s = (clock.now_ns - estimate.sample_ns) * 1e-9
        ahead_m = speed_mps * (since_s + controller_clock.mean_wait_s(params, adaptive.controller))
    elif not turned:
        footprint_m = ahead_m + adaptive.sample.lead_m if sensor_leads(adaptive) else 0.0
        # no model is extrapolated where no shadow axis shows how well that would do
        uncompared_m = max(-adaptive.sample.lead_m - speed_mps * MAX_LAG_S, 0.0)
        ahead_m = max(ahead_m - uncompared_m, 0.0)
    lead_length_m = speed_mps * adaptive.plant.tau_s
    if dropout > 0.0:
        dropout_m = min(speed_mps * dropout, max(ahead_m, 0.0))
        decay = elementary.exp(-dropout_m / params.dropout_travel_m)
        ahead_m += params.dropout_travel_m * (1.0 - decay) - dropout_m
        footprint_m -= speed_mps * dropout
        lead_length_m *= decay
    if turned:  # along the way of the newest sample
        ahead_m, lead_length_m, speed_mps = -ahead_m, -lead_length_m, -speed_mps
    # a change of height is clamped to the plausible slope, or to three RMS slopes of the last metre; where
    # the tool creeps, to the rate at which ground may move. Steeper ground the axis does not follow
    creeps = 1.0 if is_slow(adaptive) else max(GROUND_SPEED_MPS / abs(speed_mps), 1.0)
    max_slope = max(creeps * quantities.PLAUSIBLE_SLOPE, slope_limit(estimate.slope_power))
    max_slope = min(max_slope, params.plant_v_max_mps / abs(speed_mps))
    z, slope = compute_setpoints(adaptive, ahead_m, lead_length_m, max_slope, standoff_m)
    if footprint_m > ahead_m:  # the shadow axes of a sensor that leads are compared there
        compute_setpoints(adaptive, footprint_m, lead_length_m, max_slope, standoff_m)
    # a fall that samples have followed for so long, or over this travel, is no slot
    recent = estimate.accepted_ns - gate.step_ns < quantities.PAUSE_NS
    if dropout > 0.0 and gate.step_m < 0.0 and recent and gate.travel_since_step_m < params.step_travel_m:
        z -= gate.step_m
    if blend.tracked_ns != estimate.accepted_ns:
        blend.tracked_m, blend.tracked_ns = z, estimate.accepted_ns
    if dropout > 0.0 and estimate.samples > 1:
        z = max(z, blend.tracked_m - MAX_UNCONFIRMED_DESCENT_M)
    blend.setpoint_m, blend.rate_mps, blend.t_ns = z, slope * speed_mps, clock.now_ns
    return z


@jit
def permitted_variance_m(params, adaptive):
    """Permitted_Variance in force [m]: the change that is not relayed.

    Where the standard deviation of the height is larger, it takes its place, 2 mm at most.
    """
    return max(params.permitted_variance_m, min(adaptive.estimate.sigma_m, 2e-3))


@jit_inlined
def filter_setpoint(params, adaptive, target_m):
    """Filter the blend: it continues at the predicted rate while it is within the deadband.

    Beyond the deadband b the excess x decays by dx/dt = −x² / (2.5 b · 10 ms): one of 2.5 b is halved in
    10 ms. The result does not depend on the length of the cycle.
    """
    blend, dt = adaptive.blend, (adaptive.clock.now_ns - adaptive.setpoint.t_ns) * 1e-9
    if dt == 0.0:
        return blend.filtered_m
    if not 0.0 < dt < quantities.PAUSE_NS * 1e-9:
        blend.filtered_m = target_m
        return target_m
    blend.filtered_m += blend.rate_mps * dt
    e = target_m - blend.filtered_m
    deadband_m = params.deadband_share * permitted_variance_m(params, adaptive)
    excess = abs(e) - deadband_m
    if excess > 0.0:
        softness = 2.5 * deadband_m
        remaining = deadband_m + excess * softness / (softness + excess * dt / 0.01)
        blend.filtered_m = target_m - math.copysign(remaining, e)
    return blend.filtered_m


@jit
def braking_setpoint(params, adaptive, target_m, tool_z_m, age_s):
    """The setpoint, or one above it that brakes the descent of an axis that only lags [m].

    Such an axis does not brake by itself (`axis_model.axis_velocity`), and would pass the blend. From a third
    to two thirds of the speed from which it can stop there, the setpoint rises to one that asks for that
    speed. A tool that does not descend has the whole setpoint: another demand may be added to it.

    Parameters
    ----------
    params, adaptive, target_m, tool_z_m, age_s : as in `permitted_setpoint`
    """
    tau_s, rate_mps = adaptive.plant.tau_s, adaptive.blend.rate_mps
    # with 1 a tool that is pushed stays farther beside its stand-off, with 1.5 an axis that only lags passes
    # it by 0.18 (`test_disturbance.py`, `test_unbraked_axis.py`)
    a_max = 1.25 * params.plant_a_max_mps2
    descent_mps = rate_mps - adaptive.kinematics.climb_mps
    lag_m = tau_s * (rate_mps - adaptive.plant.disturbance_mps)
    z_m = tool_z_m - max(descent_mps, 0.0) * age_s
    above_m = z_m + lag_m - target_m
    if above_m <= a_max * tau_s * tau_s:
        return target_m
    speed_mps = axis_model.axis_velocity(above_m, tau_s, a_max)
    share = min(max(3.0 * descent_mps / speed_mps - 1.0, 0.0), 1.0)
    return target_m + share * (above_m - tau_s * speed_mps)


@jit_inlined
def permitted_setpoint(params, adaptive, target_m, tool_z_m, standoff_m, age_s, stuck):
    """Setpoint within the range that is permitted [m].

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState`
    target_m : float64    the setpoint [m]
    tool_z_m : float64    height of the tool in the newest pose reported [m]
    standoff_m : float64  desired height of the tool above the ground [m]
    age_s : float64       of that pose when the demand acts [s]
    stuck : bool          the range does not respond to the tool's motion
    """
    estimate = adaptive.estimate
    if spans_jump(adaptive.kinematics):
        return tool_z_m  # heights are in the frame before the jump
    dropout = missing_s(adaptive, estimate.accepted_ns, quantities.MISSING_NS) > 0.0
    few = estimate.samples < quantities.SETTLED_SAMPLES and dropout
    hardly_known = few or estimate.samples < quantities.CONFIRMATION_SAMPLES
    uncertain = stuck or hardly_known or nearer_wait(adaptive)
    no_descent = tool_z_m if uncertain else -math.inf
    wait_s = controller_clock.mean_wait_s(params, adaptive.controller)
    lowest, highest = setpoint_range(adaptive, wait_s)
    if stuck:  # ground that is not seen may rise as steeply as it did before
        rise_m = rise_rate(adaptive) * (adaptive.plant.tau_s + age_s)
        target_m = max(target_m, tool_z_m + rise_m)
    if adaptive.preview.share == 0.0 or adaptive.setpoint.approaching != 0:  # a plan brakes by itself
        target_m = braking_setpoint(params, adaptive, target_m, tool_z_m, age_s)
    tested = min(max(target_m, lowest), highest)
    return max(tested, no_descent, innovation_gate.withheld_setpoint(adaptive, standoff_m))
