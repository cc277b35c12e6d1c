"""Commands to a running scan: pause, resume, abort and status."""

from __future__ import annotations

import json

import click

from surffollow.cli.option_types import JSON, SERVICE_NAME


def _send_command(name: str, word: str, as_json: bool) -> None:
    from surffollow.apps.scan_control import ask

    answer = ask(name, word)
    if as_json:
        click.echo(json.dumps(answer))
        return
    x, y, z = answer["tip_m"]
    done = "" if word == "status" else f"{word} asked for; it was: "
    number = f"pass {answer['pass'] + 1} of {answer['passes']}"
    if answer["pass"] < 0:
        number = f"on a turn, {answer['passes']} passes"
    click.echo(
        f"{done}{answer['state']}, {100 * answer['progress']:.0f} %, {number}, "
        f"tip at {x:.3f}, {y:.3f}, {z:.3f} m" + (f"; {answer['trouble']}" if answer["trouble"] else "")
    )


_NAME = click.argument("name", type=SERVICE_NAME, default="surf")


@click.command("pause")
@_NAME
@JSON
def pause_command(name: str, as_json: bool) -> None:
    """Let the running scan of service NAME come to rest where it is; it keeps its stand-off there."""
    _send_command(name, "pause", as_json)


@click.command("resume")
@_NAME
@JSON
def resume_command(name: str, as_json: bool) -> None:
    """Let a paused scan of service NAME go on; a latched stop of the service is reset first."""
    _send_command(name, "resume", as_json)


@click.command("abort")
@_NAME
@JSON
def abort_command(name: str, as_json: bool) -> None:
    """Let the running scan of service NAME brake, retract and end."""
    _send_command(name, "abort", as_json)


@click.command("status")
@_NAME
@JSON
def status_command(name: str, as_json: bool) -> None:
    """Report the state of the running scan of service NAME."""
    _send_command(name, "status", as_json)
