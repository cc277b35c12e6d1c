"""`surffollow arbiter acknowledge`."""

from __future__ import annotations

import json

import click

from surffollow.cli.option_types import JSON, SERVICE_NAME


@click.command("acknowledge")
@click.argument("part")
@click.option("--name", type=SERVICE_NAME, default="cell", show_default=True, help="Name of the arbiter.")
@click.option("--client", required=True, help="Client of the configuration that does it, not attached now.")
@JSON
def acknowledge_command(part: str, name: str, client: str, as_json: bool) -> None:
    """Acknowledge that PART of a sum is lost: from then on the sum is valid without it.

    Do so only when the robot is safe where the other parts lead it. The client requests the part and gives it
    back. PART must be lost (`surffollow arbiter status`).
    """
    from surffollow.arbiter import attach
    from surffollow.errors import FaultError, UsageError

    with attach(name, client) as arbiter:
        resource = arbiter.resource(part)
        status = arbiter.status()["resources"][part]
        if not status["lost_since_ns"]:
            raise UsageError(
                f"{part!r} of arbiter {name!r} is not lost; see surffollow arbiter status --name {name}"
            )
        if not (reply := resource.request()):
            raise FaultError(
                f"{part!r} was not granted to {client!r} ({reply.reason}); {reply.holder!r} holds it"
            )
        resource.relinquish()
    if as_json:
        print(json.dumps({"name": name, "part": part, "combination": status["combination"]}))
    else:
        print(f"{part} is acknowledged: {status['combination']} is the sum of the other parts")
