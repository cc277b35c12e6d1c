"""The controller's clock: when a demand is latched.

A plan is made for the moment at which its demand is latched. In process that is the step. A service sees only
pose reports; a controller latches a demand and reports its pose in one cycle. Where reports come 100 times a
second, the next one tells when the demand is latched, and the demand published before it is the one latched.
"""

from surffollow.forecast.plant.axis_model import PERIOD_S
from surffollow.forecast.quantities import MAX_GAP_NS
from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_estimation import N_PERIODS

LATCH_DELAY_NS = 500_000  # latch time before the cycle that sees the report, on average
PERIOD_TOLERANCE_NS = 1_000_000  # of the mean interval of reports from `PERIOD_S`


@jit
def is_synchronised(controller, ranges_given, now_ns):
    """Whether pose reports arrive once per controller period.

    With `ranges_given` > 0 the caller latches each answer himself; then reports are not used.
    """
    steady = abs(controller.interval_ns - PERIOD_S * 1e9) < PERIOD_TOLERANCE_NS
    return ranges_given <= 0 and steady and 0 <= now_ns - controller.report_ns < MAX_GAP_NS


@jit
def period_is_due(controller, call_s, ranges_given, now_ns):
    """Whether the demand of the next controller period has to be prepared.

    Parameters
    ----------
    controller : record of `Controller`
    call_s : float64         usual interval of the calls [s]: callers are not punctual; 0: no plan needs it
    ranges_given : int       > 0: ranges are given to the step, the caller latches each answer himself
    now_ns : int64
    """
    elapsed = now_ns - controller.period_ns
    if not is_synchronised(controller, ranges_given, now_ns):
        period_ns = 9_999_000  # 100 Hz; a microsecond less, timestamps may be rounded
        return elapsed >= period_ns - min(0.1 * period_ns, 0.25 * call_s * 1e9)
    # the jerk-limited setpoint needs 7 ms for 5 mm and 12 ms for 20 mm; periods last 6 to 14 ms
    left = latch_time(controller, ranges_given, now_ns) - now_ns
    prepares = controller.latch_pending == 0 and left <= 8_900_000 and elapsed >= 6_000_000
    return prepares or elapsed >= 14_000_000


@jit
def latch_time(controller, ranges_given, now_ns):
    """Time at which the controller latches its next demand [ns]."""
    if not is_synchronised(controller, ranges_given, now_ns):
        return now_ns
    period = int(controller.interval_ns)
    elapsed = now_ns - controller.report_ns + LATCH_DELAY_NS
    return now_ns + period - elapsed % period


@jit
def mean_wait_s(params, controller):
    """Mean time from a demand to its effect: half a controller period, `max_wait_s` at most [s].

    A controller reports its pose once per period.
    """
    if controller.interval_ns <= 0.0:
        return params.max_wait_s
    return min(params.max_wait_s, 0.5e-9 * controller.interval_ns)


@jit
def open_period(controller, ranges_given, now_ns):
    """Set the latch time of the period that has just begun; until then its demand may change."""
    slot = (controller.periods - 1) & (N_PERIODS - 1)
    controller.latch_ns[slot] = latch_time(controller, ranges_given, now_ns)
    controller.latch_pending = 1 if is_synchronised(controller, ranges_given, now_ns) else 0


@jit
def usual_interval(usual_ns, dt_ns):
    """Usual interval after one more [ns]: a mean over some ten, at first the first one, without gaps."""
    if not 0 < dt_ns < MAX_GAP_NS:
        return usual_ns
    return usual_ns + (0.1 if usual_ns > 0.0 else 1.0) * (dt_ns - usual_ns)


@jit
def observe_report(controller, poses, now_ns):
    """Update the period with the arrival of a pose report, which ends a pending latch.

    `poses` counts the reports.
    """
    if poses == controller.report_count:
        return
    controller.interval_ns = usual_interval(controller.interval_ns, now_ns - controller.report_ns)
    controller.report_ns, controller.report_count = now_ns, poses
    if controller.latch_pending != 0:
        controller.latch_ns[(controller.periods - 1) & (N_PERIODS - 1)] = now_ns - LATCH_DELAY_NS
        controller.latch_pending = 0


@jit
def begin_period(controller, now_ns):
    """Begin a controller period now, and update the usual period."""
    controller.usual_ns = usual_interval(controller.usual_ns, now_ns - controller.period_ns)
    controller.periods += 1
    controller.period_ns = now_ns


@jit
def period_at(controller, t_ns):
    """Number of the newest period that is latched at a time; the oldest one in the rings if none is."""
    k, oldest = controller.periods - 1, max(0, controller.periods - N_PERIODS)
    while k > oldest and controller.latch_ns[k & (N_PERIODS - 1)] > t_ns:
        k -= 1
    return k


@jit
def share_of_next(controller, k, t_ns, newest_ns):
    """Share by which the setpoint at a time lies between that of period `k` and the next one, 0 to 1.

    A controller whose reports come more often than the periods of a plan takes setpoints between them. It
    holds each until its next report: half of that interval later on average.

    Parameters
    ----------
    controller : record of `Controller`
    k : int             period in force at that time
    t_ns : int64
    newest_ns : int64   time of the newest setpoint, which is next to the newest period
    """
    if not 0.0 < controller.interval_ns < PERIOD_S * 1e9 - PERIOD_TOLERANCE_NS:
        return 0.0
    begin_ns, end_ns = controller.latch_ns[k & (N_PERIODS - 1)], newest_ns
    if k < controller.periods - 1:
        end_ns = controller.latch_ns[(k + 1) & (N_PERIODS - 1)]
    if end_ns <= begin_ns:
        return 0.0
    return min(max((t_ns - 0.5 * controller.interval_ns - begin_ns) / (end_ns - begin_ns), 0.0), 1.0)


@jit
def usual_periods(controller):
    """Usual length of a controller period, in those of a plan, 1 to 3: plans are too short for more.

    A demand is kept for so long: a controller of 125 Hz takes every second one, and others are not punctual.
    """
    return min(max(controller.usual_ns / (PERIOD_S * 1e9), 1.0), 3.0)
