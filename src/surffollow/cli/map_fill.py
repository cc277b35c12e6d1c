"""`surffollow map fill`: close the holes of a map, and cut it."""

from __future__ import annotations

import click

from surffollow.cli.clipped_heights import warn_of_clipped
from surffollow.cli.facts import print_facts
from surffollow.cli.map_facts import map_facts
from surffollow.cli.option_types import JSON, POSITIVE_LENGTH, InputFile, OutputFile
from surffollow.cli.output_checks import check_outputs
from surffollow.cli.progress import shows_compiling
from surffollow.cli.scan_options import REGION


@click.command("fill")
@click.argument("file", type=InputFile())
@click.option("-o", "--output", required=True, type=OutputFile(), help="Map file to write.")
@click.option("--width", required=True, type=POSITIVE_LENGTH, help="Widest hole along x or y that is filled.")
@REGION
@JSON
@shows_compiling
def fill_command(
    file: str, output: str, width: float, region: tuple[float, ...] | None, as_json: bool
) -> None:
    """Fill holes of a map linearly between known grids; with --region cut it, too.

    Known heights stay as they are. Filled grids are priors (count 0). Heights of a raster count as one
    sample each, which distinguishes both; a format without counts does not keep that.
    """
    from surffollow.map import HeightMap
    from surffollow.map.files import check_suffix, export
    from surffollow.scan.grid import MEASURED, TerrainGrid
    from surffollow.scan.holes import fill_holes
    from surffollow.scan.map_file import read_ground

    check_suffix(output)
    check_outputs((output,), (file,))
    ground, source = read_ground(file)
    counts = (ground.cells == MEASURED).astype("uint8") if source is None else source.counts
    # counts take the place of the kinds of cells, so that they are cut alike
    whole = TerrainGrid(fill_holes(ground, width).heights_m, ground.origin_m, ground.grid_m, counts)
    before, part = (ground, whole) if region is None else (ground.window(region), whole.window(region))
    made = HeightMap.from_heights(
        part.heights_m,
        origin_m=part.origin_m,
        grid_m=part.grid_m,
        counts=part.cells,
        quantum_m=None if source is None else source.quantum_m,
        datum_m=None if source is None else source.datum_m,
    )
    export(output, made.header, made.pairs)
    print_facts(map_facts(made) | {"known_before": int(before.known.sum())}, as_json, digits=9)
    if source is not None:
        warn_of_clipped(source.header)
