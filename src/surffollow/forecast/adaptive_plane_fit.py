"""The plane under several beams: which of them agree, its slopes with their rates, its curvature.

The median of the heights under the tool tells which beams are odd. One that stays odd is believed after
a few samples (the ground has turned), unless three others agree on a plane or its reading stands still.
Weights fall to nothing at the gate and grow slowly for a beam that comes back.
"""

from __future__ import annotations

import math
from typing import Any

from surffollow.shm.jit import jit

FRESH_NS = 25_000_000  # older footprints do not belong to the same plane
STILL_NS = 100_000_000  # a reading that stays the same so long while the others change is stuck
ODD_SCALES, ODD_M = 8.0, 2e-3
ODD_SAMPLES = 5
FADE_IN = 0.1  # weight that a beam gains per sample
LEAST_WEIGHT = 0.05  # of a beam that is believed although it is odd
CONDITION = 1e-2  # least share of the spread of the footprints across their line
LEAST_SPREAD_M = 5e-3  # footprints nearer to each other give no slope
STEEPEST = 3.0
BANDWIDTH = 11.0  # of the slopes [rad/s]; damping 1.1
LAST_SEEN_NS = 50_000_000  # slopes are carried on by their rates over shorter gaps only
FADE_S = 0.05  # so fast a rate that is not renewed dies away
KICK = 0.2  # largest innovation of a slope that is believed at once
TRACK_S = 0.1  # over which a slope is taken from a beam's track when others are missing
TRACK_M, TRACK_SAMPLES, LONGEST_TRACK_M = 0.015, 250.0, 0.05
CURVE_HZ = 2.5
CURVE_SPREAD_M2 = 1e-4  # least spread of half the squared distances from the axis
CURVE_MOST = 10.0  # 1/m


@jit
def carry_slopes(a: Any, t_ns: Any) -> Any:
    """Carry the slopes on to a sample by their rates; the time since the last one [s], 0 after a gap."""
    dt = (t_ns - a.plane_ns) * 1e-9
    if a.plane_ns == 0 or not 0.0 < dt <= LAST_SEEN_NS * 1e-9:
        if a.plane_ns != 0 and abs(dt) > 0.5:
            a.planes = min(a.planes, 1)  # what was known is old: the next planes count for more
        a.slope_x_hz = a.slope_y_hz = 0.0
        dt = 0.0
    a.plane_ns = t_ns
    a.slope_x = min(max(a.slope_x + a.slope_x_hz * dt, -STEEPEST), STEEPEST)
    a.slope_y = min(max(a.slope_y + a.slope_y_hz * dt, -STEEPEST), STEEPEST)
    return dt


@jit
def _median(values: Any, n: Any) -> Any:
    """Median of the first n values, which are sorted in place."""
    for i in range(1, n):
        v, j = values[i], i
        while j > 0 and values[j - 1] > v:
            values[j] = values[j - 1]
            j -= 1
        values[j] = v
    return values[n // 2] if n % 2 == 1 else 0.5 * (values[n // 2 - 1] + values[n // 2])


@jit
def bulge(a: Any, c: Any) -> Any:
    """Half the squared distance of a beam's footprint from the tool's axis [m²]."""
    dx, dy = a.beam_m[3 * c] - a.axis_x_m, a.beam_m[3 * c + 1] - a.axis_y_m
    return 0.5 * (dx * dx + dy * dy)


@jit
def beam_height(a: Any, c: Any, x_m: Any, y_m: Any) -> Any:
    """Height at (x, y) of the plane through a beam's footprint, the curvature's share taken off [m]."""
    dx, dy = a.beam_m[3 * c] - x_m, a.beam_m[3 * c + 1] - y_m
    return a.beam_m[3 * c + 2] - a.slope_x * dx - a.slope_y * dy - a.curve * bulge(a, c)


@jit
def judge_beams(a: Any, n_channels: Any, t_ns: Any, x_m: Any, y_m: Any) -> Any:
    """Mark the beams that agree, weigh them, and return how many there are."""
    n, still = 0, 0
    for c in range(n_channels):
        a.beam_good[c] = 0
        if a.beam_ns[c] == 0 or abs(t_ns - a.beam_ns[c]) > FRESH_NS:
            a.beam_weight[c] = 0.0
            continue
        a.beam_h_m[c] = beam_height(a, c, x_m, y_m)
        a.beam_sort_m[n] = a.beam_h_m[c]
        a.beam_good[c] = 1
        still += 1 if a.beam_ns[c] - a.beam_changed_ns[c] > STILL_NS else 0
        n += 1
    if n == 0:
        return 0
    middle = _median(a.beam_sort_m, n)
    gate = max(ODD_SCALES * a.noise_m, ODD_M)
    agree = 0
    for c in range(n_channels):
        if a.beam_good[c] != 0 and abs(a.beam_h_m[c] - middle) <= gate:
            agree += 1
    majority = agree >= 3 and a.plane_rank == 2
    good = 0
    for c in range(n_channels):
        if a.beam_good[c] == 0:
            continue
        off = abs(a.beam_h_m[c] - middle) / gate
        odd = off > 1.0 and n >= 2 and a.planes > 0
        a.beam_odd[c] = min(max(a.beam_odd[c] + (1 if odd else -1), 0), 2 * ODD_SAMPLES)
        stuck = still == 1 and n >= 2 and a.beam_ns[c] - a.beam_changed_ns[c] > STILL_NS
        if stuck or (odd and a.beam_odd[c] <= ODD_SAMPLES) or (majority and a.beam_odd[c] > 0):
            a.beam_odd[c] = max(a.beam_odd[c], 1)
            a.beam_good[c] = 0
            a.beam_weight[c] = 0.0
            continue
        full = max((1.0 - off * off) ** 2, LEAST_WEIGHT) if off < 1.0 else LEAST_WEIGHT
        if a.planes == 0:
            a.beam_weight[c] = 1.0
        else:
            a.beam_weight[c] = min(full, a.beam_weight[c] + FADE_IN)
        good += 1
    return good


@jit
def mean_height(a: Any, n_channels: Any, x_m: Any, y_m: Any) -> Any:
    """Weighted mean of the good beams' heights at (x, y) [m]."""
    total, weights = 0.0, 0.0
    for c in range(n_channels):
        if a.beam_good[c] != 0:
            total += a.beam_weight[c] * beam_height(a, c, x_m, y_m)
            weights += a.beam_weight[c]
    return total / weights


@jit
def renew_slopes(a: Any, ex: Any, ey: Any, dt: Any) -> None:
    """Take a share of an innovation into slopes and rates; the first planes count in full."""
    share = min(2.2 * BANDWIDTH * dt, 0.5)
    a.slope_x_hz += share * share / 4.84 * ex / dt if dt > 0.0 else 0.0
    a.slope_y_hz += share * share / 4.84 * ey / dt if dt > 0.0 else 0.0
    share = max(share, 1.0 / (a.planes + 1))
    a.slope_x = min(max(a.slope_x + share * ex, -STEEPEST), STEEPEST)
    a.slope_y = min(max(a.slope_y + share * ey, -STEEPEST), STEEPEST)


@jit
def fit_slopes(a: Any, n_channels: Any, good: Any, dt: Any) -> None:
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
            mq += w * bulge(a, c)
    mx, my, mh, mq = mx / total, my / total, mh / total, mq / total
    xx, xy, yy, xh, yh, xq, yq = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for c in range(n_channels):
        if a.beam_good[c] != 0:
            w = a.beam_weight[c]
            dx, dy = a.beam_m[3 * c] - mx, a.beam_m[3 * c + 1] - my
            dh, dq = a.beam_m[3 * c + 2] - mh, bulge(a, c) - mq
            xx += w * dx * dx
            xy += w * dx * dy
            yy += w * dy * dy
            xh += w * dx * dh
            yh += w * dy * dh
            xq += w * dx * dq
            yq += w * dy * dq
    scale = good / total  # weights of 1 on average
    spread, determinant = xx + yy, xx * yy - xy * xy
    least = LEAST_SPREAD_M * LEAST_SPREAD_M
    a.plane_rank = 0
    if good >= 2 and spread * scale > least:
        a.plane_rank = 1
    if good >= 3 and determinant > CONDITION * spread * spread and determinant * scale > least * spread:
        a.plane_rank = 2
    fade = math.exp(-dt / FADE_S)
    if a.plane_rank == 0:
        a.slope_x_hz *= fade
        a.slope_y_hz *= fade
        ux, uy, slope = track_slope(a)
        learn_from_way(a, dt, ux, uy, slope)
        return
    if a.plane_rank == 2:
        hx, hy = (yy * xh - xy * yh) / determinant, (xx * yh - xy * xh) / determinant
        qx, qy = (yy * xq - xy * yq) / determinant, (xx * yq - xy * xq) / determinant
        if good >= 4:
            learn_curve(a, n_channels, dt, (mx, my, mh, mq), (hx, hy), (qx, qy))
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
            learn_from_way(a, dt, -uy, ux, (slope - seen * (tx * ux + ty * uy)) / across)
    a.slope_x_hz = seen_x + (a.slope_x_hz - seen_x) * fade
    a.slope_y_hz = seen_y + (a.slope_y_hz - seen_y) * fade
    if not math.isfinite(ex + ey):
        return
    size = math.sqrt(ex * ex + ey * ey)
    cut = KICK / size if size > KICK and a.planes > 0 else 1.0
    renew_slopes(a, ex * cut, ey * cut, dt)
    if a.plane_rank == 2:
        a.planes += 1


@jit
def note_track(a: Any, c: Any) -> None:
    """Add a beam's footprint to the track that it draws on the ground; older ones are forgotten by the way.

    `a.track` holds weight, means of x, y, z and sums xx, xy, yy, xz, yz about them.
    """
    k, x, y, z = a.track, a.beam_m[3 * c], a.beam_m[3 * c + 1], a.beam_m[3 * c + 2]
    way = math.hypot(x - a.track_x_m, y - a.track_y_m)
    if a.track_beam != c or not way < LONGEST_TRACK_M:
        for i in range(9):
            k[i] = 0.0
        way = 0.0
    a.track_beam, a.track_x_m, a.track_y_m = c, x, y
    # at rest every sample counts, but none is heavier than all that was seen on the way here
    keep = math.exp(-way / TRACK_M) * (1.0 - 1.0 / TRACK_SAMPLES)
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
    if not along > LEAST_SPREAD_M * LEAST_SPREAD_M * k[0] or k[0] < 3.0:
        return ux, uy, math.nan
    on = (a.track_x_m - k[1]) * ux + (a.track_y_m - k[2]) * uy
    return ux, uy, (k[7] * ux + k[8] * uy) / along + a.curve * on


@jit
def learn_from_way(a: Any, dt: Any, ux: Any, uy: Any, slope: Any) -> None:
    """Take a share of a slope along (ux, uy) that a beam's track tells where others are missing."""
    if not math.isfinite(slope):
        return
    e = min(max(slope - a.slope_x * ux - a.slope_y * uy, -KICK), KICK) * min(dt / TRACK_S, 0.5)
    a.slope_x = min(max(a.slope_x + e * ux, -STEEPEST), STEEPEST)
    a.slope_y = min(max(a.slope_y + e * uy, -STEEPEST), STEEPEST)


@jit
def learn_curve(a: Any, n_channels: Any, dt: Any, mean: Any, of_height: Any, of_bulge: Any) -> None:
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
            q = bulge(a, c) - mean[3] - of_bulge[0] * dx - of_bulge[1] * dy
            qq += w * q * q
            qh += w * q * h
    if qq > CURVE_SPREAD_M2 * CURVE_SPREAD_M2:
        found = min(max(qh / qq, -CURVE_MOST), CURVE_MOST)
        a.curve += min(CURVE_HZ * dt, 0.5) * (found - a.curve)
