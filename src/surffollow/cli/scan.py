"""`surffollow scan`: depth images to a terrain map, a map to a path, its check and its execution."""

from __future__ import annotations

import click

from surffollow.cli.scan_control import abort_command, pause_command, resume_command, status_command
from surffollow.cli.scan_field import calibrate_command, demo_command
from surffollow.cli.scan_map import compose_command, map_command
from surffollow.cli.scan_plan import check_command, plan_command
from surffollow.cli.scan_run import run_command


@click.group("scan")
def scan_group() -> None:
    """Map ground from depth images, plan a scan over a map, check and run it; demonstrate it in simulation.

    MAP is any file that `surffollow map` reads, or --live NAME: a service's map as it is now.
    """


for command in (
    map_command,
    compose_command,
    plan_command,
    check_command,
    calibrate_command,
    run_command,
    pause_command,
    resume_command,
    abort_command,
    status_command,
    demo_command,
):
    scan_group.add_command(command)
