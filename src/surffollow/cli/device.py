"""`surffollow device camera|speaker`: low-level controllers of small simulated resources."""

from __future__ import annotations

import json

import click

from surffollow.cli.option_types import SERVICE_NAME, Finite


@click.command("device")
@click.argument("kind", type=click.Choice(["camera", "speaker"]))
@click.option(
    "--name", type=SERVICE_NAME, default="cell", show_default=True, help="Arbiter, and prefix of the block."
)
@click.option("--seconds", type=Finite(min=0.0), default=0.0, help="How long [until Ctrl-C].")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object at the end.")
def device_command(kind: str, name: str, seconds: float, as_json: bool) -> None:
    """Simulate a camera that pans, or a speaker: obeys the arbiter, publishes NAME.KIND_status."""
    from surffollow.apps.device_processes import run_device
    from surffollow.cli.arbiter import stop_on_signals

    stopped = stop_on_signals()
    said = run_device(kind, name, seconds, lambda: bool(stopped))
    if as_json:
        print(json.dumps(said))
        return
    cycles = said.pop("obeyed")
    by = ", ".join(
        f"{n} of {f'client {client}' if client else 'the safe command'}"
        for client, n in sorted(cycles.items())
    )
    print(f"cycles: {by or 'none'}; " + ", ".join(f"{k} {v}" for k, v in said.items()))
