"""`surffollow arbiter history`."""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import click

from surffollow.cli.option_types import SERVICE_NAME, Finite


@click.command("history")
@click.option("--name", type=SERVICE_NAME, default="cell", show_default=True, help="Name of the arbiter.")
@click.option(
    "--last",
    type=click.IntRange(0),
    default=50,
    show_default=True,
    help="Number of newest records to print at first.",
)
@click.option("--follow", is_flag=True, help="Go on until Ctrl-C.")
@click.option("--seconds", type=Finite(min=0.0), default=0.0, help="With --follow: end after that time.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per line.")
def history_command(name: str, last: int, follow: bool, seconds: float, as_json: bool) -> None:
    """Print who asked, held, lost and commanded what."""
    from surffollow.arbiter import observe
    from surffollow.cli.progress import stop_event

    stop = stop_event()
    until = time.monotonic() + seconds if seconds > 0 else float("inf")
    with observe(name) as arbiter:
        history = arbiter.history()
        sizes = {name: len(r["fields"]) for name, r in arbiter.status()["resources"].items()}
        if not as_json:
            print(
                f"{'seq':>8} {'time [s]':>14} {'resource':12} {'client':11} {'event':20} {'reason':12} "
                f"{'token':>18} values (time: CLOCK_MONOTONIC)"
            )
        for event in history.newest(last):
            _print_event(event, as_json, sizes)
        while follow and not stop.is_set() and time.monotonic() < until and arbiter.alive():
            for event in history:
                _print_event(event, as_json, sizes)
            print(end="", flush=True)
            stop.wait(0.01)
    if history.lost:
        print(f"surffollow: {history.lost} records were overwritten before they were read", file=sys.stderr)


def _print_event(event: Any, as_json: bool, sizes: dict[str, int]) -> None:
    if as_json:
        print(json.dumps(event._asdict()))
        return
    shown = event.command[: sizes.get(event.resource)] if event.event in ("FORWARD", "SAFE") else ()
    values = " ".join(f"{v:g}" for v in shown)
    if event.event in ("GRANT", "DEQUEUE") and event.command[0] > 0.0:
        values = f"waited {event.command[0]:.3f} s"
    token = f"{event.token:#x}" if event.token else "-"
    print(
        f"{event.seq:>8} {event.t_ns / 1e9:14.6f} {event.resource or '-':12} client {event.client:<4} "
        f"{event.event:20} {event.reason:12} {token:>18} {values}".rstrip()
    )
