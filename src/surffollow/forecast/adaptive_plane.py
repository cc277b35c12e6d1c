"""Several sensors: a robust plane through their footprints, its height under the tool, its normal.

Every beam gives a height under the tool by way of the slopes known so far; the median tells which beams
are odd. Three good beams or more renew both slopes, two the slope along their line, one none: what is
not renewed is kept, so losing a sensor moves nothing.
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from surffollow.forecast.adaptive_motion import pose_when
from surffollow.forecast.pose import footprint, rotate
from surffollow.shm.layout_follow import CHANNELS, POSES

FRESH_NS = 25_000_000  # older footprints do not belong to the same plane
SLOPE_RATE = 0.2  # per sample; two thirds of the readings' noise are gone then
ODD_SCALES, ODD_M = 8.0, 2e-3
ODD_SAMPLES = 5  # a beam that stays odd is right: the ground has turned
CONDITION = 1e-2  # least share of the spread of the footprints across their line
STEEPEST = 3.0


@njit(cache=True, nogil=True)
def take_beams(params: Any, a: Any, sense: Any, pose: Any) -> Any:
    """Footprints of all fresh channels; the first channel that has a valid reading, or -1."""
    first = -1
    for c in range(params.n_channels):
        if sense.valid[c] != 0 and first < 0:
            first = c
        if sense.fresh[c] == 0:
            continue
        pose_when(a, sense, sense.range_t_ns[c], pose)
        x, y, z, _ = footprint(pose, params.tool_from_sensor, c, sense.range_m[c])
        a.beam_m[3 * c], a.beam_m[3 * c + 1], a.beam_m[3 * c + 2] = x, y, z
        a.beam_ns[c] = sense.range_t_ns[c]
    return first


@njit(cache=True, nogil=True)
def _median(values: Any, n: Any) -> Any:
    """Median of the first n values, which are sorted in place."""
    for i in range(1, n):
        v, j = values[i], i
        while j > 0 and values[j - 1] > v:
            values[j] = values[j - 1]
            j -= 1
        values[j] = v
    return values[n // 2] if n % 2 == 1 else 0.5 * (values[n // 2 - 1] + values[n // 2])


@njit(cache=True, nogil=True)
def judge_beams(a: Any, n_channels: Any, t_ns: Any, x_m: Any, y_m: Any) -> Any:
    """Mark the beams that agree and return how many, and their mean height at (x, y)."""
    n = 0
    for c in range(n_channels):
        a.beam_good[c] = 0
        if a.beam_ns[c] == 0 or abs(t_ns - a.beam_ns[c]) > FRESH_NS:
            continue
        dx, dy = a.beam_m[3 * c] - x_m, a.beam_m[3 * c + 1] - y_m
        a.beam_h_m[c] = a.beam_m[3 * c + 2] - a.slope_x * dx - a.slope_y * dy
        a.beam_sort_m[n] = a.beam_h_m[c]
        a.beam_good[c] = 1
        n += 1
    if n == 0:
        return 0, 0.0
    middle = _median(a.beam_sort_m, n)
    gate = max(ODD_SCALES * a.noise_m, ODD_M)
    good, total = 0, 0.0
    for c in range(n_channels):
        if a.beam_good[c] == 0:
            continue
        if n >= 3 and a.planes > 0 and abs(a.beam_h_m[c] - middle) > gate and a.beam_odd[c] < ODD_SAMPLES:
            a.beam_odd[c] += 1
            a.beam_good[c] = 0
            continue
        if abs(a.beam_h_m[c] - middle) <= gate:
            a.beam_odd[c] = 0
        good += 1
        total += a.beam_h_m[c]
    if good == 0:
        return 0, middle
    return good, total / good


@njit(cache=True, nogil=True)
def fit_slopes(a: Any, n_channels: Any, good: Any, x_m: Any, y_m: Any) -> None:
    """Move the slopes toward those of the good beams: a plane, or a line along two."""
    mx, my, mh = 0.0, 0.0, 0.0
    for c in range(n_channels):
        if a.beam_good[c] != 0:
            mx += a.beam_m[3 * c] / good
            my += a.beam_m[3 * c + 1] / good
            mh += a.beam_m[3 * c + 2] / good
    xx, xy, yy, xh, yh = 0.0, 0.0, 0.0, 0.0, 0.0
    for c in range(n_channels):
        if a.beam_good[c] != 0:
            dx, dy = a.beam_m[3 * c] - mx, a.beam_m[3 * c + 1] - my
            dh = a.beam_m[3 * c + 2] - mh
            xx += dx * dx
            xy += dx * dy
            yy += dy * dy
            xh += dx * dh
            yh += dy * dh
    spread = xx + yy
    if not spread > 1e-10:
        return
    determinant = xx * yy - xy * xy
    rate = SLOPE_RATE if a.planes > 0 else 1.0
    if good >= 3 and determinant > CONDITION * spread * spread:
        sx, sy = (yy * xh - xy * yh) / determinant, (xx * yh - xy * xh) / determinant
        a.planes += 1
    else:
        # along the line only: (dx, dy) carries the part of the slope that was seen
        angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
        ux, uy = math.cos(angle), math.sin(angle)
        along = xx * ux * ux + 2.0 * xy * ux * uy + yy * uy * uy
        seen = (xh * ux + yh * uy) / along
        more = seen - a.slope_x * ux - a.slope_y * uy
        sx, sy = a.slope_x + more * ux, a.slope_y + more * uy
    a.slope_x = min(max(a.slope_x + rate * (sx - a.slope_x), -STEEPEST), STEEPEST)
    a.slope_y = min(max(a.slope_y + rate * (sy - a.slope_y), -STEEPEST), STEEPEST)


@njit(cache=True, nogil=True)
def plane_height(params: Any, a: Any, t_ns: Any, x_m: Any, y_m: Any) -> Any:
    """Height under the tool from all good beams, slopes renewed; 0 beams when there are none.

    Returns
    -------
    int64, float64 [m]
    """
    good, h = judge_beams(a, params.n_channels, t_ns, x_m, y_m)
    if good >= 2:
        fit_slopes(a, params.n_channels, good, x_m, y_m)
        good, h = judge_beams(a, params.n_channels, t_ns, x_m, y_m)
    return good, h


@njit(cache=True, nogil=True)
def demand_turn(params: Any, a: Any, sense: Any, output: Any) -> None:
    """Rotation vector that aligns the tool's axis with the surface normal, limited, with hysteresis."""
    length = math.sqrt(a.slope_x * a.slope_x + a.slope_y * a.slope_y + 1.0)
    nx, ny, nz = -a.slope_x / length, -a.slope_y / length, 1.0 / length
    q = 7 * ((sense.pose_count - 1) & (POSES - 1)) + 3
    p = sense.pose
    tx, ty, tz = rotate(p[q], p[q + 1], p[q + 2], p[q + 3], 0.0, 0.0, 1.0)
    cx, cy, cz = ty * nz - tz * ny, tz * nx - tx * nz, tx * ny - ty * nx
    sine = math.sqrt(cx * cx + cy * cy + cz * cz)
    angle = math.atan2(sine, tx * nx + ty * ny + tz * nz)
    scale = min(angle, params.max_turn_rad) / sine if sine > 1e-12 else 0.0
    wx, wy, wz = cx * scale, cy * scale, cz * scale
    change = (wx - a.turn_rad[0]) ** 2 + (wy - a.turn_rad[1]) ** 2 + (wz - a.turn_rad[2]) ** 2
    if change > params.permitted_turn_rad**2:
        a.turn_rad[0], a.turn_rad[1], a.turn_rad[2] = wx, wy, wz
    size = math.sqrt(a.turn_rad[0] ** 2 + a.turn_rad[1] ** 2 + a.turn_rad[2] ** 2)
    cut = params.max_turn_rad / size if size > params.max_turn_rad else 1.0
    for k in range(3):
        output.demand[3 + k] = a.turn_rad[k] * cut


@njit(cache=True, nogil=True)
def surface_normal(a: Any, output: Any) -> None:
    """Publish the normal; straight up while no plane is known."""
    length = math.sqrt(a.slope_x * a.slope_x + a.slope_y * a.slope_y + 1.0)
    output.normal[0], output.normal[1], output.normal[2] = (
        -a.slope_x / length,
        -a.slope_y / length,
        1.0 / length,
    )
    beams = 0
    for c in range(CHANNELS):
        beams |= (1 if a.beam_good[c] != 0 else 0) << c
    output.beams = beams
