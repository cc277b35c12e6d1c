"""Plane fit under several beams: slopes with their rates, and the mean curvature.

Three accepted beams or more update both slopes, two the slope along their line, one the slope along the track
that it draws on the ground. Slopes that are not observed are kept.
"""

import math

from surffollow.forecast.attitude.beam_detection import (
    half_squared_distance,
    isolate_faults,
    mean_height,
    note_first_sample,
)
from surffollow.forecast.sensing.clock import MAX_GAP_NS
from surffollow.shm.jit import jit

FIRST_PLANE_NS = 100_000_000  # at the start one or two beams wait so long for a third
MIN_CONDITION = 1e-2  # least share of the spread of the footprints across their line
MIN_SPREAD_M = 5e-3  # least spread of the footprints that gives a slope
MAX_SLOPE = 3.0  # 72 degrees: steeper is no surface that a tool follows
SLOPE_BANDWIDTH_RADPS = 11.0  # of the slopes [rad/s]; damping 1.1
RATE_DECAY_S = 0.05  # time constant of a rate that is not observed
SLOPE_INNOVATION_LIMIT = 0.2  # of one sample
TRACK_TIME_CONSTANT_S = 0.1  # of the slope from a beam's track
TRACK_LENGTH_M, TRACK_SAMPLES = 0.015, 250.0  # memory of a beam's track in distance and samples …
TRACK_GAP_M = 0.05  # … which begins anew after a longer jump
CURVATURE_RATE_HZ = 2.5  # bandwidth of the curvature
CURVATURE_SPREAD_M2 = 1e-4  # least spread of half the squared distances from the axis
MAX_CURVATURE = 10.0  # 1/m
GAP_INTERVALS = 2.0  # a gap is longer than so many usual intervals beyond MAX_GAP_NS: slow rings have none


@jit
def plane_height(params, adaptive, t_ns, x_m, y_m):
    """Height under the tool from all accepted beams, and their number; 0 when there are none.

    The height is that of the plane that touches the ground where the tool's axis meets it.

    Parameters
    ----------
    params, adaptive : records of `Params`, `AdaptiveState` (updated)
    t_ns : int64        timestamp of the sample
    x_m, y_m : float64  place of the tool, world frame [m]

    Returns
    -------
    int64, float64 [m]
    """
    beams, plane = adaptive.beams, adaptive.plane
    dt = propagate_slopes(plane, t_ns, MAX_GAP_NS * 1e-9 + GAP_INTERVALS * adaptive.prediction.interval_s)
    accepted = isolate_faults(adaptive, params.n_channels, t_ns, x_m, y_m)
    if accepted == 0:
        return 0, 0.0
    if beams.accepted[beams.reference] != 0:
        update_track(adaptive, beams.reference)
    if beams.inconsistent == 0:
        fit_plane(adaptive, params.n_channels, accepted, dt)
    else:
        hold_slopes(plane)
    first_ns = note_first_sample(beams, t_ns)
    if plane.count == 0 and t_ns - first_ns < FIRST_PLANE_NS:
        return 0, 0.0  # the height by one beam on a slope is wrong: wait for the others
    return accepted, mean_height(adaptive, params.n_channels, x_m, y_m)


@jit
def propagate_slopes(plane, t_ns, gap_s):
    """Propagate the slopes to a sample by their rates; time since the last one [s], 0 after a longer gap."""
    dt = (t_ns - plane.t_ns) * 1e-9
    if plane.t_ns == 0 or not 0.0 < dt <= gap_s:
        if plane.t_ns != 0 and abs(dt) > 0.5:
            plane.count = min(plane.count, 1)  # after a long gap the next planes have a higher gain
        plane.slope_rate_x_hz = plane.slope_rate_y_hz = 0.0
        dt = 0.0
    plane.t_ns = t_ns
    plane.slope_x = min(max(plane.slope_x + plane.slope_rate_x_hz * dt, -MAX_SLOPE), MAX_SLOPE)
    plane.slope_y = min(max(plane.slope_y + plane.slope_rate_y_hz * dt, -MAX_SLOPE), MAX_SLOPE)
    return dt


@jit
def hold_slopes(plane):
    """Keep the slopes: the beams do not agree on any."""
    plane.slope_rate_x_hz = plane.slope_rate_y_hz = 0.0


@jit
def update_slopes(plane, ex, ey, dt):
    """Update slopes and rates with an innovation; the first planes have the full gain."""
    share = min(2.2 * SLOPE_BANDWIDTH_RADPS * dt, 0.5)
    plane.slope_rate_x_hz += share * share / 4.84 * ex / dt if dt > 0.0 else 0.0
    plane.slope_rate_y_hz += share * share / 4.84 * ey / dt if dt > 0.0 else 0.0
    share = max(share, 1.0 / (plane.count + 1))
    plane.slope_x = min(max(plane.slope_x + share * ex, -MAX_SLOPE), MAX_SLOPE)
    plane.slope_y = min(max(plane.slope_y + share * ey, -MAX_SLOPE), MAX_SLOPE)


@jit
def fit_plane(adaptive, n_channels, accepted, dt):
    """Update the slopes with the accepted beams: a plane, or a line along two.

    Parameters
    ----------
    adaptive : record of `AdaptiveState` (`plane` updated)
    n_channels : int  channels in use
    accepted : int    beams that `isolate_faults` accepted, ≥ 1
    dt : float64      time since the plane before [s]

    Notes
    -----
    Weighted least squares about the weighted mean; with four beams or more, not all as far from the axis,
    the mean curvature too, slowly.
    """
    beams, plane = adaptive.beams, adaptive.plane
    total, mx, my, mh, mq = 0.0, 0.0, 0.0, 0.0, 0.0
    for c in range(n_channels):
        if beams.accepted[c] != 0:
            w = beams.weight[c]
            total += w
            mx += w * beams.footprint_m[3 * c]
            my += w * beams.footprint_m[3 * c + 1]
            mh += w * beams.footprint_m[3 * c + 2]
            mq += w * half_squared_distance(beams, c)
    mx, my, mh, mq = mx / total, my / total, mh / total, mq / total
    xx, xy, yy, xh, yh, xq, yq = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for c in range(n_channels):
        if beams.accepted[c] != 0:
            w = beams.weight[c]
            dx, dy = beams.footprint_m[3 * c] - mx, beams.footprint_m[3 * c + 1] - my
            dh, dq = beams.footprint_m[3 * c + 2] - mh, half_squared_distance(beams, c) - mq
            xx += w * dx * dx
            xy += w * dx * dy
            yy += w * dy * dy
            xh += w * dx * dh
            yh += w * dy * dh
            xq += w * dx * dq
            yq += w * dy * dq
    scale = accepted / total  # weights of 1 on average
    spread, determinant = xx + yy, xx * yy - xy * xy
    min_spread = MIN_SPREAD_M * MIN_SPREAD_M
    plane.rank = 0
    if accepted >= 2 and spread * scale > min_spread:
        plane.rank = 1
    if (
        accepted >= 3
        and determinant > MIN_CONDITION * spread * spread
        and determinant * scale > min_spread * spread
    ):
        plane.rank = 2
    decay = math.exp(-dt / RATE_DECAY_S)
    if plane.rank == 0:
        plane.slope_rate_x_hz *= decay
        plane.slope_rate_y_hz *= decay
        ux, uy, slope = track_slope(plane)
        update_from_track(plane, dt, ux, uy, slope)
        return
    if plane.rank == 2:
        hx, hy = (yy * xh - xy * yh) / determinant, (xx * yh - xy * xh) / determinant
        qx, qy = (yy * xq - xy * yq) / determinant, (xx * yq - xy * xq) / determinant
        if accepted >= 4:
            update_curvature(adaptive, n_channels, dt, (mx, my, mh, mq), (hx, hy), (qx, qy))
        plane.fitted_x, plane.fitted_y, plane.spread_m2 = hx, hy, determinant / spread * scale
        ex, ey = hx - plane.curvature * qx - plane.slope_x, hy - plane.curvature * qy - plane.slope_y
        observed_x, observed_y = plane.slope_rate_x_hz, plane.slope_rate_y_hz
    else:
        # along the line (ux, uy) only
        angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
        ux, uy = math.cos(angle), math.sin(angle)
        along = xx * ux * ux + 2.0 * xy * ux * uy + yy * uy * uy
        observed = ((xh - plane.curvature * xq) * ux + (yh - plane.curvature * yq) * uy) / along
        innovation = observed - plane.slope_x * ux - plane.slope_y * uy
        ex, ey = innovation * ux, innovation * uy
        rate = plane.slope_rate_x_hz * ux + plane.slope_rate_y_hz * uy
        observed_x, observed_y = rate * ux, rate * uy
        tx, ty, slope = track_slope(plane)
        across = ty * ux - tx * uy
        if abs(across) > 0.5:
            update_from_track(plane, dt, -uy, ux, (slope - observed * (tx * ux + ty * uy)) / across)
    plane.slope_rate_x_hz = observed_x + (plane.slope_rate_x_hz - observed_x) * decay
    plane.slope_rate_y_hz = observed_y + (plane.slope_rate_y_hz - observed_y) * decay
    if not math.isfinite(ex + ey):
        return
    size = math.sqrt(ex * ex + ey * ey)
    factor = SLOPE_INNOVATION_LIMIT / size if size > SLOPE_INNOVATION_LIMIT and plane.count > 0 else 1.0
    update_slopes(plane, ex * factor, ey * factor, dt)
    if plane.rank == 2:
        plane.count += 1


@jit
def update_track(adaptive, c):
    """Add a beam's footprint to its track, whose older footprints fade with the distance travelled.

    `plane.track` holds weight, means of x, y, z and sums xx, xy, yy, xz, yz about them.
    """
    beams, plane = adaptive.beams, adaptive.plane
    k, at = plane.track, 3 * c
    x, y, z = beams.footprint_m[at], beams.footprint_m[at + 1], beams.footprint_m[at + 2]
    travel = math.hypot(x - plane.track_x_m, y - plane.track_y_m)
    if plane.track_beam != c or not travel < TRACK_GAP_M:
        for i in range(9):
            k[i] = 0.0
        travel = 0.0
    plane.track_beam, plane.track_x_m, plane.track_y_m = c, x, y
    # at rest every sample counts, with a bounded total weight
    keep = math.exp(-travel / TRACK_LENGTH_M) * (1.0 - 1.0 / TRACK_SAMPLES)
    k[0] = k[0] * keep + 1.0
    dx, dy, dz = x - k[1], y - k[2], z - k[3]
    w = 1.0 / k[0]
    k[1], k[2], k[3] = k[1] + dx * w, k[2] + dy * w, k[3] + dz * w
    more = 1.0 - w
    k[4], k[5], k[6] = (
        k[4] * keep + more * dx * dx,
        k[5] * keep + more * dx * dy,
        k[6] * keep + more * dy * dy,
    )
    k[7], k[8] = k[7] * keep + more * dx * dz, k[8] * keep + more * dy * dz


@jit
def track_slope(plane):
    """Direction of the track (ux, uy) and the slope along it at the beam; NaN when it is too short."""
    k = plane.track
    angle = 0.5 * math.atan2(2.0 * k[5], k[4] - k[6])
    ux, uy = math.cos(angle), math.sin(angle)
    along = k[4] * ux * ux + 2.0 * k[5] * ux * uy + k[6] * uy * uy
    if not along > MIN_SPREAD_M * MIN_SPREAD_M * k[0] or k[0] < 3.0:
        return ux, uy, math.nan
    on = (plane.track_x_m - k[1]) * ux + (plane.track_y_m - k[2]) * uy
    return ux, uy, (k[7] * ux + k[8] * uy) / along + plane.curvature * on


@jit
def update_from_track(plane, dt, ux, uy, slope):
    """Update the slope along (ux, uy), which no other beam observes, with that of a track.

    Parameters
    ----------
    plane : record of `Plane`  updated
    dt : float64               time since the plane before [s]
    ux, uy : float64           horizontal unit vector
    slope : float64            slope of the track along it; not finite: nothing is updated
    """
    if not math.isfinite(slope):
        return
    e = min(
        max(slope - plane.slope_x * ux - plane.slope_y * uy, -SLOPE_INNOVATION_LIMIT), SLOPE_INNOVATION_LIMIT
    ) * min(dt / TRACK_TIME_CONSTANT_S, 0.5)
    plane.slope_x = min(max(plane.slope_x + e * ux, -MAX_SLOPE), MAX_SLOPE)
    plane.slope_y = min(max(plane.slope_y + e * uy, -MAX_SLOPE), MAX_SLOPE)


@jit
def update_curvature(adaptive, n_channels, dt, mean, of_height, of_bulge):
    """Update the mean curvature with the residuals of the plane fit.

    Parameters
    ----------
    mean : 4 × float64, of x, y, height, bulge
    of_height, of_bulge : 2 × float64, slopes of the planes through heights and bulges
    """
    beams, plane = adaptive.beams, adaptive.plane
    qq, qh = 0.0, 0.0
    for c in range(n_channels):
        if beams.accepted[c] != 0:
            w = beams.weight[c]
            dx, dy = beams.footprint_m[3 * c] - mean[0], beams.footprint_m[3 * c + 1] - mean[1]
            h = beams.footprint_m[3 * c + 2] - mean[2] - of_height[0] * dx - of_height[1] * dy
            q = half_squared_distance(beams, c) - mean[3] - of_bulge[0] * dx - of_bulge[1] * dy
            qq += w * q * q
            qh += w * q * h
    if qq > CURVATURE_SPREAD_M2 * CURVATURE_SPREAD_M2:
        found = min(max(qh / qq, -MAX_CURVATURE), MAX_CURVATURE)
        plane.curvature += min(CURVATURE_RATE_HZ * dt, 0.5) * (found - plane.curvature)


@jit
def reset_plane(plane):
    """Discard the plane."""
    plane.t_ns = plane.count = 0
    plane.slope_x = plane.slope_y = plane.slope_rate_x_hz = plane.slope_rate_y_hz = plane.curvature = 0.0
