"""The paper's forecast: slope, extrapolation, hysteresis (§3.2.4), on top of intervals and ranges."""

from __future__ import annotations

from typing import Any

from surffollow.forecast.intervals import add_point, cut_ranges, range_slope
from surffollow.shm.jit import jit_inlined
from surffollow.shm.layout_follow import POINTS, POSES


@jit_inlined
def average_point(paper: Any, channel: Any, readings: Any, point: Any) -> None:
    """Replace the target point (3,) by the rolling mean of the channel's last `readings` ones."""
    n = paper.point_count[channel]
    base = channel * POINTS * 3
    slot = base + (n & (POINTS - 1)) * 3
    for i in range(3):
        paper.point_m[slot + i] = point[i]
    paper.point_count[channel] = n + 1
    used = min(n + 1, readings)
    if used == 1:
        return
    x, y, z = 0.0, 0.0, 0.0
    for k in range(n + 1 - used, n + 1):
        slot = base + (k & (POINTS - 1)) * 3
        x += paper.point_m[slot]
        y += paper.point_m[slot + 1]
        z += paper.point_m[slot + 2]
    point[0], point[1], point[2] = x / used, y / used, z / used


@jit_inlined
def measure_speed(paper: Any, sense: Any, x_m: Any, y_m: Any) -> None:
    """Lateral speed of the footprint, between the target points at successive pose updates."""
    if sense.pose_count == paper.speed_pose:
        return
    t_ns = sense.pose_t_ns[(sense.pose_count - 1) & (POSES - 1)]
    if paper.speed_pose > 0 and t_ns > paper.speed_t_ns:
        dx, dy = x_m - paper.speed_x_m, y_m - paper.speed_y_m
        paper.speed_mps = (dx * dx + dy * dy) ** 0.5 / ((t_ns - paper.speed_t_ns) * 1e-9)
    paper.speed_x_m, paper.speed_y_m = x_m, y_m
    paper.speed_t_ns = t_ns
    paper.speed_pose = sense.pose_count


@jit_inlined
def paper_update(params: Any, paper: Any, sense: Any, x_m: Any, y_m: Any, h_m: Any) -> None:
    """Take a new averaged target point of channel 0 into intervals, ranges, slope and speed."""
    opened = add_point(paper, x_m, y_m, h_m, params.interval_size_m)
    if opened > 0 or paper.range_cut != params.range_size:
        cut_ranges(paper, params.range_size)
    paper.slope = range_slope(paper, params.range_size)
    measure_speed(paper, sense, x_m, y_m)


@jit_inlined
def paper_forecast(params: Any, paper: Any, t_ns: Any, fresh: Any, range_m: Any, sensor_z_m: Any) -> Any:
    """ΔH, the stand-off error and the vertical demand before limits and hysteresis.

    With a fresh reading ΔH spans the time since the previous one; without, the time since
    the last one, and the last stand-off is carried on by the tool's own vertical motion.

    Returns
    -------
    delta_h_m, error_m : float64
    """
    if paper.reading_t_ns == 0 and fresh == 0:
        return 0.0, 0.0
    elapsed_s = 0.0 if paper.reading_t_ns == 0 else (t_ns - paper.reading_t_ns) * 1e-9
    delta_h = paper.slope * paper.speed_mps * elapsed_s
    if fresh != 0:
        paper.reading_t_ns = t_ns
        paper.reading_m = range_m
        paper.reading_z_m = sensor_z_m
        return delta_h, params.offset_m - range_m
    return delta_h, params.offset_m - (paper.reading_m + sensor_z_m - paper.reading_z_m)


@jit_inlined
def relay(paper: Any, demand_m: Any, permitted_variance_m: Any) -> Any:
    """The paper's hysteresis: the last relayed demand stays until the new one differs by more."""
    if abs(demand_m - paper.relayed_m) > permitted_variance_m:
        paper.relayed_m = demand_m
    return paper.relayed_m
