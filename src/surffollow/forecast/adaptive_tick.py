"""When the robot's controller takes a demand: its ticks, 100 per second.

A plan is made for the moment at which it is taken. In process the caller's step is that moment. Of a
service nobody tells it, but a controller takes its demand and reports its pose in one go: where reports
come 100 times a second, the next one tells when the demand will be taken, and its arrival what was
taken: the one published before. So the plan is for the robot as it will be then, and the axes of
`adaptive_plant` follow what the robot really got, when it got it.
"""

from __future__ import annotations

from typing import Any

from surffollow.shm.jit import jit
from surffollow.shm.layout_adaptive import TICKS

TICK_NS = 9_999_000  # 100 Hz; a microsecond less, stamps may be rounded
AHEAD_NS = 8_900_000  # before the next report: the set point, limited in jerk, wants 7 ms for 5 mm, 12 for 20
TAKEN_NS = 500_000  # before the cycle that sees the report, on average
LEAST_NS, MOST_NS = 6_000_000, 14_000_000  # between two ticks, while they are led by reports
RHYTHM_NS = 1_000_000  # intervals of reports that far from 10 ms on average are no controller's ticks
LOST_NS = 50_000_000  # without a report for so long the rhythm is lost
RATE = 0.1


@jit
def led_by_reports(a: Any, given: Any, now_ns: Any) -> Any:
    """Whether reports come like a controller's ticks, and distances do not come ready-made (`given` > 0)."""
    steady = abs(a.arrival_dt_ns - 10e6) < RHYTHM_NS
    return given <= 0 and steady and 0 <= now_ns - a.arrival_ns < LOST_NS


@jit
def tick_is_due(a: Any, given: Any, now_ns: Any) -> Any:
    """1 when it is time to prepare what the controller takes next.

    Parameters
    ----------
    a : record of `AdaptiveState`
    given : int              > 0: distances come ready-made, the caller takes each answer himself
    now_ns : int64
    """
    since_tick = now_ns - a.tick_ns
    if not led_by_reports(a, given, now_ns):
        return 1 if since_tick >= TICK_NS else 0
    left = taken_at(a, given, now_ns) - now_ns
    return (
        1
        if since_tick >= MOST_NS or (a.tick_open == 0 and left <= AHEAD_NS and since_tick >= LEAST_NS)
        else 0
    )


@jit
def taken_at(a: Any, given: Any, now_ns: Any) -> Any:
    """When the controller will take its next demand [ns]."""
    if not led_by_reports(a, given, now_ns):
        return now_ns
    period = int(a.arrival_dt_ns)
    since = now_ns - a.arrival_ns + TAKEN_NS
    return now_ns + period - since % period


@jit
def open_tick(a: Any, given: Any, now_ns: Any) -> None:
    """Move the tick that `note_targets` closed to when its demand will be taken; until then it may change."""
    a.tick_t_ns[(a.ticks - 1) & (TICKS - 1)] = taken_at(a, given, now_ns)
    a.tick_open = 1 if led_by_reports(a, given, now_ns) else 0


@jit
def note_arrival(a: Any, poses: Any, now_ns: Any) -> None:
    """Learn the rhythm of pose reports from their arrival (`poses` counts them); the open tick is over."""
    if poses == a.arrival_poses:
        return
    dt = now_ns - a.arrival_ns
    if 0 < dt < LOST_NS:
        a.arrival_dt_ns += RATE * (dt - a.arrival_dt_ns)
    a.arrival_ns, a.arrival_poses = now_ns, poses
    if a.tick_open != 0:
        a.tick_t_ns[(a.ticks - 1) & (TICKS - 1)] = now_ns - TAKEN_NS
        a.tick_open = 0
