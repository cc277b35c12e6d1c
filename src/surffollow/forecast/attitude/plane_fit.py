"""Plane fit under several beams: slopes with their rates, and the mean curvature.

Three accepted beams or more update both slopes, two the slope along their line. Then, and under a single
beam, the track that the reference beam draws on the ground updates the slope along it.
"""

from surffollow.forecast import elementary
from surffollow.forecast.attitude import beam_detection, plane_regression
from surffollow.forecast.pose import to_world
from surffollow.forecast.quantities import APART_M, MAX_GAP_NS, MAX_SLOPE, tolerated_gap_s
from surffollow.shm.jit import jit


@jit
def plane_height(params, adaptive, t_ns, pose):
    """Height under the tool from all accepted beams, and their number; 0 when there are none.

    The height is that of the plane that touches the ground where the tool's axis meets it. A beam of three
    that is found blocked has tilted the plane: it begins anew, perpendicular to the tool.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (updated)
    t_ns : int64         timestamp of the sample
    pose : (7,) float64  pose of the tool at that time

    Returns
    -------
    int64, float64 [m]
    """
    plane, x_m, y_m, before = adaptive.plane, pose[0], pose[1], adaptive.beams.blocked
    dt = propagate_slopes(adaptive, t_ns)
    accepted = beam_detection.isolate_faults(params, adaptive, t_ns, x_m, y_m)
    if accepted == 0:
        return 0, 0.0
    if adaptive.beams.blocked > before and params.n_channels == 3:
        begin_at_tool(plane, pose)
    fit = update_plane(params, adaptive, dt)
    follow_track(adaptive, dt)
    if plane.first_ns == 0 or t_ns < plane.first_ns:
        plane.first_ns = t_ns
    if plane.count == 0 and t_ns - plane.first_ns < MAX_GAP_NS:
        return 0, 0.0  # the height by one beam on a slope is wrong: wait for the others
    return accepted, fit.h_m - plane.slope_x * (fit.x_m - x_m) - plane.slope_y * (fit.y_m - y_m)


@jit
def begin_at_tool(plane, pose):
    """Take ground perpendicular to the tool in place of slopes of a wrong beam."""
    axis = to_world(pose, 0, 0.0, 0.0, 1.0)
    if axis[2] > 0.0:
        plane.slope_x, plane.slope_y = -axis[0] / axis[2], -axis[1] / axis[2]
        shift_slopes(plane, 0.0, 0.0)  # within their limits


@jit
def reset_plane(plane):
    """Discard the plane: it is level."""
    plane.first_ns = plane.count = 0
    plane.slope_x = plane.slope_y = plane.slope_rate_x_hz = plane.slope_rate_y_hz = plane.curvature = 0.0


@jit
def slope_gain(dt):
    """Gain of slopes with a bandwidth of 11 rad/s, critically damped, after a time [s]."""
    return min(2.0 * 11.0 * dt, 0.5)


@jit
def propagate_slopes(adaptive, t_ns):
    """Propagate the slopes to a sample by their rates; time since the last one [s], 0 after a longer gap."""
    plane = adaptive.plane
    dt = (t_ns - plane.t_ns) * 1e-9
    plane.t_ns = t_ns
    if not 0.0 < dt <= tolerated_gap_s(adaptive.hold.interval_s):
        plane.slope_rate_x_hz = plane.slope_rate_y_hz = dt = 0.0
    shift_slopes(plane, plane.slope_rate_x_hz * dt, plane.slope_rate_y_hz * dt)
    return dt


@jit
def shift_slopes(plane, dx, dy):
    """Add to the slopes, within their limits."""
    plane.slope_x = min(max(plane.slope_x + dx, -MAX_SLOPE), MAX_SLOPE)
    plane.slope_y = min(max(plane.slope_y + dy, -MAX_SLOPE), MAX_SLOPE)


@jit
def update_plane(params, adaptive, dt):
    """Update slopes, rates and curvature with the accepted beams; returns the regression on these.

    The n-th plane has a gain of 1/n at least. Slopes that are not observed are kept, without a rate.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (`plane` updated)
    dt : float64  time since the plane before [s]

    Returns
    -------
    PlaneFit
    """
    beams, plane = adaptive.beams, adaptive.plane
    fit = plane_regression.fit_plane(adaptive, beams.weight, params.n_channels)
    plane.rank = fit.rank if beams.inconsistent == 0 else 0
    share = slope_gain(dt)
    if plane.rank == 2:
        plane.fitted_x, plane.fitted_y = plane.slope_x + fit.error_x, plane.slope_y + fit.error_y
        plane.spread_m2 = fit.spread_m2
        error = plane_regression.curvature_error(adaptive, params.n_channels, fit)
        plane.curvature += min(2.5 * dt, 0.5) * error  # a mean over 0.4 s
        rate_gain_hz = 0.25 * share * share / dt if dt > 0.0 else 0.0
        plane.slope_rate_x_hz += rate_gain_hz * fit.error_x
        plane.slope_rate_y_hz += rate_gain_hz * fit.error_y
    else:
        plane.slope_rate_x_hz = plane.slope_rate_y_hz = 0.0
    if plane.rank > 0:
        share = max(share, 1.0 / (plane.count + 1))
        shift_slopes(plane, share * fit.error_x, share * fit.error_y)
    plane.count += 1 if plane.rank == 2 else 0
    return fit


@jit
def follow_track(adaptive, dt):
    """Follow the track of the reference beam; its slope counts where the beams give no plane.

    The slope is that from the mean of the beam's footprints, of which older ones fade with the distance
    travelled, to the newest one.
    """
    beams, plane, c = adaptive.beams, adaptive.plane, adaptive.beams.reference
    track = plane.track_m
    if beams.accepted[c] == 0:
        return
    begins = plane.track_beam != c or dt == 0.0
    plane.track_beam = c
    # a memory of 15 mm
    share = 1.0 if begins else 1.0 - elementary.exp(-adaptive.kinematics.speed_mps * dt / 0.015)
    for i in range(3):
        track[i] += share * (beams.footprint_m[3 * c + i] - track[i])
    dx, dy = beams.footprint_m[3 * c] - track[0], beams.footprint_m[3 * c + 1] - track[1]
    squared = dx * dx + dy * dy
    if plane.rank < 2 and beams.inconsistent == 0 and squared > APART_M * APART_M:
        rise = beams.footprint_m[3 * c + 2] - track[2]
        factor = share * (rise - plane.slope_x * dx - plane.slope_y * dy) / squared
        shift_slopes(plane, factor * dx, factor * dy)
