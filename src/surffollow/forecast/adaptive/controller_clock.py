"""The controller's clock: when a demand is latched.

A plan is made for the moment at which its demand is latched. In process that is the step. A service sees only
pose reports; a controller latches a demand and reports its pose in one cycle. Where reports come 100 times a
second, the next one tells when the demand is latched, and the demand published before it is the one latched.
"""

from __future__ import annotations

from typing import Any

from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive_estimation import N_PERIODS

DEFAULT_PERIOD_NS = 9_999_000  # 100 Hz; a microsecond less, stamps may be rounded
PREPARATION_NS = (
    8_900_000  # before the next report: the set point, limited in jerk, wants 7 ms for 5 mm, 12 for 20
)
LATCH_DELAY_NS = 500_000  # before the cycle that sees the report, on average
MIN_PERIOD_NS, MAX_PERIOD_NS = 6_000_000, 14_000_000  # between two ticks, while they are led by reports
PERIOD_TOLERANCE_NS = (
    1_000_000  # intervals of reports that far from 10 ms on average are no controller's ticks
)
REPORT_TIMEOUT_NS = 50_000_000  # without a report for so long the rhythm is lost
PERIOD_RATE = 0.1


@jit
def is_synchronised(controller: Any, given: Any, now_ns: Any) -> Any:
    """Whether reports come like a controller's ticks, and distances do not come ready-made (`given` > 0)."""
    steady = abs(controller.interval_ns - 10e6) < PERIOD_TOLERANCE_NS
    return given <= 0 and steady and 0 <= now_ns - controller.report_ns < REPORT_TIMEOUT_NS


@jit
def period_is_due(controller: Any, given: Any, now_ns: Any) -> Any:
    """1 when it is time to prepare what the controller takes next.

    Parameters
    ----------
    a : record of `AdaptiveState`
    given : int              > 0: distances come ready-made, the caller takes each answer himself
    now_ns : int64
    """
    since_tick = now_ns - controller.period_ns
    if not is_synchronised(controller, given, now_ns):
        return 1 if since_tick >= DEFAULT_PERIOD_NS else 0
    left = latch_time(controller, given, now_ns) - now_ns
    return (
        1
        if since_tick >= MAX_PERIOD_NS
        or (controller.latch_pending == 0 and left <= PREPARATION_NS and since_tick >= MIN_PERIOD_NS)
        else 0
    )


@jit
def latch_time(controller: Any, given: Any, now_ns: Any) -> Any:
    """When the controller will take its next demand [ns]."""
    if not is_synchronised(controller, given, now_ns):
        return now_ns
    period = int(controller.interval_ns)
    since = now_ns - controller.report_ns + LATCH_DELAY_NS
    return now_ns + period - since % period


@jit
def open_period(controller: Any, given: Any, now_ns: Any) -> None:
    """Move the tick that `note_targets` closed to when its demand will be taken; until then it may change."""
    controller.latch_ns[(controller.periods - 1) & (N_PERIODS - 1)] = latch_time(controller, given, now_ns)
    controller.latch_pending = 1 if is_synchronised(controller, given, now_ns) else 0


@jit
def observe_report(controller: Any, poses: Any, now_ns: Any) -> None:
    """Learn the rhythm of pose reports from their arrival (`poses` counts them); the open tick is over."""
    if poses == controller.report_count:
        return
    dt = now_ns - controller.report_ns
    if 0 < dt < REPORT_TIMEOUT_NS:
        controller.interval_ns += PERIOD_RATE * (dt - controller.interval_ns)
    controller.report_ns, controller.report_count = now_ns, poses
    if controller.latch_pending != 0:
        controller.latch_ns[(controller.periods - 1) & (N_PERIODS - 1)] = now_ns - LATCH_DELAY_NS
        controller.latch_pending = 0


@jit
def begin_period(controller: Any, now_ns: Any) -> None:
    """Begin a controller period now."""
    controller.latch_ns[controller.periods & (N_PERIODS - 1)] = now_ns
    controller.periods += 1
    controller.period_ns = now_ns


@jit
def reset_controller(controller: Any) -> None:
    """Discard all periods and the arrival of reports: the clock jumped."""
    controller.period_ns = controller.report_ns = 0
    controller.periods = controller.latch_pending = 0  # set points of future periods would never be latched
