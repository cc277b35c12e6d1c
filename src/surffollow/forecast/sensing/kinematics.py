"""Velocity of the tool, and jumps of its reported position."""

from surffollow.forecast import elementary, quantities
from surffollow.forecast.pose import newest_until
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_sensing import JUMP_ASIDE, JUMP_SEEN, JUMP_UP
from surffollow.shm.layout_follow import POSES

# ground that moves changes at least as quickly as other ground does under a tool of this speed
GROUND_SPEED_MPS = 0.1
CLIMB_WINDOW_NS = 30_000_000  # shorter for the vertical velocity, which changes sooner
MIN_DIRECTION_SPEED_MPS = 0.005  # below, the direction of travel is too uncertain to extrapolate along it


@jit
def velocity_between(sense, first, last):
    """Mean velocity between two pose reports [m/s], and the time between them [s]; 0 for one report.

    Parameters
    ----------
    sense : record of `SenseState`
    first, last : int  sequence numbers of the reports, from 0

    Returns
    -------
    4 × float64
    """
    a, b = first & (POSES - 1), last & (POSES - 1)
    dt = (sense.pose_t_ns[b] - sense.pose_t_ns[a]) * 1e-9
    if not dt > 0.0:
        return 0.0, 0.0, 0.0, 0.0
    way_x, way_y = sense.pose[7 * b] - sense.pose[7 * a], sense.pose[7 * b + 1] - sense.pose[7 * a + 1]
    return way_x / dt, way_y / dt, (sense.pose[7 * b + 2] - sense.pose[7 * a + 2]) / dt, dt


@jit
def velocity_over(kinematics, sense, last, window_ns):
    """Mean velocity up to report `last` over a window, or a little longer, as `velocity_between`.

    Reports from before the newest jump, or from before a long gap, do not count.
    """
    t = sense.pose_t_ns[last & (POSES - 1)]
    k = newest_until(sense.pose_t_ns, sense.pose_count, max(t - window_ns, kinematics.jump_ns))
    first = k + 1 if t - sense.pose_t_ns[k & (POSES - 1)] > quantities.LONG_GAP_NS else k
    return velocity_between(sense, first, last)


@jit
def note_jump(params, kinematics, sense, last):
    """Note a jump of the reported position with report `last`; whether there is one.

    A lateral jump disagrees with the velocity and with the way between the two reports before: a change of
    speed agrees with the latter from its second report on. A vertical jump disagrees with the velocity by
    more than the axis can change its way in that time, 2 · v_max · Δt. Both are outliers among the usual
    disagreements: noise of the reports, and of their timestamps, is no jump.
    """
    slot = last & (POSES - 1)
    t_ns, height_m = sense.pose_t_ns[slot], sense.pose[7 * slot + 2]
    vx, vy, _, dt = velocity_between(sense, last - 1, last)
    if not 0.0 < dt <= quantities.LONG_GAP_NS * 1e-9:
        return False
    up = abs(height_m - coast_height(kinematics, sense, last - 1, t_ns))
    scatter_m = params.gate_scales * kinematics.climb_scatter_m
    most_up = max(quantities.APART_M, 2.0 * params.plant_v_max_mps * dt, scatter_m)
    kinematics.climb_scatter_m = quantities.follow_usual(kinematics.climb_scatter_m, min(up, most_up))
    if dt > quantities.PAUSE_NS * 1e-9:
        return False
    aside = elementary.hypot(vx - kinematics.velocity_x_mps, vy - kinematics.velocity_y_mps) * dt
    if last > 1:
        before_x, before_y, _, before_s = velocity_between(sense, last - 2, last - 1)
        if 0.0 < before_s <= quantities.PAUSE_NS * 1e-9:
            aside = min(aside, elementary.hypot(vx - before_x, vy - before_y) * dt)
    most_aside = max(0.02, params.gate_scales * kinematics.noise_m)  # 20 mm aside are no jump
    # from 0: a first report that starts or stops the tool is no noise
    kinematics.noise_m += (min(aside, most_aside) - kinematics.noise_m) / quantities.USUAL_SAMPLES
    climbed = up > most_up
    if not climbed and aside <= most_aside:
        return False
    kinematics.jump_ns = t_ns
    kinematics.jump = max(kinematics.jump, JUMP_UP if climbed else JUMP_ASIDE)
    return True


@jit
def note_accepted(kinematics, t_ns):
    """Note an accepted sample: one from behind the newest jump is in the frame of the poses."""
    if t_ns >= kinematics.jump_ns:
        kinematics.jump = JUMP_SEEN


@jit
def is_other_frame(kinematics, t_ns):
    """Whether heights at a time are in another frame than those of the samples accepted so far."""
    return kinematics.jump == JUMP_UP and t_ns >= kinematics.jump_ns


@jit
def spans_jump(kinematics):
    """Whether the reported position has jumped since the last accepted sample: that is in another frame."""
    return kinematics.jump != JUMP_SEEN


@jit
def has_jumped(adaptive):
    """Whether the reported position has jumped within the last second."""
    jump_ns = adaptive.kinematics.jump_ns
    return jump_ns != 0 and 0 <= adaptive.clock.now_ns - jump_ns < quantities.LONG_GAP_NS


@jit
def coast_height(kinematics, sense, report, t_ns):
    """Height of the tool at a time behind a report, at constant velocity [m]; behind MAX_GAP_NS it stays.

    Parameters
    ----------
    kinematics, sense : records of `Kinematics`, `SenseState`
    report : int  sequence number of the report, from 0; before the first: that one
    t_ns : int64  the time
    """
    slot = max(report, 0) & (POSES - 1)
    late_ns = min(max(t_ns - sense.pose_t_ns[slot], 0), quantities.MAX_GAP_NS)
    return sense.pose[7 * slot + 2] + kinematics.climb_mps * late_ns * 1e-9


@jit
def travel_velocity(kinematics, sense, last):
    """Lateral velocity up to report `last` [m/s]: over 100 ms, or 300 ms where noise hides the shorter way.

    The longer mean decides on that: the shorter one would be taken where noise makes it too great. It is 0
    where the longer way, too, is hardly more than noise, and where it is so much longer that the tool has
    just stopped.
    """
    noise_m = 3.0 * kinematics.noise_m  # a way that is as long is noise by chance in 1 of 100
    short_x, short_y, _, short_s = velocity_over(kinematics, sense, last, quantities.PAUSE_NS)
    short_m = elementary.hypot(short_x, short_y) * short_s
    if short_m >= 2.0 * noise_m:
        return short_x, short_y
    long_x, long_y, _, long_s = velocity_over(kinematics, sense, last, 3 * quantities.PAUSE_NS)
    long_mps = elementary.hypot(long_x, long_y)
    expected_m = long_mps * short_s  # of the shorter way, if the speed is steady
    if expected_m >= noise_m and short_m >= 0.5 * noise_m:
        return short_x, short_y
    # it starts with twice the way with which it stops
    least_m = 2.0 * noise_m if is_at_rest(kinematics) else noise_m
    if long_mps * long_s < least_m or expected_m > 2.0 * noise_m:
        return 0.0, 0.0
    return long_x, long_y


@jit
def update_kinematics(params, kinematics, sense):
    """Lateral and vertical velocity of the tool with all new reports; returns whether it jumped.

    Parameters
    ----------
    params, kinematics, sense : records of `Params`, `Kinematics` (updated), `SenseState`
    """
    newest, begins, jumped = sense.pose_count - 1, kinematics.reports == 0, False
    first = newest if begins else min(max(kinematics.reports, newest - POSES + 3), newest)  # two before it
    for k in range(first, newest + 1):
        if not begins and note_jump(params, kinematics, sense, k):
            jumped = True
        else:
            update_velocity(kinematics, sense, k)
    kinematics.reports = sense.pose_count
    return jumped


@jit
def update_velocity(kinematics, sense, last):
    """Lateral and vertical velocity of the tool with report `last`; at a jump it stays that before."""
    vx, vy = travel_velocity(kinematics, sense, last)
    # it starts at twice the speed at which it stops: the path does not change again and again
    least_mps = MIN_DIRECTION_SPEED_MPS * (1.0 if is_at_rest(kinematics) else 0.5)
    kinematics.speed_mps = elementary.hypot(vx, vy)
    if kinematics.speed_mps < least_mps:
        kinematics.speed_mps = vx = vy = 0.0
    kinematics.velocity_x_mps, kinematics.velocity_y_mps = vx, vy
    _, _, kinematics.climb_mps, _ = velocity_over(kinematics, sense, last, CLIMB_WINDOW_NS)


@jit
def is_at_rest(kinematics):
    """Whether the tool has no direction of travel."""
    return kinematics.speed_mps == 0.0


@jit
def path_speed(kinematics):
    """Speed along the path of the models [m/s]: at rest the ground may move, and its path is time."""
    return GROUND_SPEED_MPS if is_at_rest(kinematics) else kinematics.speed_mps


@jit
def distance_along(kinematics, x_m, y_m):
    """Component of a horizontal vector along the direction of travel [m]; the tool must move."""
    return (x_m * kinematics.velocity_x_mps + y_m * kinematics.velocity_y_mps) / kinematics.speed_mps
