"""`surffollow base`, `base-client` and `wall-follow`: a simulated mobile base and the experiments with it."""

from __future__ import annotations

import json
import sys
from typing import Any

import click

from surffollow.cli.json_values import without_nan
from surffollow.cli.option_types import JSON, SERVICE_NAME, Finite, OutputFile
from surffollow.cli.progress import shows_compiling

CLIENTS = ("avoid", "follow-wall", "follow-wall-2", "go")
EXPERIMENTS = ("paper", "1", "1-pair", "2")


@click.command("base")
@click.option(
    "--name", type=SERVICE_NAME, default="cell", show_default=True, help="Arbiter, and prefix of blocks."
)
@click.option(
    "--seconds", type=Finite(min=0.0), default=60.0, show_default=True, help="Duration of the motion [s]."
)
@click.option(
    "--seed", type=click.IntRange(0), default=1, show_default=True, help="Seed of range noise and slip."
)
@click.option(
    "--start",
    type=Finite(),
    nargs=3,
    default=(1.5, 1.05, 0.0),
    show_default=True,
    help="x [m], y [m] and heading [rad] in the room.",
)
@click.option("--log", type=OutputFile(), help="Write the true motion to this CSV file.")
@JSON
def base_command(
    name: str, seconds: float, seed: int, start: tuple[float, float, float], log: str | None, as_json: bool
) -> None:
    """Simulate a base with sonars: obeys the arbiter, publishes NAME.base and NAME.true_base.

    It waits for the first command of a client, until Ctrl-C.
    """
    from surffollow.apps.base_process import run_base
    from surffollow.sim.base import BaseConfig

    said = run_base(
        name,
        seconds,
        seed=seed,
        log=log,
        config=BaseConfig(start=start),
        say=lambda text: click.echo(text, err=True),
    )
    if as_json:
        print(json.dumps(said))
    elif not said["obeyed"]:
        print("no client commanded the base: it never moved")
    else:
        print(f"{said['seconds']:.1f} s, least gap to a wall {1e3 * said['least_gap_m']:.0f} mm")


@click.command("base-client")
@click.argument("client", type=click.Choice(CLIENTS))
@click.option(
    "--name", type=SERVICE_NAME, default="cell", show_default=True, help="Arbiter, and prefix of blocks."
)
@click.option(
    "--experiment",
    type=click.Choice(EXPERIMENTS),
    default="2",
    show_default=True,
    help="Experiment, as in `wall-follow`.",
)
@JSON
def base_client_command(client: str, name: str, experiment: str, as_json: bool) -> None:
    """Run one client of the wall-following experiments until the base ends."""
    from surffollow.apps.wall_processes import run_client

    said = run_client(name, client, experiment)
    print(
        json.dumps(said) if as_json else f"{client}: {said['commands']} commands, {said['requests']} requests"
    )


def seeds_of(ctx: click.Context, param: click.Parameter, value: str) -> range:
    """Option callback: "A:B" or one number."""
    first, _, last = value.partition(":")
    try:
        seeds = range(int(first), int(last) if last else int(first) + 1)
    except ValueError:
        seeds = range(0)
    if not seeds or seeds[0] < 0:
        raise click.BadParameter(f"{value!r} names no seeds from 0 on; write 1:21 or 7", ctx, param)
    return seeds


@click.command("wall-follow")
@click.option(
    "--experiment",
    type=click.Choice(EXPERIMENTS),
    default="2",
    show_default=True,
    help="Clients that share the base, see above.",
)
@click.option(
    "--laps",
    type=click.IntRange(min=1),
    default=4,
    show_default=True,
    help="Laps in simulated time. The last one ends 20° short of a whole turn.",
)
@click.option(
    "--seeds", callback=seeds_of, default="1", show_default=True, help="Seeds, A:B without B, or one number."
)
@click.option(
    "--processes", is_flag=True, help="Real time: arbiter, base and clients as processes (one seed)."
)
@click.option(
    "--seconds",
    type=Finite(min=1.0),
    default=90.0,
    show_default=True,
    help="Duration of the motion with --processes [s].",
)
@click.option("--plot", type=OutputFile(), help="Draw the first seed's run: PNG, SVG or PDF.")
@JSON
@shows_compiling
def wall_follow_command(
    experiment: str, laps: int, seeds: range, processes: bool, seconds: float, plot: str | None, as_json: bool
) -> None:
    """Follow the walls of a room by clients that share a base, and print the figures of merit.

    Experiment "paper": go and follow-wall by a pair of sonars. "1": with avoid, fused pose. "1-pair": with
    avoid, by a pair. "2": with follow-wall-2, too.
    """
    from surffollow.apps.wall_figures import figures
    from surffollow.apps.wall_following import run_experiment

    if processes and len(seeds) > 1:
        raise click.UsageError(
            "--processes runs in real time, one seed at a time; give one number to --seeds"
        )
    runs: list[dict[str, Any]] = []
    first = None
    for seed in seeds:
        if processes:
            from surffollow.apps.wall_processes import run_processes

            run, history = run_processes(experiment, seconds, seed=seed)
            more: dict[str, Any] = {"events": len(history)}
        else:
            run = run_experiment(experiment, laps=laps, seed=seed)
            more = {"ended": run.ended}
        first = first or run
        runs.append({"seed": seed, **figures(run), **more})
        if len(seeds) > 1 and not as_json:
            print(f"seed {seed}: {line_of(runs[-1])}", file=sys.stderr, flush=True)
    if plot is not None and first is not None:
        from surffollow.apps.wall_pictures import draw_run

        draw_run(first, plot, f"experiment {experiment}, seed {runs[0]['seed']}")
    median = median_of(runs)
    said = {"experiment": experiment, "runs": runs, "median": median}
    text = f"experiment {experiment}, median of {len(runs)}: {line_of(median)}"
    ends = {str(r["ended"]) for r in runs if "ended" in r}
    text += "".join(f"; {end}" for end in sorted(ends))
    print(json.dumps(without_nan(said)) if as_json else text)


def median_of(runs: list[dict[str, Any]]) -> dict[str, float]:
    """Median of every figure, and the sum of the contacts."""
    import statistics

    keys = [k for k in runs[0] if k not in ("seed", "ended")]
    said = {k: float(statistics.median(r[k] for r in runs)) for k in keys}
    return {**said, "contacts": float(sum(r["contacts"] for r in runs))}


def line_of(f: dict[str, Any]) -> str:
    """The figures in one line; figures that the run was too short for say where they begin."""
    import math

    along = "distance and heading to the wall only from two turns on"
    if not math.isnan(f["distance_rms_m"]):
        along = (
            f"distance RMS {1e3 * f['distance_rms_m']:.0f} mm, "
            f"off the wall by {math.degrees(f['heading_rms_rad']):.2f}° RMS"
        )
    repeatability = math.degrees(f["heading_repeatability_rad"])
    repeats = "heading repeatability only from two laps on"
    if not math.isnan(repeatability):
        repeats = f"heading repeats within {repeatability:.2f}°"
    return (
        f"{along}, {repeats}, least gap {1e3 * f['least_gap_m']:.0f} mm, "
        f"{f['contacts']:.0f} contacts of {f['contact_s']:.1f} s, "
        f"{f['laps']:.2f} laps in {f['seconds']:.0f} s"
    )
