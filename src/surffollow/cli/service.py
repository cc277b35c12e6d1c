"""`surffollow start`, `stop` and `status`."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import time
from typing import Any

import click

from surffollow.cli.option_types import SERVICE_NAME, Finite


@click.command("start")
@click.option(
    "--config",
    "config_path",
    type=click.Path(dir_okay=False),
    help="TOML file; see docs/reference/configuration.md.",
)
@click.option("--name", type=SERVICE_NAME, help="Name of the service and its shared-memory objects [surf].")
@click.option("--quiet", is_flag=True, help="Print only READY, errors and the audit trail.")
@click.option(
    "--strict", is_flag=True, help="Refuse to start without real-time priority, locked memory, processor."
)
def start_command(config_path: str | None, name: str | None, quiet: bool, strict: bool) -> None:
    """Run the service in the foreground: prints READY when robots may attach, ends on SIGTERM or Ctrl-C."""
    from surffollow.service.messages import hold_standard_files

    hold_standard_files()
    import msgspec

    from surffollow.config.names import check_service_name
    from surffollow.config.service import ServiceConfig, load_config
    from surffollow.errors import ConfigError
    from surffollow.shm.trusted_folder import check_numba_settings

    config = load_config(config_path) if config_path else ServiceConfig()
    if name is not None:
        config = msgspec.structs.replace(config, name=name)
    if strict:
        config = msgspec.structs.replace(
            config, realtime=msgspec.structs.replace(config.realtime, strict=True)
        )
    check_service_name(config.name)
    check_numba_settings()
    from surffollow.service.daemon import serve

    try:
        serve(config, quiet)
    except ConfigError as error:
        if config_path is None or str(error).startswith(config_path):
            raise
        raise ConfigError(f"{config_path}: {error}") from None


@click.command("stop")
@click.option("--name", type=SERVICE_NAME, default="surf", show_default=True, help="Name of the service.")
@click.option("--purge", is_flag=True, help="Also remove the kept map.")
@click.option(
    "--timeout", type=Finite(min=0.0), default=10.0, show_default=True, help="Seconds to wait for its end."
)
def stop_command(name: str, purge: bool, timeout: float) -> None:
    """End a service in good order; its map is kept for the next start unless --purge is given."""
    from surffollow.config.trusted_users import trusted_owners
    from surffollow.errors import NotRunningError, ServiceError
    from surffollow.shm.name_lock import holder, lock_owner

    pid = running_pid(name)
    if pid:
        try:
            ask_to_end(pid, name)
        except PermissionError:
            raise ServiceError(
                f"service {name!r} (pid {pid}) belongs to another user; ask them or root"
            ) from None
        deadline = time.monotonic() + timeout
        while running_pid(name) == pid:
            if time.monotonic() > deadline:
                raise ServiceError(
                    f"service {name!r} (pid {pid}) did not end in {timeout:g} s; kill -9 {pid} is safe"
                )
            time.sleep(0.01)
    if purge:
        purged = purge_leftovers(name)
        if not pid and not purged:
            raise NotRunningError(f"no service {name!r} runs and no map of that name is kept")
    elif not pid and holder(name) < 0 and lock_owner(name) in trusted_owners():
        raise ServiceError(
            f"service {name!r} runs as a process that has no number here: in another pid namespace (a "
            "container), or of a user whose lock this one may not read; stop it there"
        )
    elif not pid:
        raise NotRunningError(f"no service {name!r} is running")


def ask_to_end(pid: int, name: str) -> None:
    """Send SIGTERM to the process that holds the name, never to one that got its number meanwhile."""
    with contextlib.suppress(ProcessLookupError):
        process = os.pidfd_open(pid)
        try:
            if running_pid(name) == pid:
                signal.pidfd_send_signal(process, signal.SIGTERM)
        finally:
            os.close(process)


def running_pid(name: str) -> int:
    """The pid of the live process that holds a service's name; 0 when there is none."""
    from surffollow.errors import InvalidNameError
    from surffollow.service.stale_objects import board_owner, is_block
    from surffollow.shm.name_lock import holder

    pid = holder(name)
    if pid > 0 and is_block(name):
        raise InvalidNameError(
            f"{name!r} is a block of a program (pid {pid}), no service; end that program by its own means "
            "(surffollow blocks ls)"
        )
    # another user's lock cannot be looked at, and a lock may have been removed by hand: the board tells
    return pid if pid > 0 else board_owner(name)


def purge_leftovers(name: str) -> bool:
    """Remove the map, and what a killed service left of its board and socket."""
    from surffollow.service.shared_objects import purge_map

    return purge_map(name)


@click.command("status")
@click.option("--name", type=SERVICE_NAME, default="surf", show_default=True, help="Name of the service.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
@click.option("--audit", is_flag=True, help="Who changed or tried to change what, oldest first.")
def status_command(name: str, as_json: bool, audit: bool) -> None:
    """Say how a service is doing: health, cycles, lateness, clients, map."""
    from surffollow.client import observe
    from surffollow.errors import NotRunningError

    with observe(name) as watcher:
        status = watcher.status()
        with contextlib.suppress(NotRunningError):  # nothing is in force there any more
            status["params"] = watcher.params()
        if audit:
            status["audit"] = watcher.audit()
    if as_json:
        from surffollow.shm.layout_json import identity

        status["layout"] = identity()
        json.dump(status, sys.stdout, indent=2, allow_nan=False, default=str)
        print()
    elif audit:
        print("\n".join(audit_lines(status)))
    else:
        print(render(status))
    if not status["alive"]:
        sys.exit(1)


def audit_lines(status: dict[str, Any]) -> list[str]:
    """The audit trail for people, with local times."""
    from datetime import datetime, timedelta

    from surffollow.client.audit import audit_line

    now = datetime.now()
    lost = int(status["main"].get("audit_lost", 0))
    lines = [
        f"{now - timedelta(seconds=e['age_s']):%Y-%m-%d %H:%M:%S.%f}"[:-3] + " " + audit_line(e)[7:]
        for e in status["audit"]
    ]
    return (lines or ["nobody has asked for a change"]) + ([f"{lost} entries were lost"] if lost else [])


def durations(summary: dict[str, float]) -> str:
    """p50, p99 and maximum of a histogram, for people."""
    from surffollow.units import format_ns

    return ", ".join(f"{k} {format_ns(summary[k + '_ns'])}" for k in ("p50", "p99", "max"))


def follower_lines(f: dict[str, Any]) -> list[str]:
    """Estimates of the follower, for people."""
    if "health" not in f:
        return [f"follower {f['mode']}"]

    def mm(name: str) -> str:
        return "-" if f[name] is None else f"{1e3 * f[name]:.3g} mm"

    why = f" ({f['reason']})" if f.get("reason") else ""
    return [
        f"follower {f['mode']}, {f['health']}{why}; noise {mm('noise_m')}, roughness {mm('roughness_m')}, "
        f"height to {mm('sigma_m')}",
        f"         latency {1e3 * f['latency_s']:.1f} ms, axis τ {1e3 * f['tau_s']:.0f} ms, "
        f"Permitted_Variance {mm('permitted_variance_m')}, "
        f"Range_Size {f['range_size']} × {mm('interval_size_m')}",
    ]


def render(s: dict[str, Any]) -> str:
    """The status as a few lines for people."""
    from surffollow.shm.bit_names import GRANT_NAMES
    from surffollow.units import format_ns

    late, run, main, map_ = s["lateness"], s["execution"], s["main"], s["map"]
    granted = [n for i, n in enumerate(GRANT_NAMES) if main.get("granted", 0) >> i & 1]
    pose = f"pid {main['pose_pid']}" if main.get("pose_slot", -1) >= 0 else "nobody"
    lines = [
        f"service {s['name']}: {s['state']}, pid {s['pid']}, epoch {s['epoch']}",
        f"cycle    {format_ns(s['period_ns'])}, {s['cycles']} run, {s['overruns']} overruns",
        f"lateness {durations(late)} (from a cycle's deadline to its start; 1-20 ns: it was spinning)",
        f"work     {durations(run)} (from its start to the published demand)",
        f"demand   {'|'.join(s['demand_status']) or 'none'}, age {format_ns(s['age_ns'])}",
        f"poses    {s['poses']} taken, {s['poses_refused']} refused; sent by {pose}",
        f"clients  {main.get('clients', 0)}; requests {s['requests']}, refused {s['requests_refused']}",
        f"map      {map_.get('applied', 0)} samples, {map_.get('queued', 0)} waiting, "
        f"{map_.get('lost', 0)} lost",
        f"granted  {', '.join(granted) or 'nothing'}",
    ]
    # behind the line of clients, and behind that of poses
    lines[7:7] = [
        f"         slot {c['slot']}: {c['name']}, pid {c['pid']}, user {c['uid']}" for c in s["clients"]
    ]
    pushers = [f"{c} by pid {p}" for c, p in enumerate(main.get("range_pid", ())) if p]
    if pushers or s["ranges"]:
        lines.insert(
            6,
            f"ranges   {s['ranges']} taken, {s['ranges_refused']} refused, {s['ranges_skipped']} left out; "
            f"channel {', '.join(pushers) or 'pushed by nobody'}",
        )
    lines[5:5] = follower_lines(s["follower"])
    if s["stopped"]:
        lines.append(f"STOPPED  {', '.join(s['stopped'])}; the pose's holder resets it")
    if s["faults"]:
        lines.append("faults   " + ", ".join(f"{f['number']} {f['name']}" for f in s["faults"]))
    if main.get("text"):
        lines.append(f"note     {main['text']}")
    return "\n".join(lines)
