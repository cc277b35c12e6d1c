"""Common parts of the commands of `surffollow scan`: option types, choice of the map."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from surffollow.cli.clipped_heights import warn_of_clipped
from surffollow.cli.option_types import SERVICE_NAME, InputFile, OutputFile, Quantity
from surffollow.errors import UsageError
from surffollow.units import parse_quantity

if TYPE_CHECKING:
    from surffollow.scan.grid import TerrainGrid
    from surffollow.scan.path import ScanPath

OUT = OutputFile()
EXISTING = InputFile()
ANGLE, SPEED, ACCELERATION = (
    Quantity("ANGLE", "rad"),
    Quantity("SPEED", "m/s", above=0.0),
    Quantity("ACCELERATION", "m/s^2", above=0.0),
)


class Numbers(click.ParamType):  # type: ignore[type-arg]  # generic only in click 8.3's stubs
    """So many lengths, separated by commas or blanks."""

    name = "LENGTHS"

    def __init__(self, *counts: int) -> None:
        self.counts = counts

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """Metres, or fail with what was expected."""
        if isinstance(value, tuple):
            return value
        try:
            made = tuple(parse_quantity(v, "m", bare=True) for v in str(value).replace(",", " ").split())
        except UsageError as error:
            self.fail(str(error), param, ctx)
        if len(made) not in self.counts:
            expected = " or ".join(map(str, self.counts))
            self.fail(f"{len(made)} lengths given; expected {expected}, separated by commas", param, ctx)
        return made


REGION = click.option("--region", type=Numbers(4), help="x_min,y_min,x_max,y_max.")
PICTURE = click.option("--picture", type=OUT, help="Draw a PNG (extra `plot`).")
LIVE = click.option("--live", type=SERVICE_NAME, help="The map of this running service, in place of MAP.")


def ground_of(map_file: str | None, live: str | None, gap_m: float | None) -> TerrainGrid:
    """The terrain grid of a map file, or of a service as it is now.

    Its heights have to be fine enough for the gap; None: no gap is known.
    """
    if (map_file is None) == (live is None):
        raise click.UsageError("give a MAP file or --live NAME")
    if live is not None:
        from surffollow.scan.live_map import live_ground

        ground, quantum_m = live_ground(live)
    else:
        from surffollow.scan.map_file import read_ground

        ground, m = read_ground(str(map_file))
        quantum_m = 0.0 if m is None else m.quantum_m
        if m is not None:
            warn_of_clipped(m.header)
    if gap_m is not None:
        check_step(quantum_m, gap_m, live if live is not None else str(map_file))
    return ground


def check_step(quantum_m: float, gap_m: float, name: str) -> None:
    """Refuse, or warn of, heights whose step [m] is not small beside the gap [m]."""
    from surffollow.scan.map_file import step_note

    note = step_note(quantum_m, gap_m, name)
    if note:
        click.echo(f"warning: {note}", err=True)


def gap_of(path: ScanPath) -> float | None:
    """The gap that a path was planned with [m]; None: its file has none."""
    gap = path.facts.get("gap_m")
    return None if gap is None else float(gap)


def known_region(ground: TerrainGrid) -> tuple[float, ...]:
    """The rectangle around all known cells."""
    import numpy as np

    row, col = np.nonzero(ground.known)
    if len(row) == 0:
        raise UsageError("the map has no known cell; map the ground first")
    x0, y0 = ground.origin_m
    g = ground.grid_m
    return (
        x0 + int(col.min()) * g,
        y0 + int(row.min()) * g,
        x0 + (int(col.max()) + 1) * g,
        y0 + (int(row.max()) + 1) * g,
    )


def check_picture(path: str) -> None:
    """Fail before the work when a picture cannot be drawn."""
    from surffollow.scan import pictures

    pictures.check_picture(path)
