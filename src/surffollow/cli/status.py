"""The command that prints the status of a service."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from typing import Any

import click

from surffollow.cli.clipped_heights import clipped_note
from surffollow.cli.option_types import JSON, SERVICE_NAME, Finite

STARTING = 3  # exit code
SHOWN_STOPS = 4  # of those that latched a stop


@click.command("status")
@click.option("--name", type=SERVICE_NAME, default="surf", show_default=True, help="Name of the service.")
@JSON
@click.option("--audit", is_flag=True, help="Who changed or tried to change what, oldest first.")
@click.option(
    "--wait",
    "wait_s",
    type=Finite(min=0.0),
    default=0.0,
    help="Wait up to so many seconds until it is ready; a killed one may be started again meanwhile.",
)
def status_command(name: str, as_json: bool, audit: bool, wait_s: float) -> None:
    """Say how a service is doing: health, cycles, lateness, clients, map.

    Exit codes: 0 it runs; 1 it does not; 3 it starts, with the state "starting" or "compiling".
    """
    from surffollow.client import observe
    from surffollow.errors import NotRunningError

    starting = _start_within(name, wait_s)
    if starting is not None:
        if as_json:
            print(json.dumps(starting, indent=2))
        else:
            progress = starting["main"]["text"] or "its objects are being made"
            print(f"service {name}: {starting['state']}, pid {starting['pid']}\nnote     {progress}")
        sys.exit(STARTING)
    with observe(name) as watcher:
        status = watcher.status()
        with contextlib.suppress(NotRunningError):  # nothing is in force there any more
            status["params"] = watcher.params()
        if audit:
            status["audit"] = watcher.audit()
    if as_json:
        from surffollow.shm.layout_json import identity

        status["layout"] = identity()
        print(json.dumps(status, indent=2, allow_nan=False, default=str))
    elif audit:
        print("\n".join(audit_lines(status)))
    else:
        print(render(status))
    if not status["alive"]:
        sys.exit(1)


def _start_within(name: str, wait_s: float) -> dict[str, Any] | None:
    """The status of a service that still starts after so long [s]; None: it is ready, or it ended.

    A board that a killed service left is no end of the waiting: its supervisor starts the next one.
    """
    from surffollow.client.start_wait import start_report
    from surffollow.config.trusted_users import trusted_owners
    from surffollow.errors import NotRunningError

    end = time.monotonic() + wait_s
    while True:
        late = time.monotonic() >= end
        try:
            report = start_report(name, trusted_owners())
            if late or (report is None and _is_alive(name)):
                return report
        except NotRunningError:
            if late:
                raise
        time.sleep(0.05)


def _is_alive(name: str) -> bool:
    """Whether a service is ready, its process runs, and it publishes; waits for nothing."""
    from surffollow.client import observe
    from surffollow.client.board import Board
    from surffollow.config.trusted_users import trusted_owners
    from surffollow.errors import BlockError, NoPermissionError

    try:
        board = Board(name, ready_timeout_s=0.0, owners=trusted_owners())
    except NoPermissionError:
        raise
    except BlockError:  # not ready, or of another release: the next one may be
        return False
    ended = board.has_ended()
    board.close()
    if ended:
        return False
    with observe(name) as watcher:
        return bool(watcher.status()["alive"])


def audit_lines(status: dict[str, Any]) -> list[str]:
    """The audit trail as text, with local times."""
    from datetime import datetime, timedelta

    from surffollow.client.audit import audit_line

    now = datetime.now()
    lost = int(status["main"].get("audit_lost", 0))
    lines = [
        f"{now - timedelta(seconds=e['age_s']):%Y-%m-%d %H:%M:%S.%f}"[:-3] + " " + audit_line(e)[7:]
        for e in status["audit"]
    ]
    return (lines or ["no change was requested"]) + ([f"{lost} entries were lost"] if lost else [])


def stop_lines(status: dict[str, Any]) -> list[str]:
    """The latched stop as text: its causes and its reset, then since when and why, with local times."""
    from datetime import datetime, timedelta

    lines = [
        f"STOPPED  {', '.join(status['stopped'])}; until the pose's holder resets it (reset_stop(), in C "
        "sf_stop_reset, surffollow simulate --reset-stop)"
    ]
    now = datetime.now()
    for e in status["stopped_by"][:SHOWN_STOPS]:
        since = now - timedelta(seconds=e["age_s"])
        who = f" by {e['client'] or '-'}, pid {e['pid']}" if e["slot"] >= 0 else ""
        why = f": {e['reason']}" if e["reason"] else ""
        lines.append(f"         since {since:%Y-%m-%d %H:%M:%S} {', '.join(e['causes'])}{who}{why}")
    return lines


def durations(summary: dict[str, float]) -> str:
    """p50, p99 and maximum of a histogram, as text."""
    from surffollow.units import format_ns

    return ", ".join(f"{k} {format_ns(summary[k + '_ns'])}" for k in ("p50", "p99", "max"))


def follower_lines(f: dict[str, Any], unit: tuple[float, str]) -> list[str]:
    """Estimates of the follower, as text; lengths in a unit (`length_unit`)."""
    if "health" not in f:
        return [f"follower {f['mode']}"]

    def length(name: str) -> str:
        return "-" if f[name] is None else length_text(f[name], unit)

    why = f" ({f['reason']})" if f.get("reason") else ""
    if f["tau_s"] == 0.0:  # the follower had no pose yet: nothing is estimated
        return [f"follower {f['mode']}, {f['health']}{why}"]
    return [
        f"follower {f['mode']}, {f['health']}{why}; noise {length('noise_m')}, "
        f"roughness {length('roughness_m')}, height σ {length('sigma_m')}",
        f"         latency {1e3 * f['latency_s']:.1f} ms, axis τ {1e3 * f['tau_s']:.0f} ms, "
        f"Permitted_Variance {length('permitted_variance_m')}, "
        f"Range_Size {f['range_size']} × {length('interval_size_m')}",
    ]


def length_text(length_m: float, unit: tuple[float, str], digits: int = 3) -> str:
    """A length [m] in a unit of `length_unit`."""
    return f"{unit[0] * length_m:.{digits}g} {unit[1]}"


def map_text(name: str, m: dict[str, Any], unit: tuple[float, str]) -> str:
    """State and counters of the map as text; with the remedy where there is no map.

    Parameters
    ----------
    name : of the service
    m : `status()["map"]`
    unit : of lengths (`length_unit`)
    """
    queue = f"{m.get('queued', 0)} waiting, {m.get('lost', 0)} lost"
    if m.get("state") == "no_map":
        return (
            f"none ({m.get('applied', 0)} samples dropped; a client's map_reset lays one, or "
            f"surffollow map reset X_MIN Y_MIN X_MAX Y_MAX --name {name})"
        )
    if "state" not in m:
        return f"cannot be read; {queue}"
    return (
        f"{m['state']}, {m['nx']} × {m['ny']} grids of {length_text(m['grid_m'], unit)}; "
        f"{m['taken']} samples taken, {m['outside']} outside, {queue}"
    )


def silent_text(s: dict[str, Any]) -> str:
    """Why a service that publishes nothing does not, as far as its process shows, and the remedy."""
    if s["process_runs"]:
        return (
            f", its process stands still: kill -CONT {s['pid']} where it was stopped; otherwise "
            f"kill -9 {s['pid']}, and start it anew"
        )
    return f", its process has ended: surffollow start --name {s['name']}"


def render(s: dict[str, Any]) -> str:
    """The status as a few lines of text."""
    from surffollow.shm.bit_names import GRANT_NAMES
    from surffollow.units import format_ns, length_unit

    # without parameters in force the scale is not known
    unit = length_unit(s["params"]["offset_m"] if "params" in s else 0.0)
    late, run, main = s["lateness"], s["execution"], s["main"]
    granted = [n for i, n in enumerate(GRANT_NAMES) if main.get("granted", 0) >> i & 1]
    pose = f"pid {main['pose_pid']}" if main.get("pose_slot", -1) >= 0 else "no client"
    map_line = f"map      {map_text(s['name'], s['map'], unit)}"
    lines = [
        f"service {s['name']}: {s['state']}, pid {s['pid']}, epoch {s['epoch']}",
        f"cycle    {format_ns(s['period_ns'])}, {s['cycles']} run, {s['overruns']} overruns",
        f"lateness {durations(late)} (from a cycle's deadline to its start; 1-20 ns: it was spinning)",
        f"work     {durations(run)} (from its start to the published demand)",
        f"demand   {'|'.join(s['demand_status']) or 'none'}, age {format_ns(s['age_ns'])}",
        f"poses    {s['poses']} taken, {s['poses_refused']} refused; sent by {pose}",
        f"clients  {main.get('clients', 0)}; requests {s['requests']}, refused {s['requests_refused']}",
        map_line,
        f"granted  {', '.join(granted) or 'nothing'}",
    ]
    if not s["alive"]:
        lines[0] += f"{silent_text(s)}; the lines below are what it published last"
    # behind the line of clients, and behind that of poses
    lines[7:7] = [
        f"         slot {c['slot']}: {c['name']}, pid {c['pid']}, user {c['uid']}" for c in s["clients"]
    ]
    if s["conversions_refused"]:
        text = f"driver   {s['conversions']} conversions taken, {s['conversions_refused']} refused"
        lines.insert(6, f"{text}, {s['conversions_skipped']} left out")
    pushers = [f"{c} by pid {p}" for c, p in enumerate(main.get("range_pid", ())) if p]
    if pushers or s["ranges"]:
        lines.insert(
            6,
            f"ranges   {s['ranges']} taken, {s['ranges_refused']} refused, {s['ranges_skipped']} left out; "
            f"channel {', '.join(pushers) or 'pushed by no client'}",
        )
    clipped = clipped_note(*(s["map"].get(n, 0) for n in ("clipped", "datum_m", "quantum_m")))
    if clipped:
        lines.insert(lines.index(map_line) + 1, f"         {clipped}")
    if "params" in s:
        lines.insert(5, f"standoff {length_text(s['params']['offset_m'], unit, 6)}")
    lines[5:5] = follower_lines(s["follower"], unit)
    if s["stopped"]:
        lines += stop_lines(s)
    if s["faults"]:
        lines.append("faults   " + ", ".join(f"{f['number']} {f['name']}" for f in s["faults"]))
    if main.get("text"):
        lines.append(f"note     {main['text']}")
    return "\n".join(lines)
