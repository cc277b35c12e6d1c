"""Group footprints into overlapping intervals along the path, and those into ranges (paper §3.2.2-3.2.3).

Both live in one ring: the newest interval is number `interval_count - 1`, the
current range is the newest Range_Size of them, the previous range the Range_Size
before. Only the newest interval's height still changes, so all else about the
two ranges is summed once, when an interval opens.
"""

from surffollow.forecast import elementary
from surffollow.shm.jit import jit_inlined
from surffollow.shm.layout_follow import INTERVALS


@jit_inlined
def open_interval(paper, x_m, y_m, h_m):
    """Make a new interval, centred at the point, the current one.

    Parameters
    ----------
    paper : record of `PaperState`  updated
    x_m, y_m, h_m : float64         target point, world frame [m]
    """
    slot = paper.interval_count & (INTERVALS - 1)
    paper.interval_x_m[slot], paper.interval_y_m[slot], paper.interval_h_m[slot] = x_m, y_m, h_m
    paper.interval_n[slot] = 1
    paper.interval_count += 1


@jit_inlined
def add_point(paper, x_m, y_m, h_m, interval_size_m):
    """Average one target point into the current interval, or open new ones.

    Parameters
    ----------
    paper : record of `PaperState`      updated in place
    x_m, y_m, h_m : float64             world frame [m], finite
    interval_size_m : float64           radius [m], > 0

    Returns
    -------
    int64  number of intervals opened (0: averaged into the current one)

    Notes
    -----
    Beyond two radii the way from the current centre to the point was not sampled:
    intervals are opened along it every `interval_size_m`, heights linear between the
    current interval's and the point's, at most a ring full (the last ones). The point
    then lies within the last of them and is averaged into it.
    """
    if paper.interval_count == 0:
        open_interval(paper, x_m, y_m, h_m)
        return 1
    slot = (paper.interval_count - 1) & (INTERVALS - 1)
    cx, cy, ch = paper.interval_x_m[slot], paper.interval_y_m[slot], paper.interval_h_m[slot]
    dx, dy = x_m - cx, y_m - cy
    distance = elementary.hypot(dx, dy)
    opened = 0
    if distance > 2.0 * interval_size_m:
        steps = distance / interval_size_m
        last = int(min(steps, 1e15))
        first = max(1, last - INTERVALS + 1)
        for k in range(first, last + 1):
            part = k / steps
            open_interval(paper, cx + dx * part, cy + dy * part, ch + (h_m - ch) * part)
        opened = last - first + 1
    elif distance > interval_size_m:
        open_interval(paper, x_m, y_m, h_m)
        return 1
    slot = (paper.interval_count - 1) & (INTERVALS - 1)
    n = paper.interval_n[slot]
    paper.interval_h_m[slot] = (paper.interval_h_m[slot] * n + h_m) / (n + 1)
    paper.interval_n[slot] = n + 1
    return opened


@jit_inlined
def cut_ranges(paper, range_size):
    """Re-cut the two newest ranges after an interval was opened; nothing until both are full.

    Notes
    -----
    The run between them is the mean distance along the path from an interval of the previous range to
    its counterpart in the current one. A chord would vanish in a U-turn and make the slope grow without
    limit; along the path a slope is never steeper than the ground between the intervals.
    """
    paper.range_cut, first = range_size, paper.interval_count - 2 * range_size
    if first < 0:
        return
    rest, prev, run = 0.0, 0.0, 0.0
    for k in range(2 * range_size - 1):
        a, b = (first + k) & (INTERVALS - 1), (first + k + 1) & (INTERVALS - 1)
        if k < range_size:
            prev += paper.interval_h_m[a]
        else:
            rest += paper.interval_h_m[a]
        dx, dy = paper.interval_x_m[b] - paper.interval_x_m[a], paper.interval_y_m[b] - paper.interval_y_m[a]
        # this piece lies between so many pairs of counterparts
        run += min(k + 1, 2 * range_size - 1 - k) * elementary.hypot(dx, dy)
    paper.rest_h_m = rest
    paper.range_prev_h_m, paper.range_gap_m = prev / range_size, run / range_size


@jit_inlined
def range_slope(paper, range_size):
    """Φ: two-point linear extrapolation of the two newest ranges; 0 until both are full."""
    count = paper.interval_count
    if count < 2 * range_size or paper.range_gap_m <= 0.0:
        return 0.0
    current = (paper.rest_h_m + paper.interval_h_m[(count - 1) & (INTERVALS - 1)]) / range_size
    return (current - paper.range_prev_h_m) / paper.range_gap_m
