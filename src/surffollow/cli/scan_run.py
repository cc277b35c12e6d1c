"""`surffollow scan run`, and `scan pause`, `resume`, `abort` and `status` of a running one."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import click

from surffollow.apps.ending_signals import ending_signals
from surffollow.cli.facts import print_facts
from surffollow.cli.option_types import JSON, SERVICE_NAME, Finite
from surffollow.cli.output_checks import check_outputs
from surffollow.cli.progress import shows_compiling
from surffollow.cli.scan_continue import PathTime, begin_of, begin_text, continuing_command
from surffollow.cli.scan_options import EXISTING, OUT, PICTURE, check_picture, check_step, gap_of, ground_of
from surffollow.config.input_file import contents_are_read
from surffollow.errors import NotRunningError, ScanInputError, UsageError

if TYPE_CHECKING:
    from surffollow.scan.grid import TerrainGrid
    from surffollow.scan.path import ScanPath


@click.command("run")
@click.argument("path", type=EXISTING)
@click.option("--name", type=SERVICE_NAME, default="surf", show_default=True, help="Service to talk to.")
@click.option(
    "--map", "map_file", type=EXISTING, help="Map of the plan: checked, drawn; `--way map` needs it."
)
@click.option(
    "--way",
    type=click.Choice(["feedforward", "map", "plan"]),
    default="feedforward",
    show_default=True,
    help="Height: the plan's, corrected by the demand; the demand alone over the installed map; the plan's.",
)
@click.option(
    "--from",
    "begin",
    type=PathTime(),
    help="Begin at this time along the path, as a run that was aborted prints it; ID: of that path.",
)
@click.option("--yes", is_flag=True, help="Start without asking; needed where there is no terminal.")
@click.option("--unchecked", is_flag=True, help="Run a path that `scan check` does not accept.")
@click.option(
    "--vertical-mode",
    type=Finite(0.0, 50.0),
    default=4.5,
    show_default=True,
    help="Frequency [Hz] of the arm up and down, at which demands are shaped; 0: not shaped.",
)
@click.option(
    "--damping", type=Finite(0.0, 0.9), default=0.04, show_default=True, help="Damping ratio of that mode."
)
@click.option("--stiff", is_flag=True, help="Simulate an arm without bending, sway and errors.")
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=1,
    show_default=True,
    help="Seed of the noise of the pose reports.",
)
@click.option("--ground", type=EXISTING, help="True ground of the simulation: figures of the real tip.")
@click.option("--wait", "wait_s", type=Finite(0.0), default=10.0, help="Seconds to wait for the service.")
@PICTURE
@click.option("--report", type=OUT, help="Write one HTML page with figures and picture (extra `plot`).")
@JSON
@shows_compiling
def run_command(
    path: str,
    name: str,
    map_file: str | None,
    way: str,
    begin: tuple[float, str] | None,
    yes: bool,
    unchecked: bool,
    vertical_mode: float,
    damping: float,
    stiff: bool,
    seed: int,
    ground: str | None,
    wait_s: float,
    picture: str | None,
    report: str | None,
    as_json: bool,
) -> None:
    """Run the path file PATH with the live follower of a service, on a simulated compliant arm.

    The plan is shown and confirmed before anything moves. Keys while it runs: p pause, r resume, a abort;
    or `surffollow scan pause NAME` from elsewhere. Ctrl-C aborts. An abort brakes, then retracts, and prints
    the command that continues the run. Exit code
    1: not finished, or without a valid demand for more than a tenth of the time; 130 after Ctrl-C.
    """
    from surffollow.apps.scan_robot_config import ScanRobotConfig, check_executable
    from surffollow.scan.path_file import read_path
    from surffollow.scan.shaping import Shaper

    for expected in (picture, report and "report.png"):
        if expected:
            check_picture(expected)
    check_outputs((picture, report), (path, map_file, ground))
    planned = read_path(path)
    with contents_are_read():
        check_executable(planned)
    begin_s = begin_of(planned, path, begin)
    if way == "map" and map_file is None:
        raise click.UsageError("--way map needs --map: the map that the service is to have")
    gap = gap_of(planned)
    mapped = ground_of(map_file, None, gap) if map_file is not None else None
    if way == "map" and gap is not None:
        from surffollow.map import HeightMap

        # the service holds the heights in steps, also those of a raster
        check_step(HeightMap.load(str(map_file)).quantum_m, gap, str(map_file))
    _show(planned, path, map_file, mapped, picture, unchecked)
    if begin_s:
        click.echo(begin_text(planned, begin_s), err=True)
    _confirm(yes)
    shaper = Shaper.zvd(vertical_mode, damping) if vertical_mode > 0.0 else None
    simulated: dict[str, Any] = {"errors": None, "compliance": None} if stiff else {}
    config = ScanRobotConfig(way=way, shaper=shaper, seed=seed, **simulated)
    with ending_signals() as caught:
        done = _execute(
            planned, name, config, mapped, map_file if way == "map" else None, caught, wait_s, begin_s
        )
    from surffollow.apps.scan_figures import sensed_figures, true_figures

    figures: dict[str, Any] = {"sensed": sensed_figures(done)}
    if ground is not None:
        from surffollow.sim.world_surface import file_surface

        figures["true"] = true_figures(done, file_surface(ground))
    flat = {f"{k}_{n}": v for k, found in figures.items() for n, v in found.items() if k == "true"}
    _print_gap(done)
    place = done.summary["continue_from"]
    command = continuing_command(click.get_current_context(), place) if place else None
    done.summary["continue_with"] = command
    print_facts({"path": path} | done.summary | figures["sensed"] | flat, as_json)
    if picture:
        from surffollow.apps.scan_report import draw_run

        draw_run(picture, done, mapped)
    if report:
        from surffollow.apps.scan_report import write_run_report

        write_run_report(report, done, figures, mapped)
    if command:
        click.echo(f"to continue: {command}", err=True)
    _end(done.summary, bool(caught))


def _show(
    planned: ScanPath,
    path: str,
    map_file: str | None,
    mapped: TerrainGrid | None,
    picture: str | None,
    unchecked: bool,
) -> None:
    """Figures, flags, the check and the picture of the plan, on standard error."""
    from surffollow.scan.check import check_path
    from surffollow.scan.plan_summary import plan_figures

    for key, value in plan_figures(planned).items():
        if isinstance(value, dict):
            value = ", ".join(f"{k} {v}" for k, v in value.items() if v) or "none"
        text = f"{value:.6g}" if isinstance(value, float) else "-" if value is None else str(value)
        click.echo(f"{key:<17} {text}", err=True)
    if mapped is None:
        click.echo("no --map: the path is not checked against the ground", err=True)
        return
    findings = check_path(mapped.heights_m, mapped.origin_m, mapped.grid_m, path)
    for f in findings:
        click.echo(f"{f.mark} {f.name:<21} {f.text}", err=True)
    if picture:
        from surffollow.scan.pictures import draw_plan

        draw_plan(picture, mapped, planned)
        click.echo(f"picture of the plan: {picture}", err=True)
    wrong = [f.name for f in findings if not f.ok]
    if wrong and not unchecked:
        with contents_are_read():
            raise ScanInputError(
                f"`scan check` does not accept the path over {map_file}: {', '.join(wrong)}; plan it again, "
                "or run it with --unchecked"
            )


def _confirm(yes: bool) -> None:
    if yes:
        return
    if not sys.stdin.isatty():
        raise UsageError("the plan cannot be confirmed without a terminal; nothing moved (scripts: --yes)")
    if not click.confirm("Start the scan?", err=True):
        click.echo("nothing moved", err=True)
        sys.exit(1)


def _execute(
    planned: ScanPath,
    name: str,
    config: Any,
    mapped: TerrainGrid | None,
    install: str | None,
    caught: list[int],
    wait_s: float,
    begin_s: float,
) -> Any:
    from surffollow.apps.scan_run import execute
    from surffollow.cli.progress import progress_line
    from surffollow.client import Client, attach, observe
    from surffollow.sim.hardware_priority import hardware_priority

    def prepare(client: Any) -> None:
        if install is not None:
            client.map_install(install)

    def attached() -> Client:
        # an attachment waits seconds for a service that has ended, and the arm is not commanded meanwhile
        with observe(name) as seen:
            if not seen.alive():
                raise NotRunningError(f"service '{name}' has ended or stands still")
        return attach(name, label="scan run")

    with hardware_priority(), progress_line() as show:
        return execute(
            planned,
            name,
            attached,
            config,
            ground=mapped,
            prepare=prepare,
            aborted=lambda: bool(caught),
            progress=None if show is None else lambda text, part: show(f"{100 * part:3.0f} % {text}"),
            wait_s=wait_s,
            from_s=begin_s,
        )


def _print_gap(done: Any) -> None:
    """Why the run ended early, whether it was inside the gap, and what it covered, on standard error."""
    from surffollow.apps.scan_report import coverage_text, inside_text
    from surffollow.scan.length_text import decimal_length
    from surffollow.units import length_unit

    unit = length_unit(float(done.path.facts["gap_m"]))
    if done.summary["stop_reason"]:
        click.echo(f"aborted: {done.summary['stop_reason']}", err=True)
    click.echo(inside_text(done), err=True)
    for event in done.inside:
        place = f"pass {event['pass'] + 1}" if event["pass"] >= 0 else "a turn"
        click.echo(
            f"  {event['t_s']:.2f} s, {place}, x {event['x_m']:.3f}, "
            f"y {event['y_m']:.3f} m: "
            f"{decimal_length(event['clearance_m'], unit)}",
            err=True,
        )
    click.echo(coverage_text(done), err=True)


def _end(summary: dict[str, Any], interrupted: bool) -> None:
    from surffollow.sim.robot_run import held_too_long

    if interrupted:
        sys.exit(130)
    if not summary["finished"] or held_too_long(summary["ticks"], summary["held_ticks"]):
        sys.exit(1)
