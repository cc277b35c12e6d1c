"""Status of a service, as one dictionary."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from surffollow.client.demand import STALE, status_names
from surffollow.client.follower_report import follower_report, numbered_faults
from surffollow.client.histogram_report import histogram_summary
from surffollow.client.stop_report import latched_by
from surffollow.config.stop_causes import stop_names
from surffollow.errors import SurffollowError
from surffollow.shm.layout_board import STATE_READY, MainThreadState, MapStatus, Stats
from surffollow.shm.layout_follow import Output, Params

if TYPE_CHECKING:
    from surffollow.client.observer import Observer

STATES = ("initialising", "ready", "stopping", "stopped")


def status_report(observer: Observer) -> dict[str, Any]:
    """State, health, counters, grants and map of the service; see `Observer.status`."""
    demand = observer.dev_vector()
    if demand.status & STALE:  # that look may have followed the service to a new start
        demand = observer.dev_vector()
    output = observer.board.latch("output", Output).read()
    params = observer.board.latch("params", Params).read() or {}
    stats = observer.board.plain("stats", Stats)
    main_thread = observer.board.latch("ticker", MainThreadState).read() or {}
    map_status = observer.board.latch("map_status", MapStatus).read() or {}
    state = observer.board.state()
    stale, stopped = bool(demand.status & STALE), stop_names(int(output["stop"]) if output else 0)
    counters = {k: v for k, v in stats.items() if k not in ("lateness", "execution")}
    return {
        "name": observer.name,
        "state": "stale" if stale and state == STATE_READY else STATES[min(state, 3)],
        "alive": not stale,
        "process_runs": not (stale and observer.board.has_ended()),
        "pid": observer.board.pid,
        "epoch": observer.board.epoch,
        "period_ns": observer.board.period_ns,
        "age_ns": demand.age_ns,
        "demand": list(demand),
        "demand_status": list(status_names(demand.status)),
        **counters,
        "lateness": histogram_summary(stats["lateness"], stats["lateness_max_ns"]),
        "execution": histogram_summary(stats["execution"], stats["execution_max_ns"]),
        "follower": follower_report(output, int(params.get("mode", 0))),
        "faults": numbered_faults(int(output["faults"]) if output else 0, int(main_thread.get("faults", 0))),
        "stopped": list(stopped),
        "stopped_by": latched_by(observer.audit()) if stopped else [],
        "main": main_thread,
        "clients": observer.clients(),
        "map": map_status | _map_facts(observer),
    }


def _map_facts(observer: Observer) -> dict[str, Any]:
    """State and counters of the map; empty where it is gone or may not be read."""
    try:
        return observer.map_facts()
    except SurffollowError:
        return {}
