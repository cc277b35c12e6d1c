"""`surffollow demo`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click

from surffollow.cli.robot import LENGTH, SPEED


@click.command("demo")
@click.option(
    "--seconds", type=click.FloatRange(2.0, 3600.0), default=20.0, show_default=True, help="Of motion."
)
@click.option("--speed", callback=SPEED, default="50 mm/s", show_default=True, help="Along the path.")
@click.option("--surface", default="fy91", show_default=True, help="Ground to follow.")
@click.option("--seed", default=91, show_default=True, help="Of the ground.")
@click.option("--path", type=click.Choice(["raster", "line"]), default="raster", show_default=True)
@click.option("--offset", callback=LENGTH, default="0.1 m", show_default=True, help="Stand-off to keep.")
@click.option(
    "--mode", type=click.Choice(["paper", "adaptive"]), help="Follower; default: the service's own."
)
@click.option("--picture", type=click.Path(dir_okay=False), default="surffollow-demo.png", show_default=True)
@click.option(
    "--keep", type=click.Path(file_okay=False), help="Keep recording, trace and map in this folder."
)
@click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON object; draw only if --picture is given."
)
@click.pass_context
def demo_command(
    ctx: click.Context,
    seconds: float,
    speed: float,
    surface: str,
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
    from surffollow.live.demo import DemoConfig, demo_folder, run_demo
    from surffollow.live.figures import table

    config = DemoConfig(
        seconds=seconds,
        speed_mps=speed,
        surface=surface,
        seed=seed,
        path=path,
        offset_m=offset,
        follow={} if mode is None else {"mode": mode},
    )
    chosen = ctx.get_parameter_source("picture") is click.core.ParameterSource.COMMANDLINE
    on_terminal = sys.stderr.isatty()

    def progress(text: str, part: float) -> None:
        if on_terminal:
            bar = "█" * round(part * 24)
            sys.stderr.write(f"\r\x1b[K{bar:░<24} {text}")
            sys.stderr.flush()

    with demo_folder(Path(keep) if keep else None) as folder:
        result = run_demo(config, folder, progress)
        if chosen or not as_json:
            from surffollow.live.picture import draw_demo

            result["picture"] = str(draw_demo(folder, Path(picture), config, result))
    if on_terminal:
        sys.stderr.write("\r\x1b[K")
    if as_json:
        print(json.dumps(result))
    else:
        print(f"surffollow followed {surface} (seed {seed}) for {seconds:g} s\n{table(result)}")
        print(f"  picture: {result['picture']}")
        for failure in result["failures"]:
            print(f"  FAILED: {failure}")
    if result["failures"]:
        sys.exit(1)
