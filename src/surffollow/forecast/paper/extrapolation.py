"""The paper's forecast: slope, extrapolation, hysteresis (§3.2.4), on top of intervals and ranges."""

from surffollow.forecast import elementary
from surffollow.forecast.paper.intervals import add_point, cut_ranges, range_slope
from surffollow.forecast.pose import newest_pose
from surffollow.shm.jit import jit_inlined
from surffollow.shm.layout_follow import POINTS, POSES


@jit_inlined
def average_point(params, paper, sense, channel, pose_t_ns, point):
    """Average the channel's last `ee_readings` target points since its last loss (§3.2.1).

    Parameters
    ----------
    params, paper, sense : records of `Params`, `PaperState` (updated), `SenseState`
    channel : int
    pose_t_ns : int64        stamp of the pose that the footprint was made with
    point : (3,) float64     the footprint [m]; replaced by what is mapped: the mean, or the footprint
                             itself where no footprint in the mean lies within Interval_Size of it

    Notes
    -----
    The mean of channel 0, which the forecast takes in any case, is in `paper.mean_m`. After a loss of
    channel 0 speed and ΔH begin anew, too: neither spans it.
    """
    if paper.point_losses[channel] != sense.losses[channel]:
        paper.point_losses[channel], paper.point_count[channel] = sense.losses[channel], 0
        if channel == 0:
            paper.speed_pose = paper.reading_t_ns = 0
    n, base = paper.point_count[channel], channel * POINTS * 3
    slot = base + (n & (POINTS - 1)) * 3
    for i in range(3):
        paper.point_m[slot + i] = point[i]
    paper.point_count[channel] = n + 1
    used = min(n + 1, params.ee_readings)
    x, y, z = point[0], point[1], point[2]
    if used > 1:
        x, y, z = 0.0, 0.0, 0.0
        for k in range(n + 1 - used, n + 1):
            slot = base + (k & (POINTS - 1)) * 3
            x += paper.point_m[slot]
            y += paper.point_m[slot + 1]
            z += paper.point_m[slot + 2]
        x, y, z = x / used, y / used, z / used
    if channel == 0:
        paper.point_t_ns[n & (POINTS - 1)] = pose_t_ns
        paper.mean_m[0], paper.mean_m[1], paper.mean_m[2] = x, y, z
    reach2 = params.interval_size_m * params.interval_size_m
    for k in range(n, n - used, -1):
        slot = base + (k & (POINTS - 1)) * 3
        dx, dy = x - paper.point_m[slot], y - paper.point_m[slot + 1]
        if dx * dx + dy * dy <= reach2:
            point[0], point[1], point[2] = x, y, z
            return


@jit_inlined
def measure_speed(params, paper, sense):
    """Lateral speed of the footprint, between the mean target points at successive pose updates.

    The time between two means is that between the mean stamps of the poses they were made with: while
    the mean's window fills, and where readings are missing in it, the points alone do not move evenly.
    """
    if sense.pose_count == paper.speed_pose:
        return
    n = paper.point_count[0]
    used = min(n, params.ee_readings)
    newest_ns = paper.point_t_ns[(n - 1) & (POINTS - 1)]
    older_ns = 0
    for k in range(n - used, n):
        older_ns += newest_ns - paper.point_t_ns[k & (POINTS - 1)]
    t_ns = newest_ns - older_ns // used
    x_m, y_m = paper.mean_m[0], paper.mean_m[1]
    if paper.speed_pose > 0 and t_ns > paper.speed_t_ns:
        dx, dy = x_m - paper.speed_x_m, y_m - paper.speed_y_m
        paper.speed_mps = elementary.hypot(dx, dy) / ((t_ns - paper.speed_t_ns) * 1e-9)
    paper.speed_x_m, paper.speed_y_m, paper.speed_t_ns = x_m, y_m, t_ns
    paper.speed_pose = sense.pose_count


@jit_inlined
def paper_update(params, paper, sense):
    """Take a new averaged target point of channel 0 into intervals, ranges, slope and speed."""
    mean = paper.mean_m
    opened = add_point(paper, mean[0], mean[1], mean[2], params.interval_size_m)
    if opened > 0 or paper.range_cut != params.range_size:
        cut_ranges(paper, params.range_size)
    paper.slope = range_slope(paper, params.range_size)
    measure_speed(params, paper, sense)


@jit_inlined
def note_place(paper, sense):
    """Where the newest pose is when a reading counts, and the one before: they tell the heading."""
    slot, previous = 7 * newest_pose(sense), 7 * ((sense.pose_count - 2) & (POSES - 1))
    paper.reading_x_m, paper.reading_y_m = sense.pose[slot], sense.pose[slot + 1]
    paper.before_x_m, paper.before_y_m = paper.reading_x_m, paper.reading_y_m
    if sense.pose_count > 1:
        paper.before_x_m, paper.before_y_m = sense.pose[previous], sense.pose[previous + 1]


@jit_inlined
def distance_since_reading(params, paper, sense, t_ns):
    """Distance along the heading since the last reading, from the poses, plus one Interval_Size [m].

    The newest pose is extrapolated to `t_ns` by the last speed. Negative when the tool went back farther.

    Parameters
    ----------
    params, paper, sense : records of `Params`, `PaperState`, `SenseState`
    t_ns : int64  the cycle's time
    """
    slot = newest_pose(sense)
    dx, dy = sense.pose[7 * slot] - paper.reading_x_m, sense.pose[7 * slot + 1] - paper.reading_y_m
    ux, uy = paper.reading_x_m - paper.before_x_m, paper.reading_y_m - paper.before_y_m
    heading_m = elementary.hypot(ux, uy)
    along_m = (dx * ux + dy * uy) / heading_m if heading_m > 0.0 else 0.0
    return along_m + paper.speed_mps * ((t_ns - sense.pose_t_ns[slot]) * 1e-9) + params.interval_size_m


@jit_inlined
def paper_forecast(params, paper, sense, t_ns, fresh, reading_z_m, sensor_z_m, max_distance_m):
    """ΔH since the previous reading, and desired minus previous actual stand-off.

    The previous stand-off is carried on by the tool's own vertical motion since. A fresh reading becomes
    the previous one for what follows; it counts at once where there is none before it since the last
    loss, or none younger than `loss_timeout_ns`.

    Parameters
    ----------
    params, paper, sense : records of `Params`, `PaperState` (updated), `SenseState`
    t_ns : int64                       the cycle's time
    fresh : int                        1: channel 0 has a new reading
    reading_z_m, sensor_z_m : float64  the sensor's height in the pose of that, and in the newest pose [m]
    max_distance_m : float64           the tool has gone no farther since the previous reading; inf: not known

    Returns
    -------
    delta_h_m, error_m : float64       their sum is the demand before limits and hysteresis
    """
    range_m = sense.range_m[0]
    if fresh == 0 and paper.reading_t_ns == 0:
        return 0.0, 0.0
    first = paper.reading_t_ns == 0 or t_ns - paper.reading_t_ns > params.loss_timeout_ns
    if fresh != 0 and first:
        paper.reading_t_ns, paper.reading_m, paper.reading_z_m = t_ns, range_m, reading_z_m
    since_s = (t_ns - paper.reading_t_ns) * 1e-9
    delta_h = paper.slope * paper.speed_mps * since_s
    if paper.speed_mps * since_s > max_distance_m:
        delta_h = paper.slope * max_distance_m
    error = params.offset_m - (paper.reading_m + (sensor_z_m - paper.reading_z_m))
    if fresh != 0:
        paper.reading_t_ns, paper.reading_m, paper.reading_z_m = t_ns, range_m, reading_z_m
        note_place(paper, sense)
    return delta_h, error


@jit_inlined
def relay(paper, demand_m, sensor_z_m, permitted_variance_m):
    """The paper's hysteresis: relay nothing new until the demand changes by more than Permitted_Variance.

    Until then the position demanded last stays: the demand less the tool's own motion since, because a
    demand is added to the newest pose, again in every cycle.

    Parameters
    ----------
    paper : record of `PaperState`     updated
    demand_m : float64                 the new demand [m]
    sensor_z_m : float64               the sensor's height in the newest pose [m]
    permitted_variance_m : float64     [m]

    Returns
    -------
    float64  the demand to relay; never farther than Permitted_Variance from `demand_m`
    """
    if paper.relayed == 0:
        paper.relayed, paper.relayed_m, paper.relayed_z_m = 1, 0.0, sensor_z_m
    kept_m = paper.relayed_m - (sensor_z_m - paper.relayed_z_m)
    if abs(demand_m - kept_m) <= permitted_variance_m:
        return kept_m
    paper.relayed_m, paper.relayed_z_m = demand_m, sensor_z_m
    return demand_m
