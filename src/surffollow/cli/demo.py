"""`surffollow demo`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click

from surffollow.cli.option_types import Finite, OutputFile, OutputFolder
from surffollow.cli.service import check_address_space
from surffollow.cli.simulate import LENGTH, SPEED


def _speed(ctx: click.Context, param: click.Parameter, value: str | None) -> float | None:
    return None if value is None else float(SPEED(ctx, param, value))


@click.command("demo")
@click.option(
    "--seconds", type=Finite(3.0, 3600.0), default=20.0, show_default=True, help="Duration of the motion [s]."
)
@click.option(
    "--sensors",
    type=click.IntRange(3, 8),
    help="Number of range sensors around the tool, which then also turns to the surface normal.",
)
@click.option(
    "--speed", callback=_speed, help="Speed along the path.  [default: 50 mm/s; with --sensors 100 mm/s]"
)
@click.option("--surface", help="Ground to follow.  [default: fy91; with --sensors dome]")
@click.option("--seed", type=click.IntRange(0), default=91, show_default=True, help="Seed of the ground.")
@click.option(
    "--path",
    type=click.Choice(["raster", "line"]),
    default="raster",
    show_default=True,
    help="Form of the path.",
)
@click.option("--offset", callback=LENGTH, default="0.1 m", show_default=True, help="Stand-off to keep.")
@click.option(
    "--mode", type=click.Choice(["paper", "adaptive"]), help="Follower; default: the service's own."
)
@click.option(
    "--picture",
    type=OutputFile(),
    default="surffollow-demo.png",
    show_default=True,
    help="Picture to draw (extra `plot`).",
)
@click.option("--keep", type=OutputFolder(), help="Keep recording, trace and map in this folder.")
@click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON object; draw only if --picture is given."
)
@click.pass_context
def demo_command(
    ctx: click.Context,
    seconds: float,
    sensors: int | None,
    speed: float | None,
    surface: str | None,
    seed: int,
    path: str,
    offset: float,
    mode: str | None,
    picture: str,
    keep: str | None,
    as_json: bool,
) -> None:
    """Follow simulated rough ground with the real service, a robot process and a recorder.

    Prints how well it went, replays the recording and compares every bit, and draws a
    picture. Exit code 1 when any of it failed.
    """
    check_address_space()
    if sensors is not None and mode == "paper":
        raise click.UsageError("the paper's mode knows no rotations; leave --mode or --sensors out")
    surface = surface or ("fy91" if sensors is None else "dome")
    if speed is None:
        speed = 0.05 if sensors is None else 0.1
    from surffollow.apps.demo import demo_folder, run_demo
    from surffollow.apps.demo_figures import table
    from surffollow.apps.demo_task import DemoConfig, check_task
    from surffollow.shm.ending_signals import ended_by_signals

    config = DemoConfig(
        seconds=seconds,
        speed_mps=speed,
        surface=surface,
        seed=seed,
        path=path,
        offset_m=offset,
        follow={} if mode is None else {"mode": mode},
        sensors=sensors or 1,
    )
    chosen = ctx.get_parameter_source("picture") is click.core.ParameterSource.COMMANDLINE
    on_terminal = sys.stderr.isatty()

    def progress(text: str, part: float) -> None:
        if on_terminal:
            bar = "█" * round(part * 24)
            sys.stderr.write(f"\r\x1b[K{bar:░<24} {text}")
            sys.stderr.flush()

    check_task(config)
    draws = chosen or not as_json
    if draws:
        from surffollow.apps.demo_picture import check_picture

        check_picture(Path(picture))
    with ended_by_signals(), demo_folder(Path(keep) if keep else None) as folder:
        result = run_demo(config, folder, progress)
        if draws:
            from surffollow.apps.demo_picture import draw_demo

            result["picture"] = str(draw_demo(folder, Path(picture), config, result))
    if on_terminal:
        sys.stderr.write("\r\x1b[K")
    if as_json:
        print(json.dumps(result))
    else:
        print(f"surffollow followed {surface} (seed {seed}) for {seconds:g} s\n{table(result)}")
        print(f"  picture: {result['picture']}")
        for note in result["notes"]:
            print(f"  note: {note}")
        for failure in result["failures"]:
            print(f"  FAILED: {failure}")
    if result["failures"]:
        sys.exit(1)
