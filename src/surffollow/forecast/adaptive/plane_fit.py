"""Plane fit under several beams: slopes with their rates, and the mean curvature.

Three accepted beams or more update both slopes, two the slope along their line, one the slope along the track
that it draws on the ground. Slopes that are not observed are kept.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.forecast.adaptive.beam_detection import half_squared_distance, isolate_faults, mean_height
from surffollow.shm.jit import jit

FIRST_PLANE_NS = 100_000_000  # so long one or two beams wait for a third at the start
MIN_CONDITION = 1e-2  # least share of the spread of the footprints across their line
MIN_SPREAD_M = 5e-3  # footprints nearer to each other give no slope
MAX_SLOPE = 3.0
SLOPE_BANDWIDTH_RADPS = 11.0  # of the slopes [rad/s]; damping 1.1
MAX_GAP_NS = 50_000_000  # slopes are carried on by their rates over shorter gaps only
RATE_DECAY_S = 0.05  # so fast a rate that is not renewed dies away
SLOPE_INNOVATION_LIMIT = 0.2  # largest innovation of a slope that is believed at once
TRACK_TIME_CONSTANT_S = 0.1  # over which a slope is taken from a beam's track when others are missing
TRACK_LENGTH_M, TRACK_SAMPLES, TRACK_GAP_M = 0.015, 250.0, 0.05
CURVATURE_RATE_HZ = 2.5
CURVATURE_SPREAD_M2 = 1e-4  # least spread of half the squared distances from the axis
MAX_CURVATURE = 10.0  # 1/m


@jit
def plane_height(params: Any, a: Any, t_ns: Any, x_m: Any, y_m: Any) -> Any:
    """Height under the tool from all good beams, slopes renewed; 0 beams when there are none.

    The height is that of the plane which touches the ground where the tool's axis meets it.

    Returns
    -------
    int64, float64 [m]
    """
    dt = propagate_slopes(a, t_ns)
    good = isolate_faults(a, params.n_channels, t_ns, x_m, y_m)
    if good == 0:
        return 0, 0.0
    if a.beam_good[a.primary] != 0:
        update_track(a, a.primary)
    fit_plane(a, params.n_channels, good, dt)
    if a.beams_ns == 0 or t_ns < a.beams_ns:
        a.beams_ns = t_ns
    if a.planes == 0 and t_ns - a.beams_ns < FIRST_PLANE_NS:
        return 0, 0.0  # one beam on a slope tells a wrong height: wait for the others
    return good, mean_height(a, params.n_channels, x_m, y_m)


@jit
def propagate_slopes(a: Any, t_ns: Any) -> Any:
    """Carry the slopes on to a sample by their rates; the time since the last one [s], 0 after a gap."""
    dt = (t_ns - a.plane_ns) * 1e-9
    if a.plane_ns == 0 or not 0.0 < dt <= MAX_GAP_NS * 1e-9:
        if a.plane_ns != 0 and abs(dt) > 0.5:
            a.planes = min(a.planes, 1)  # what was known is old: the next planes count for more
        a.slope_x_hz = a.slope_y_hz = 0.0
        dt = 0.0
    a.plane_ns = t_ns
    a.slope_x = min(max(a.slope_x + a.slope_x_hz * dt, -MAX_SLOPE), MAX_SLOPE)
    a.slope_y = min(max(a.slope_y + a.slope_y_hz * dt, -MAX_SLOPE), MAX_SLOPE)
    return dt


@jit
def update_slopes(a: Any, ex: Any, ey: Any, dt: Any) -> None:
    """Take a share of an innovation into slopes and rates; the first planes count in full."""
    share = min(2.2 * SLOPE_BANDWIDTH_RADPS * dt, 0.5)
    a.slope_x_hz += share * share / 4.84 * ex / dt if dt > 0.0 else 0.0
    a.slope_y_hz += share * share / 4.84 * ey / dt if dt > 0.0 else 0.0
    share = max(share, 1.0 / (a.planes + 1))
    a.slope_x = min(max(a.slope_x + share * ex, -MAX_SLOPE), MAX_SLOPE)
    a.slope_y = min(max(a.slope_y + share * ey, -MAX_SLOPE), MAX_SLOPE)


@jit
def fit_plane(a: Any, n_channels: Any, good: Any, dt: Any) -> None:
    """Move the slopes toward those of the good beams: a plane, or a line along two.

    Notes
    -----
    Weighted least squares about the weighted mean; with four beams or more, not all as far from the axis,
    the mean curvature too, slowly.
    """
    total, mx, my, mh, mq = 0.0, 0.0, 0.0, 0.0, 0.0
    for c in range(n_channels):
        if a.beam_good[c] != 0:
            w = a.beam_weight[c]
            total += w
            mx += w * a.beam_m[3 * c]
            my += w * a.beam_m[3 * c + 1]
            mh += w * a.beam_m[3 * c + 2]
            mq += w * half_squared_distance(a, c)
    mx, my, mh, mq = mx / total, my / total, mh / total, mq / total
    xx, xy, yy, xh, yh, xq, yq = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for c in range(n_channels):
        if a.beam_good[c] != 0:
            w = a.beam_weight[c]
            dx, dy = a.beam_m[3 * c] - mx, a.beam_m[3 * c + 1] - my
            dh, dq = a.beam_m[3 * c + 2] - mh, half_squared_distance(a, c) - mq
            xx += w * dx * dx
            xy += w * dx * dy
            yy += w * dy * dy
            xh += w * dx * dh
            yh += w * dy * dh
            xq += w * dx * dq
            yq += w * dy * dq
    scale = good / total  # weights of 1 on average
    spread, determinant = xx + yy, xx * yy - xy * xy
    least = MIN_SPREAD_M * MIN_SPREAD_M
    a.plane_rank = 0
    if good >= 2 and spread * scale > least:
        a.plane_rank = 1
    if good >= 3 and determinant > MIN_CONDITION * spread * spread and determinant * scale > least * spread:
        a.plane_rank = 2
    fade = math.exp(-dt / RATE_DECAY_S)
    if a.plane_rank == 0:
        a.slope_x_hz *= fade
        a.slope_y_hz *= fade
        ux, uy, slope = track_slope(a)
        update_from_track(a, dt, ux, uy, slope)
        return
    if a.plane_rank == 2:
        hx, hy = (yy * xh - xy * yh) / determinant, (xx * yh - xy * xh) / determinant
        qx, qy = (yy * xq - xy * yq) / determinant, (xx * yq - xy * xq) / determinant
        if good >= 4:
            update_curvature(a, n_channels, dt, (mx, my, mh, mq), (hx, hy), (qx, qy))
        ex, ey = hx - a.curve * qx - a.slope_x, hy - a.curve * qy - a.slope_y
        seen_x, seen_y = a.slope_x_hz, a.slope_y_hz
    else:
        # along the line only: (ux, uy) carries the part of the slope that was seen
        angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
        ux, uy = math.cos(angle), math.sin(angle)
        along = xx * ux * ux + 2.0 * xy * ux * uy + yy * uy * uy
        seen = ((xh - a.curve * xq) * ux + (yh - a.curve * yq) * uy) / along
        more = seen - a.slope_x * ux - a.slope_y * uy
        ex, ey = more * ux, more * uy
        rate = a.slope_x_hz * ux + a.slope_y_hz * uy
        seen_x, seen_y = rate * ux, rate * uy
        tx, ty, slope = track_slope(a)
        across = ty * ux - tx * uy
        if abs(across) > 0.5:
            update_from_track(a, dt, -uy, ux, (slope - seen * (tx * ux + ty * uy)) / across)
    a.slope_x_hz = seen_x + (a.slope_x_hz - seen_x) * fade
    a.slope_y_hz = seen_y + (a.slope_y_hz - seen_y) * fade
    if not math.isfinite(ex + ey):
        return
    size = math.sqrt(ex * ex + ey * ey)
    cut = SLOPE_INNOVATION_LIMIT / size if size > SLOPE_INNOVATION_LIMIT and a.planes > 0 else 1.0
    update_slopes(a, ex * cut, ey * cut, dt)
    if a.plane_rank == 2:
        a.planes += 1


@jit
def update_track(a: Any, c: Any) -> None:
    """Add a beam's footprint to the track that it draws on the ground; older ones are forgotten by the way.

    `a.track` holds weight, means of x, y, z and sums xx, xy, yy, xz, yz about them.
    """
    k, x, y, z = a.track, a.beam_m[3 * c], a.beam_m[3 * c + 1], a.beam_m[3 * c + 2]
    way = math.hypot(x - a.track_x_m, y - a.track_y_m)
    if a.track_beam != c or not way < TRACK_GAP_M:
        for i in range(9):
            k[i] = 0.0
        way = 0.0
    a.track_beam, a.track_x_m, a.track_y_m = c, x, y
    # at rest every sample counts, but none is heavier than all that was seen on the way here
    keep = math.exp(-way / TRACK_LENGTH_M) * (1.0 - 1.0 / TRACK_SAMPLES)
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
def track_slope(a: Any) -> Any:
    """Direction of the track (ux, uy) and the slope along it where the beam is; NaN when it is too short."""
    k = a.track
    angle = 0.5 * math.atan2(2.0 * k[5], k[4] - k[6])
    ux, uy = math.cos(angle), math.sin(angle)
    along = k[4] * ux * ux + 2.0 * k[5] * ux * uy + k[6] * uy * uy
    if not along > MIN_SPREAD_M * MIN_SPREAD_M * k[0] or k[0] < 3.0:
        return ux, uy, math.nan
    on = (a.track_x_m - k[1]) * ux + (a.track_y_m - k[2]) * uy
    return ux, uy, (k[7] * ux + k[8] * uy) / along + a.curve * on


@jit
def update_from_track(a: Any, dt: Any, ux: Any, uy: Any, slope: Any) -> None:
    """Take a share of a slope along (ux, uy) that a beam's track tells where others are missing."""
    if not math.isfinite(slope):
        return
    e = min(
        max(slope - a.slope_x * ux - a.slope_y * uy, -SLOPE_INNOVATION_LIMIT), SLOPE_INNOVATION_LIMIT
    ) * min(dt / TRACK_TIME_CONSTANT_S, 0.5)
    a.slope_x = min(max(a.slope_x + e * ux, -MAX_SLOPE), MAX_SLOPE)
    a.slope_y = min(max(a.slope_y + e * uy, -MAX_SLOPE), MAX_SLOPE)


@jit
def update_curvature(a: Any, n_channels: Any, dt: Any, mean: Any, of_height: Any, of_bulge: Any) -> None:
    """Take a share of the mean curvature that remains beyond the plane.

    Parameters
    ----------
    mean : 4 × float64, of x, y, height, bulge
    of_height, of_bulge : 2 × float64, slopes of the planes through heights and bulges
    """
    qq, qh = 0.0, 0.0
    for c in range(n_channels):
        if a.beam_good[c] != 0:
            w = a.beam_weight[c]
            dx, dy = a.beam_m[3 * c] - mean[0], a.beam_m[3 * c + 1] - mean[1]
            h = a.beam_m[3 * c + 2] - mean[2] - of_height[0] * dx - of_height[1] * dy
            q = half_squared_distance(a, c) - mean[3] - of_bulge[0] * dx - of_bulge[1] * dy
            qq += w * q * q
            qh += w * q * h
    if qq > CURVATURE_SPREAD_M2 * CURVATURE_SPREAD_M2:
        found = min(max(qh / qq, -MAX_CURVATURE), MAX_CURVATURE)
        a.curve += min(CURVATURE_RATE_HZ * dt, 0.5) * (found - a.curve)
