"""`surffollow benchmark`: every method on the same plant, surfaces and seeds, in simulated time."""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import click

from surffollow.cli.option_types import JSON
from surffollow.errors import UsageError
from surffollow.shm.ending_signals import ended_by_signals
from surffollow.units import parse_quantity


class Quantities(click.ParamType):  # type: ignore[type-arg]  # generic only in click 8.3's stubs
    """One or several quantities, separated by commas."""

    name = "LIST"

    def __init__(self, unit: str) -> None:
        self.unit = unit

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> list[float]:
        """Split and convert, or fail with what was expected."""
        if isinstance(value, list):
            return value
        try:
            return [parse_quantity(part, self.unit, bare=True) for part in str(value).split(",")]
        except UsageError as error:
            self.fail(str(error), param, ctx)


class Seeds(click.ParamType):  # type: ignore[type-arg]
    """A half-open range of seeds `A:B`, or one seed."""

    name = "A:B"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> list[int]:
        """Turn the text into seeds."""
        if isinstance(value, list):
            return value
        try:
            first, colon, end = str(value).partition(":")
            seeds = list(range(int(first), int(end) if colon else int(first) + 1))
        except ValueError:
            self.fail(f"'{value}' is not A:B with whole numbers", param, ctx)
        if not seeds or seeds[0] < 0:
            self.fail(f"'{value}' holds no seeds (A:B is half-open, A ≥ 0)", param, ctx)
        return seeds


SPEED = Quantities("m/s")
LENGTH = Quantities("m")


def _flat(values: tuple[Any, ...]) -> list[Any]:
    return [v for group in values for v in group]


@click.command("benchmark")
@click.option(
    "--surface", "csvs", multiple=True, metavar="CSV", help="Profile with columns x_m,height_m, or a name."
)
@click.option("--plant", metavar="TOML", help="Plant, stand-off, [pose], [sensor] of your own.")
@click.option("--speed", type=SPEED, multiple=True, help="Lateral speeds [m/s, or 100mm/s].")
@click.option(
    "--lead",
    type=LENGTH,
    multiple=True,
    help="Distances of the sensor ahead of the tool [m, or 50mm]. Results of different leads do not compare.",
)
@click.option(
    "--seeds",
    type=Seeds(),
    default="0:20",
    show_default=True,
    help="Test seeds from A up to, but without, B.",
)
@click.option("--methods", help="Methods to run, comma-separated; NAME=module:factory adds a follower.")
@click.option("--sweeps/--no-sweeps", default=None, help="Latency, noise, plant… (default: full table only).")
@click.option(
    "--criteria",
    is_flag=True,
    help="Also the special trials and each acceptance criterion; exit 1 when one is missed.",
)
@click.option("--bars", is_flag=True, hidden=True, help="The name of --criteria before this release.")
@JSON
@click.option("--out", "folder", metavar="DIR", help="Write results, table, plots; remember tunings.")
@click.option(
    "--processes", default=2, show_default=True, type=click.IntRange(1, 64), help="Processes at a time."
)
@click.option("--list", "only_list", is_flag=True, help="List surfaces and methods, run nothing.")
def benchmark_command(
    csvs: tuple[str, ...],
    plant: str | None,
    speed: tuple[list[float], ...],
    lead: tuple[list[float], ...],
    seeds: list[int],
    methods: str | None,
    sweeps: bool | None,
    criteria: bool,
    bars: bool,
    as_json: bool,
    folder: str | None,
    processes: int,
    only_list: bool,
) -> None:
    """Run following methods against each other, exactly repeatably.

    Without options: the full table, every surface, speed and lead.
    """
    from surffollow.benchmark import evaluation

    if only_list:
        found = evaluation.listing()
        texts = [f"{what}: {', '.join(names)}" for what, names in found.items()]
        click.echo(json.dumps(found) if as_json else "\n".join(texts))
        return
    request = evaluation.Request(
        surfaces=list(csvs),
        plant=plant,
        speeds_mps=_flat(speed),
        leads_m=_flat(lead),
        seeds=seeds,
        methods=_methods(methods),
        sweeps=sweeps,
        criteria=criteria or bars,
        folder=folder,
        processes=processes,
    )
    with ended_by_signals():  # its processes end with it
        outcome = evaluation.run(request, _Progress())
    click.echo(json.dumps(outcome.json, allow_nan=False) if as_json else outcome.text)
    sys.exit(0 if outcome.passed else 1)


def _methods(text: str | None) -> list[str]:
    """The methods of an option; none when it is not given."""
    found = [m.strip() for m in (text or "").split(",") if m.strip()]
    if text is not None and not found:
        raise UsageError("--methods names no method; leave it out to run all of them")
    return found


LINE_EVERY_S = 30.0  # where no terminal listens


class _Progress:
    """Shows how far a stage is: in place on a terminal, as a line every half minute elsewhere."""

    def __init__(self) -> None:
        self._next_s = time.monotonic() + LINE_EVERY_S
        self._shown = False  # a line of the present stage, which its last one follows

    def __call__(self, stage: str, done: int, total: int) -> None:
        now_s = time.monotonic()
        if sys.stderr.isatty():
            end = "\n" if done == total else ""
            sys.stderr.write(f"\r{stage}: {done}/{total}{end}")
        elif now_s >= self._next_s or (self._shown and done == total):
            self._next_s, self._shown = now_s + LINE_EVERY_S, done < total
            sys.stderr.write(f"{stage}: {done}/{total}\n")
        sys.stderr.flush()
