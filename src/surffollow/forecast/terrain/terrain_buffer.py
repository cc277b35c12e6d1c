"""Terrain buffer: mean heights in cells along the path, each with the place where it was measured.

After a turn the path leads elsewhere; cells that do not lie on it are ignored.
"""

import math

from surffollow.forecast import elementary
from surffollow.forecast.quantities import APART_M
from surffollow.forecast.sensing.kinematics import is_at_rest
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_estimation import BUFFER_CELLS

CELL_M = 1e-3  # length of a cell along the path, side of a cell of the terrain memory
HOLE_CELLS = 8  # longer holes are not bridged, but for those of the usual travel between two samples
BRIDGED_TRAVELS = 1.5  # usual travels between two samples: a longer hole has lost one


@jit
def point_at(adaptive, s_m):
    """Point of the path at an arc length, straight through the newest footprint [m]."""
    kinematics, sample, d = adaptive.kinematics, adaptive.sample, s_m - adaptive.estimate.arc_length_m
    if is_at_rest(kinematics):
        return sample.x_m + d * sample.heading_x, sample.y_m + d * sample.heading_y
    t = d / kinematics.speed_mps
    return sample.x_m + t * kinematics.velocity_x_mps, sample.y_m + t * kinematics.velocity_y_mps


@jit
def sensor_leads(adaptive):
    """Whether channel 0 measures the ground ahead of the tool, and so knows it."""
    return adaptive.sample.lead_m > APART_M


@jit
def is_off_path(adaptive, c):
    """Whether cell c was measured away from the point of the path at its arc length."""
    buffer, s_m = adaptive.buffer, adaptive.buffer.arc_length_m[c]
    x, y = point_at(adaptive, s_m)
    tolerance = max(APART_M, 0.2 * abs(s_m - adaptive.estimate.arc_length_m))
    return elementary.hypot(buffer.x_m[c] - x, buffer.y_m[c] - y) > tolerance


@jit
def _fill_cell(adaptive, s_m, h_m):
    """Add a height to the mean of its cell; a cell measured elsewhere is replaced."""
    buffer = adaptive.buffer
    k = int(s_m / CELL_M)
    c = k & (BUFFER_CELLS - 1)
    if buffer.cell[c] != k + 1 or is_off_path(adaptive, c):
        buffer.cell[c] = k + 1
        buffer.x_m[c], buffer.y_m[c] = point_at(adaptive, s_m)
        buffer.count[c] = buffer.height_m[c] = buffer.arc_length_m[c] = 0.0
    buffer.count[c] += 1.0
    buffer.height_m[c] += (h_m - buffer.height_m[c]) / buffer.count[c]
    buffer.arc_length_m[c] += (s_m - buffer.arc_length_m[c]) / buffer.count[c]


@jit
def usual_travel_m(adaptive):
    """Usual travel between two samples, as far as it is bridged: an eighth of the buffer [m]."""
    return min(adaptive.kinematics.speed_mps * adaptive.hold.interval_s, BUFFER_CELLS // 8 * CELL_M)


@jit
def longest_hole_m(adaptive):
    """Longest hole that is bridged [m]: that of the terrain buffer."""
    return max(HOLE_CELLS * CELL_M, BRIDGED_TRAVELS * usual_travel_m(adaptive))


@jit
def store_ground(adaptive, s_m, h_m):
    """Store a height at its arc length, and fill the cells between it and the one before on a straight line.

    They are filled where the travel is the usual one between two samples, and too long for `buffered_height`.
    """
    buffer = adaptive.buffer
    gap_m = s_m - buffer.newest_arc_length_m
    if (HOLE_CELLS - 1) * CELL_M < gap_m < BRIDGED_TRAVELS * usual_travel_m(adaptive):
        for k in range(1, int(gap_m / CELL_M)):
            h = buffer.newest_height_m + (h_m - buffer.newest_height_m) * k * CELL_M / gap_m
            _fill_cell(adaptive, buffer.newest_arc_length_m + k * CELL_M, h)
    _fill_cell(adaptive, s_m, h_m)
    buffer.newest_arc_length_m, buffer.newest_height_m = s_m, h_m


@jit
def store_ground_under(adaptive, s_m, h_m):
    """Store a height of channel 0, unless a further channel leads, or it leads itself and the tool rests.

    Heights that channel 0 is compared with are then of that channel alone, or of before the rest.
    """
    leads, behind_another = sensor_leads(adaptive), adaptive.lookahead.ahead_m > 0.0
    if not (is_at_rest(adaptive.kinematics) if leads else behind_another):
        store_ground(adaptive, s_m, h_m)


@jit
def buffered_height(adaptive, s_m):
    """Buffered height at an arc length, linear between cells [m]; NaN where there is none.

    Cells that are off the path after a turn count as none.
    """
    buffer = adaptive.buffer
    k = math.floor(s_m / CELL_M)
    below, above = -1, -1
    for j in range(HOLE_CELLS):
        c = (k - j) & (BUFFER_CELLS - 1)
        if below < 0 and buffer.cell[c] == k - j + 1 and buffer.arc_length_m[c] <= s_m:
            below = c
        c = (k + j) & (BUFFER_CELLS - 1)
        if above < 0 and buffer.cell[c] == k + j + 1 and buffer.arc_length_m[c] > s_m:
            above = c
    if below < 0 or above < 0 or is_off_path(adaptive, below) or is_off_path(adaptive, above):
        return math.nan
    f = (s_m - buffer.arc_length_m[below]) / (buffer.arc_length_m[above] - buffer.arc_length_m[below])
    return buffer.height_m[below] * (1.0 - f) + buffer.height_m[above] * f


@jit
def height_at(adaptive, s_m):
    """Buffered height of the cell nearest to the place of an arc length [m]; NaN beyond `APART_M`.

    For a tool that came to rest: the speed is a mean, and arc lengths of before differ from those at rest.
    """
    buffer, nearest_m, height_m = adaptive.buffer, APART_M, math.nan
    x, y = point_at(adaptive, s_m)
    for c in range(BUFFER_CELLS):
        away_m = elementary.hypot(buffer.x_m[c] - x, buffer.y_m[c] - y)
        if buffer.cell[c] != 0 and away_m < nearest_m:
            nearest_m, height_m = away_m, buffer.height_m[c]
    return height_m


@jit
def bridge_gaps(heights_m, n, most):
    """Fill gaps of at most `most` unknown places between known ones, linearly; how many places are known.

    Samples next to a step are held back from the map until the step is confirmed: without them every edge
    would end what is known.

    Parameters
    ----------
    heights_m : (≥ n,) float64   updated in place; NaN where unknown
    n, most : int
    """
    last, known = -1, 0
    for k in range(n):
        if math.isnan(heights_m[k]):
            continue
        gap = k - last - 1
        if last >= 0 and gap <= most:
            rise = (heights_m[k] - heights_m[last]) / (gap + 1)
            for j in range(1, gap + 1):
                heights_m[last + j] = heights_m[last] + j * rise
            known += gap
        last = k
        known += 1
    return known
