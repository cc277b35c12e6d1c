"""`surffollow arbiter`: its verbs, of which `stop`, `acknowledge` and `history` have their own modules."""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import click

from surffollow.cli.arbiter_acknowledge import acknowledge_command
from surffollow.cli.arbiter_history import history_command
from surffollow.cli.arbiter_stop import stop_command
from surffollow.cli.old_names import old_name
from surffollow.cli.option_types import JSON, SERVICE_NAME, Finite, InputFile

STARTING = 3  # exit code, as of `surffollow status`
_WAITS = {
    "lost": "is lost (its client ended or fell silent, or the arbiter ended while it was held)",
    "required": "is required and has no holder",
    "late": "has a holder that sends no command, or too seldom (its program may hang)",
    "pose": "has a pose that cannot be converted (absent, or too far from that of the sum)",
}


@click.group("arbiter")
def arbiter_group() -> None:
    """Share a robot among clients by priority: the server, and a look at it."""


@arbiter_group.command("start")
@click.argument("config_path", metavar="CONFIG.toml", type=InputFile(streams=True))
@click.option("--name", type=SERVICE_NAME, help="Name of the arbiter [the configuration's].")
@click.option("--quiet", is_flag=True, help="Print only READY and errors.")
def start_command(config_path: str, name: str | None, quiet: bool) -> None:
    """Run the server in the foreground: prints READY when clients may attach.

    SIGTERM, SIGHUP and Ctrl-C end it.
    """
    import msgspec

    from surffollow.arbiter.config import load_config
    from surffollow.config.input_file import contents_are_read

    config = load_config(config_path)
    if name is not None:
        config = msgspec.structs.replace(config, name=name)
    from surffollow.shm.trusted_folder import check_numba_settings

    check_numba_settings()
    from surffollow.arbiter.server import serve

    with contents_are_read():
        serve(config, quiet)


arbiter_group.add_command(stop_command)
arbiter_group.add_command(acknowledge_command)
arbiter_group.add_command(history_command)


@arbiter_group.command("status")
@click.option("--name", type=SERVICE_NAME, default="cell", show_default=True, help="Name of the arbiter.")
@click.option(
    "--wait", "wait_s", type=Finite(min=0.0), default=0.0, help="Wait up to so many seconds for it to run."
)
@JSON
def status_command(name: str, wait_s: float, as_json: bool) -> None:
    """Show who holds what, who is attached, what was denied and how long clients waited.

    Of a sum it shows for which parts it waits at its safe command, since when, and the way out.

    Exit codes: 0 it runs; 1 it does not; 3 it starts.
    """
    status = _status_in(name, wait_s)
    if as_json:
        print(json.dumps(status, indent=2))
    else:
        _print_status(name, status)
    if not status["alive"]:
        sys.exit(STARTING if status["starting"] else 1)


def _print_status(name: str, status: dict[str, Any]) -> None:
    from surffollow.units import format_ns

    running = (
        "runs" if status["alive"] else "starts" if status["starting"] else "does not run (its last board)"
    )
    print(f"arbiter {name} {running}, pid {status['pid']}, epoch {status['epoch']}")
    if status["alive"] and status["silent_ns"] > 1e9 * status["lease_s"]:
        print(
            f"  it has looked at no client for {format_ns(status['silent_ns'])}: its process is stopped or "
            "gets no processor time, and all below is of then"
        )
    for resource, s in status["resources"].items():
        by = f" by {s['holder']} (priority {s['priority']})" if s["holder"] else ""
        print(
            f"  {resource}: {s['state']}{by}, {s['queue']} waiting; {s['grants']} grants, {s['preempted']} "
            f"preempted, {s['forwarded']} forwarded, {s['rejected']} rejected, {s['denied']} denied; longest "
            f"wait {format_ns(s['waited_ns'])}, the longest one now {format_ns(s['waiting_ns'])}"
        )
    for combination, x in status["combinations"].items():
        print(f"  {combination}: the sum of {', '.join(x['parts'])}")
        for w in x["waits_for"]:
            why = _WAITS[w["reason"]]
            print(
                f"    safe command for {format_ns(w['for_ns'])}, because {w['part']} {why}. "
                f"Way out: {w['remedy']}"
            )
    for c in status["clients"]:
        life = "" if c["live"] else ", no heartbeat"
        print(
            f"  client {c['name']}: number {c['number']}, pid {c['pid']}, priority {c['priority']}, denied "
            f"{c['denied']}, longest wait {format_ns(c['waited_ns'])}, broken mailbox {c['broken']}{life}"
        )


def _status_in(name: str, wait_s: float) -> dict[str, Any]:
    """The status now; with a time to wait [s] that of an arbiter that runs, or NotRunningError."""
    from surffollow.arbiter import observe
    from surffollow.errors import NotRunningError

    deadline = time.monotonic() + wait_s
    while True:
        late = time.monotonic() >= deadline
        try:
            with observe(name) as arbiter:
                status: dict[str, Any] = arbiter.status()
            if status["alive"] or wait_s == 0.0:
                return status
        except NotRunningError:
            if late:
                raise
        if late:
            raise NotRunningError(f"no arbiter {name!r} ran within {wait_s:g} s")
        time.sleep(0.1)


@arbiter_group.command("check")
@click.option("--mutants", "with_mutants", is_flag=True, help="Also show that every altered table is caught.")
@JSON
def check_command(with_mutants: bool, as_json: bool) -> None:
    """Explore every state that three clients can bring a resource into, by the table that the server runs.

    Exit code 1 when a property is broken, or an altered table was not caught.
    """
    from surffollow.arbiter.check import check_table, is_caught
    from surffollow.arbiter.mutants import mutants

    found = check_table()
    survivors, tried = [], 0
    if with_mutants:
        for what, rows in mutants():
            tried += 1
            if not is_caught(rows):
                survivors.append(what)
    result = {
        "policies": [
            {"policy": f.policy, "states": f.states, "steps": f.steps, "fault": f.fault} for f in found
        ],
        "mutants": tried,
        "survivors": survivors,
    }
    if as_json:
        print(json.dumps(result, indent=2))
    else:
        for f in found:
            print(f"{f.policy:24} {f.states:6} states {f.steps:8} steps   {f.fault or 'no fault'}")
        if with_mutants:
            print(f"{tried} altered tables, {len(survivors)} not caught")
            for what in survivors:
                print(f"  {what}")
    if survivors or any(f.fault for f in found):
        sys.exit(1)


@arbiter_group.command("print-header")
def print_header_command() -> None:
    """Print the C header of arbiter clients; it stands beside surffollow.h (surffollow --includedir)."""
    from pathlib import Path

    header = Path(__file__).parents[1] / "include" / "surffollow_arbiter.h"
    click.echo(header.read_text(encoding="ascii"), nl=False)


old_name(arbiter_group, print_header_command, "header")


def stop_on_signals() -> list[int]:
    """A list that gets an entry when SIGINT, SIGTERM or SIGHUP arrives."""
    from surffollow.shm.ending_signals import handle_ending

    stopped: list[int] = []
    handle_ending(lambda n, _: stopped.append(n))
    return stopped


@arbiter_group.command("follow")
@click.option("--name", type=SERVICE_NAME, default="cell", show_default=True, help="Name of the arbiter.")
@click.option("--service", type=SERVICE_NAME, default="surf", show_default=True, help="Following service.")
@click.option("--resource", default="tool", show_default=True, help="Resource to command.")
@click.option("--client", default="follow", show_default=True, help="Name in the configuration.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object at the end.")
def follow_command(name: str, service: str, resource: str, client: str, as_json: bool) -> None:
    """Hand a service's demands to an arbiter's resource, as one client among others, until Ctrl-C.

    While others hold the resource the robot (`surffollow simulate --arbiter`) keeps the service in DRYRUN: it
    learns nothing.
    """
    from surffollow.apps.shared_tool import follow

    stopped = stop_on_signals()
    counts = follow(service, name, resource, lambda: bool(stopped), client)
    print(json.dumps(counts) if as_json else ", ".join(f"{k} {v}" for k, v in counts.items()))


@arbiter_group.command("demo")
@click.option(
    "--seconds",
    type=Finite(min=12.0, max=120.0),
    default=20.0,
    show_default=True,
    help="Duration of the motion [s].",
)
@click.option(
    "--combine",
    type=click.Choice(["priority", "sum"]),
    default="priority",
    show_default=True,
    help="One client commands the tool, or the sum of the commands does.",
)
@JSON
def demo_command(seconds: float, combine: str, as_json: bool) -> None:
    """Follow a surface, see an obstacle, lift the tool over it, bring it back: five processes share a robot.

    Exit code 1 when the tool came too near, or was not brought back.
    """
    import tempfile
    from pathlib import Path

    from surffollow.apps.shared_demo import run_shared_demo
    from surffollow.shm.ending_signals import ended_by_signals

    def progress(text: str) -> None:
        print(f"surffollow: {text}", file=sys.stderr, flush=True)

    with ended_by_signals(), tempfile.TemporaryDirectory() as folder:
        result = run_shared_demo(seconds, combine, Path(folder), progress)
    if as_json:
        print(json.dumps(result, indent=2))
    else:
        for key, value in result.items():
            print(f"{key:32} {value}")
    if result["failures"]:
        sys.exit(1)
