"""The tool's height between and behind pose reports, by the observed axis.

It is the axis model with the τ in force, which `plant_identification` corrects by each report.
"""

from surffollow.forecast.estimation.noise import range_noise_m
from surffollow.forecast.plant import axis_model, own_setpoints
from surffollow.forecast.pose import newest_pose, pose_at
from surffollow.forecast.quantities import MAX_GAP_NS
from surffollow.forecast.sensing import kinematics
from surffollow.shm.jit import jit, jit_inlined


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

    Its velocity stays. The height goes where the observed axis leads it, if that has been nearer to the
    reports so far. A slow controller moves the tool by steps, which have no constant velocity.

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
