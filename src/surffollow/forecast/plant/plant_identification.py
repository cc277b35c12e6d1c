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
from surffollow.forecast.estimation.noise import MIN_NOISE_M, range_noise_m
from surffollow.forecast.modes import learns
from surffollow.forecast.plant import axis_model, controller_clock, own_setpoints
from surffollow.forecast.pose import newest_pose, pose_at
from surffollow.forecast.quantities import LONG_GAP_NS, MAX_GAP_NS, QUICK_RATE, SLOW_RATE, follow_usual
from surffollow.forecast.sensing import kinematics
from surffollow.forecast.terrain.preview import suspend_preview
from surffollow.forecast.terrain.terrain_buffer import sensor_leads
from surffollow.shm.jit import jit, jit_inlined
from surffollow.shm.layout_adaptive import N_PLANTS
from surffollow.shm.layout_follow import RUN_NORMAL

TAU_RATIO = 1.5  # between neighbouring τ
NOISE_SIGMAS = 5.0  # of the reported heights: an error of an axis model beyond is no noise
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
def follow_setpoints(params, plant, setpoints, tau_s, z_m, v_mps, to_ns):
    """Position and velocity of an axis that has followed the own setpoints until a later time [m, m/s].

    The velocity is that of the axis alone, without the disturbance.

    Parameters
    ----------
    params, plant : records of `Params`, `Plant`
    setpoints : record of `Setpoints`  the setpoints latched
    tau_s : float64       time constant [s]
    z_m, v_mps : float64  position and velocity at `plant.t_ns`
    to_ns : int64         the later time
    """
    v_max, a_max = params.plant_v_max_mps, params.plant_a_max_mps2
    steps, span_ns = axis_model.time_steps(plant.t_ns, to_ns)
    from_ns = to_ns - span_ns
    if from_ns > plant.t_ns:  # a longer gap: the axis has settled since
        z_m, v_mps = own_setpoints.setpoint_in_force(setpoints, from_ns), 0.0
    for n in range(steps):
        target = own_setpoints.setpoint_in_force(setpoints, from_ns + (span_ns * n) // steps)
        dt_s = span_ns * 1e-9 / steps
        z_m, v_mps = axis_model.step_axis(tau_s, v_max, a_max, z_m, v_mps, target, dt_s)
        z_m += plant.disturbance_mps * dt_s
    return z_m, v_mps


@jit
def predict_axis(params, adaptive, to_ns):
    """Position and velocity of the observed axis at a later time [m, m/s]."""
    plant, setpoints = adaptive.plant, own_setpoints.latched_setpoints(adaptive.own)
    return follow_setpoints(params, plant, setpoints, plant.tau_s, plant.axis_m, plant.axis_mps, to_ns)


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
    plant, setpoint = adaptive.plant, adaptive.setpoint
    newest = newest_pose(sense)
    t, z = sense.pose_t_ns[newest], sense.pose[7 * newest + 2]
    if setpoint.t_ns == 0:
        least = plant.error_m2.min()
        for k in range(N_PLANTS):  # what all have in common: another controller has moved the robot since
            plant.error_m2[k] -= least
    applied = adaptive.controller.periods > 0 and setpoint.t_ns != 0 and setpoint.in_dryrun == 0
    continues = plant.t_ns < t <= plant.t_ns + LONG_GAP_NS
    begins = plant.tau_configured_s == 0.0 or plant.begins != 0
    other_tau = begins and plant.tau_configured_s != params.plant_tau_s
    plant.begins = 0
    if other_tau:
        plant.tau_s = plant.tau_configured_s = params.plant_tau_s
        plant.error_m2[:] = 0.0
    if not applied or not continues or other_tau:
        plant.disturbance_mps = 0.0
        reset_axes(adaptive, t, z)
        return
    if inputs.n_ranges <= 0:  # otherwise the caller latches each answer himself
        own_setpoints.record_report(adaptive.own, adaptive.clock.now_ns - controller_clock.LATCH_DELAY_NS)
    slow = axis_model.is_long((t - plant.t_ns) * 1e-9, plant.tau_configured_s)
    other_m, other_mps = propagate_axes(params, adaptive, t)
    if controller_clock.declares_latches(adaptive.controller, inputs, adaptive.clock.now_ns):
        own_setpoints.take_reports(adaptive.own)
    else:
        error_m, other_error_m = z - plant.offset_m - plant.axis_m, z - plant.offset_m - other_m
        if own_setpoints.compare_series(adaptive.own, abs(error_m), abs(other_error_m)):
            plant.axis_m, plant.axis_mps = other_m, other_mps
            plant.position_m[:], plant.velocity_mps[:] = other_m, other_mps
            plant.tau_s, plant.error_m2[:], plant.disturbance_mps = plant.tau_configured_s, 0.0, 0.0
    least = math.inf
    for k in range(N_PLANTS):
        least = min(least, abs(plant.position_m[k] - z))
    # what neither the axis nor a constant velocity explains is noise of the reports. With half of the least
    # limit waves at the limits of an axis as configured end the plans, with 1.5 times other axes swing
    noise_m = min(plant.scatter_m, adaptive.kinematics.climb_scatter_m)
    follows_m, leads = 3e-3, sensor_leads(adaptive)
    limit_m = min(max(2.0 * axis_model.MAX_MODEL_ERROR_M, NOISE_SIGMAS * noise_m), follows_m)
    # without a plan a lone leading sensor loses more, and under a push that is not known yet most
    if not least < (follows_m if leads else limit_m) and not (leads and is_pushed(plant)):
        suspend_preview(adaptive.preview, t + 500_000_000)
    if not least < follows_m:  # the robot does not follow: the axes begin at the tool
        reset_axes(adaptive, t, z)
        return
    e = z - plant.axis_m
    plant.scatter_m = follow_usual(plant.scatter_m, abs(e - plant.offset_m))
    limit = params.plant_v_max_mps
    plant.axis_m += AXIS_GAINS[0] * e
    plant.axis_mps = min(max(plant.axis_mps + AXIS_GAINS[1] * e, -limit), limit)
    # a tool that stays where its axis would move at full speed does not obey: no wind explains that
    target_m = own_setpoints.setpoint_in_force(own_setpoints.latched_setpoints(adaptive.own), t)
    wish = axis_model.axis_velocity(target_m - z, plant.tau_s, params.plant_a_max_mps2)
    if abs(wish) < limit:
        plant.disturbance_mps = min(max(plant.disturbance_mps + AXIS_GAINS[2] * e, -limit), limit)
    plant.offset_m = z - plant.axis_m
    plant.mean_m += SLOW_RATE * (e - plant.mean_m)
    plant.spread_m += SLOW_RATE * (abs(e) - plant.spread_m)
    # between slow reports poses with old timestamps, too, are a sluggish axis: a longer τ is right
    adapts = learns(params, adaptive) and params.run == RUN_NORMAL and (slow or not is_pushed(plant))
    if not adapts or not least < axis_model.MAX_MODEL_ERROR_M:
        return
    for k in range(N_PLANTS):
        e = plant.position_m[k] - z
        plant.error_m2[k] += SLOW_RATE * (e * e - plant.error_m2[k])
    tau = best_time_constant(plant)
    if tau > 0.0:
        plant.tau_s *= elementary.exp(QUICK_RATE * elementary.log(tau / plant.tau_s))


@jit
def height_is_known(adaptive, sense, t_ns):
    """Whether the height of the tool at a time is known: not behind a report when it is predicted badly.

    Under a slow controller an axis may follow neither its model nor a constant velocity. An error within the
    noise of the ranges does no harm. The interval of a controller above MAX_GAP_NS is not known: 0.
    """
    plant, interval_s = adaptive.plant, adaptive.controller.interval_ns * 1e-9
    quick = 0.0 < interval_s < axis_model.LONG_TAUS * plant.tau_s
    if quick or t_ns <= sense.pose_t_ns[newest_pose(sense)]:
        return True
    coasts_m = adaptive.kinematics.climb_scatter_m
    error_m = min(plant.scatter_m, coasts_m) if plant.scatter_m > 0.0 else coasts_m
    return error_m <= max(axis_model.MAX_MODEL_ERROR_M, range_noise_m(adaptive.noise))


@jit_inlined
def predict_pose(params, adaptive, sense, t_ns, pose):
    """Pose of the tool at a time into `pose`; behind the newest report it is extrapolated.

    It goes on at constant velocity. The height goes where the observed axis leads it, if that has been nearer
    to the reports so far. A slow controller moves the tool by steps, which have no constant velocity.

    Parameters
    ----------
    params, adaptive, sense : records of `Params`, `AdaptiveState`, `SenseState`
    t_ns : int64         time of the pose
    pose : (7,) float64  receives x y z [m], qx qy qz qw
    """
    plant, motion = adaptive.plant, adaptive.kinematics
    pose_at(sense, t_ns, pose)
    late_ns = t_ns - sense.pose_t_ns[newest_pose(sense)]
    if late_ns <= 0:
        return
    dt = min(late_ns, MAX_GAP_NS) * 1e-9
    pose[0] += motion.velocity_x_mps * dt
    pose[1] += motion.velocity_y_mps * dt
    pose[2] = kinematics.coast_height(motion, sense, sense.pose_count - 1, t_ns)
    if 0.0 < plant.scatter_m < motion.climb_scatter_m:
        pose[2] = predict_axis(params, adaptive, t_ns)[0] + plant.offset_m
