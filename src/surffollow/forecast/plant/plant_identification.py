"""Plant identification: the time constant of the controlled axis.

Axis models with different time constants follow the follower's own setpoints. The squared errors against
the reported positions have their minimum near the true one; a parabola interpolates it. Without motion the
errors are equal, and the configured time constant stays.

Wind, current or a load move the tool beside its axis. Their velocity is observed, and is part of all models:
a tool that is pushed looks like one with a sluggish axis. While the reports lie on one side of the observed
axis it is not known yet, and τ is not learned.
"""

import math

from surffollow.forecast import elementary
from surffollow.forecast.estimation.noise import MIN_NOISE_M
from surffollow.forecast.modes import learns
from surffollow.forecast.plant import axis_model, controller_clock, own_setpoints
from surffollow.forecast.plant.observed_axis import follow_setpoints, predict_axis
from surffollow.forecast.pose import newest_pose
from surffollow.forecast.quantities import LONG_GAP_NS, QUICK_RATE, SLOW_RATE, follow_usual
from surffollow.forecast.terrain.preview import suspend_preview
from surffollow.forecast.terrain.terrain_buffer import sensor_leads
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import N_PLANTS

TAU_RATIO = 1.5  # between neighbouring τ
FOLLOWS_M = 3e-3  # from each axis model: farther away the robot does not follow
# gains of the observed axis per report: position, velocity [1/s], disturbance [1/s]. The last is learned over
# 3 to 4 s, some 100 τ: what is quicker may be the axis itself, which the models describe roughly
AXIS_GAINS = (0.3, 2.0, 0.1)


@jit
def time_constant_s(plant, k):
    """Time constant of an axis model [s]; the configured one is in the middle."""
    return plant.tau_configured_s * TAU_RATIO ** (k - N_PLANTS // 2)


@jit
def reset_axes(adaptive, t_ns, z_m):
    """Put all axis models where the tool is.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (`plant` updated)
    t_ns : int64   timestamp of the pose report
    z_m : float64  reported height of the tool [m]
    """
    plant = adaptive.plant
    climb_mps = adaptive.kinematics.climb_mps - plant.disturbance_mps
    plant.position_m[:], plant.velocity_mps[:] = z_m, climb_mps
    plant.axis_m, plant.axis_mps = z_m, climb_mps
    plant.t_ns = t_ns
    plant.offset_m = plant.scatter_m = 0.0


@jit
def propagate_axes(params, adaptive, to_ns):
    """Propagate all axis models with the setpoints that the controller latched.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`plant` updated)
    to_ns : int64  the later time

    Returns
    -------
    float64, float64  position and velocity of the observed axis, did the controller latch the other setpoints
        [m, m/s]
    """
    plant, z, v = adaptive.plant, adaptive.plant.position_m, adaptive.plant.velocity_mps
    others = own_setpoints.other_setpoints(adaptive.own)
    other = follow_setpoints(params, plant, others, plant.tau_s, plant.axis_m, plant.axis_mps, to_ns)
    setpoints = own_setpoints.latched_setpoints(adaptive.own)
    for k in range(N_PLANTS):
        z[k], v[k] = follow_setpoints(params, plant, setpoints, time_constant_s(plant, k), z[k], v[k], to_ns)
    plant.axis_m, plant.axis_mps = predict_axis(params, adaptive, to_ns)
    plant.t_ns = to_ns
    return other


@jit
def best_time_constant(plant):
    """τ of the least error by a parabola through three [s]; 0 when the errors do not differ."""
    best = plant.error_m2.argmin()
    if plant.error_m2.max() - plant.error_m2[best] < MIN_NOISE_M**2:
        return 0.0
    # a parabola over √τ through three points: over τ its minimum is too high, over log τ too low
    b = min(max(best, 1), N_PLANTS - 2)
    middle = math.sqrt(time_constant_s(plant, b))
    left, right = middle / math.sqrt(TAU_RATIO), middle * math.sqrt(TAU_RATIO)
    slope_below = (plant.error_m2[b] - plant.error_m2[b - 1]) / (middle - left)
    slope_above = (plant.error_m2[b + 1] - plant.error_m2[b]) / (right - middle)
    curvature = (slope_above - slope_below) / (right - left)
    if curvature <= 0.0:
        return middle * middle
    root = min(max(0.5 * (left + middle - slope_below / curvature), left), right)
    return root * root


@jit
def is_pushed(plant):
    """Whether the reports lie on one side of the observed axis: a push is not known yet."""
    return abs(plant.mean_m) > 0.5 * plant.spread_m


@jit
def update_plant(params, adaptive, sense, inputs):
    """Compare the axis models with a new pose report; move τ toward the best one while demands are applied.

    Parameters
    ----------
    params, adaptive, sense, inputs : records of `Params`, `AdaptiveState` (updated), `SenseState`, `Inputs`
    """
    plant, newest = adaptive.plant, newest_pose(sense)
    t, z = sense.pose_t_ns[newest], sense.pose[7 * newest + 2]
    if axes_begin(params, adaptive, t):
        plant.disturbance_mps = 0.0
        reset_axes(adaptive, t, z)
        return
    if inputs.n_ranges <= 0:  # otherwise the caller latches each answer himself
        own_setpoints.record_report(adaptive.own, adaptive.clock.now_ns - controller_clock.LATCH_DELAY_NS)
    slow = axis_model.is_long((t - plant.t_ns) * 1e-9, plant.tau_configured_s)
    other_m, other_mps = propagate_axes(params, adaptive, t)
    choose_setpoints(adaptive, inputs, z, other_m, other_mps)
    least_m = math.inf
    for k in range(N_PLANTS):
        least_m = min(least_m, abs(plant.position_m[k] - z))
    suspend_plan(adaptive, t, least_m)
    if not least_m < FOLLOWS_M:  # the robot does not follow: the axes begin at the tool
        reset_axes(adaptive, t, z)
        return
    correct_axis(params, adaptive, t, z)
    # between slow reports poses with old timestamps, too, are a sluggish axis: a longer τ is right
    push_known = slow or not is_pushed(plant)
    if learns(params, adaptive) and push_known and least_m < axis_model.MAX_MODEL_ERROR_M:
        learn_time_constant(plant, z)


@jit
def axes_begin(params, adaptive, t_ns):
    """Whether the axis models begin at the tool: they have not led it since the report before.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`plant` updated)
    t_ns : int64  timestamp of the pose report
    """
    plant, setpoint = adaptive.plant, adaptive.setpoint
    if setpoint.t_ns == 0:
        least = plant.error_m2.min()
        for k in range(N_PLANTS):  # what all have in common: another controller has moved the robot since
            plant.error_m2[k] -= least
    applied = adaptive.controller.periods > 0 and setpoint.t_ns != 0 and setpoint.in_dryrun == 0
    continues = plant.t_ns < t_ns <= plant.t_ns + LONG_GAP_NS
    begins = plant.tau_configured_s == 0.0 or plant.begins != 0  # at a start, or behind an SFReset
    plant.begins = 0
    if begins and plant.tau_configured_s != params.plant_tau_s:
        plant.tau_s = plant.tau_configured_s = params.plant_tau_s
        plant.error_m2[:] = 0.0
    return not applied or not continues


@jit
def choose_setpoints(adaptive, inputs, z_m, other_m, other_mps):
    """Find out which setpoints the controller latches; the axes begin anew where they are the others.

    Parameters
    ----------
    adaptive, inputs : records of `AdaptiveState` (updated), `Inputs`
    z_m : float64                  reported height of the tool [m]
    other_m, other_mps : float64   axis from `propagate_axes`
    """
    plant, declared_ns = adaptive.plant, adaptive.controller.declared_ns
    if inputs.n_ranges > 0 and adaptive.clock.now_ns - declared_ns < LONG_GAP_NS:  # the caller says it
        own_setpoints.take_reports(adaptive.own)
        return
    error_m, other_error_m = z_m - plant.offset_m - plant.axis_m, z_m - plant.offset_m - other_m
    if own_setpoints.compare_series(adaptive.own, abs(error_m), abs(other_error_m)):
        plant.axis_m, plant.axis_mps = other_m, other_mps
        plant.position_m[:], plant.velocity_mps[:] = other_m, other_mps
        plant.tau_s, plant.error_m2[:], plant.disturbance_mps = plant.tau_configured_s, 0.0, 0.0


@jit
def suspend_plan(adaptive, t_ns, least_m):
    """Suspend plans while no axis model is near the reports.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (`preview` updated)
    t_ns : int64       timestamp of the pose report
    least_m : float64  least distance of an axis model from it [m]
    """
    plant, leads = adaptive.plant, sensor_leads(adaptive)
    # what neither the axis nor a constant velocity explains is noise of the reports, of which five are no
    # chance. With half of the least limit waves at the limits of an axis as configured end the plans, with
    # 1.5 times other axes swing
    noise_m = min(plant.scatter_m, adaptive.kinematics.climb_scatter_m)
    limit_m = min(max(2.0 * axis_model.MAX_MODEL_ERROR_M, 5.0 * noise_m), FOLLOWS_M)
    # without a plan a lone leading sensor loses more, and under a push that is not known yet most
    if not least_m < (FOLLOWS_M if leads else limit_m) and not (leads and is_pushed(plant)):
        suspend_preview(adaptive.preview, t_ns + 500_000_000)


@jit
def correct_axis(params, adaptive, t_ns, z_m):
    """Correct the observed axis and the disturbance by a pose report.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`plant` updated)
    t_ns : int64   timestamp of the pose report
    z_m : float64  reported height of the tool [m]
    """
    plant, limit = adaptive.plant, params.plant_v_max_mps
    e = z_m - plant.axis_m
    plant.scatter_m = follow_usual(plant.scatter_m, abs(e - plant.offset_m))
    plant.axis_m += AXIS_GAINS[0] * e
    plant.axis_mps = min(max(plant.axis_mps + AXIS_GAINS[1] * e, -limit), limit)
    # a tool that stays where its axis would move at full speed does not obey: no wind explains that
    target_m = own_setpoints.setpoint_in_force(own_setpoints.latched_setpoints(adaptive.own), t_ns)
    wish = axis_model.axis_velocity(target_m - z_m, plant.tau_s, params.plant_a_max_mps2)
    if abs(wish) < limit:
        plant.disturbance_mps = min(max(plant.disturbance_mps + AXIS_GAINS[2] * e, -limit), limit)
    plant.offset_m = z_m - plant.axis_m
    plant.mean_m += SLOW_RATE * (e - plant.mean_m)
    plant.spread_m += SLOW_RATE * (abs(e) - plant.spread_m)


@jit
def learn_time_constant(plant, z_m):
    """Update the errors of the axis models by a reported height [m]; move τ toward the best one."""
    for k in range(N_PLANTS):
        e = plant.position_m[k] - z_m
        plant.error_m2[k] += SLOW_RATE * (e * e - plant.error_m2[k])
    tau = best_time_constant(plant)
    if tau > 0.0:
        plant.tau_s *= elementary.exp(QUICK_RATE * elementary.log(tau / plant.tau_s))
