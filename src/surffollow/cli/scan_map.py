"""`surffollow scan map` and `scan compose`."""

from __future__ import annotations

import click

from surffollow.cli.facts import print_facts
from surffollow.cli.option_types import JSON, LENGTH, POSITIVE_LENGTH
from surffollow.cli.output_checks import check_outputs
from surffollow.cli.progress import progress_bar, shows_compiling
from surffollow.cli.scan_options import EXISTING, OUT, PICTURE, REGION, check_picture
from surffollow.errors import ScanInputError


@click.command("map")
@click.argument("depths", nargs=-1, required=True, type=EXISTING)
@click.option("-o", "--output", required=True, type=OUT, help="Map file to write (.npz, .txt).")
@click.option("--cameras", type=EXISTING, help="TOML file of cameras by image name.")
@click.option("--grid", type=POSITIVE_LENGTH, default="5mm", show_default=True, help="Side of a cell.")
@REGION
@click.option(
    "--filter",
    "filter_name",
    type=click.Choice(["cpf", "cpf-fast", "gaussian", "median", "none"]),
    default="cpf",
    show_default=True,
    help="Filter of depth images; cpf: conditional planar filter.",
)
@click.option(
    "--window",
    type=click.IntRange(3, 63),
    default=9,
    show_default=True,
    help="Side of the filter's window [pixels], odd.",
)
@click.option("--fill", type=POSITIVE_LENGTH, help="Widest hole that is filled.  [default: 10 cells]")
@click.option(
    "--support",
    type=LENGTH,
    default="10cm",
    show_default=True,
    help="Patches higher above the ground beside them float if ground was seen beneath, else are obstacles.",
)
@click.option(
    "--min-pixels", type=click.IntRange(1), default=50, show_default=True, help="Fewest pixels of a patch."
)
@click.option(
    "--border", type=click.IntRange(0, 64), default=0, show_default=True, help="Pixels left out beside jumps."
)
@PICTURE
@JSON
@shows_compiling
def map_command(
    depths: tuple[str, ...],
    output: str,
    cameras: str | None,
    grid: float,
    region: tuple[float, ...] | None,
    filter_name: str,
    window: int,
    fill: float | None,
    support: float,
    min_pixels: int,
    border: int,
    picture: str | None,
    as_json: bool,
) -> None:
    """Make a terrain map of DEPTHS: depth images (.npz, .tif; with --cameras) and clouds (.ply, .las)."""
    from pathlib import Path

    from surffollow.scan.cloud_files import CLOUD_SUFFIXES, read_cloud
    from surffollow.scan.grid import MIN_CELLS
    from surffollow.scan.image_files import read_images
    from surffollow.scan.surveying import SurveySettings, survey

    if picture:
        check_picture(picture)
    check_outputs((output, picture), (cameras, *depths))
    settings = SurveySettings(
        grid_m=grid,
        region=region,
        filter=filter_name,
        window=window,
        min_pixels=min_pixels,
        support_m=support,
        border_px=border,
        fill_m=fill,
    )
    clouds = [d for d in depths if Path(d).suffix.lower() in CLOUD_SUFFIXES]
    images = read_images([d for d in depths if d not in clouds], cameras)
    with progress_bar("mapping") as progress:
        ground, report = survey(images, [read_cloud(c) for c in clouds], settings, progress)
        rows, cols = ground.shape
        if min(rows, cols) < MIN_CELLS:
            raise ScanInputError(
                f"a grid of {ground.grid_m:g} m makes {rows} × {cols} cells of the ground that is seen; at "
                f"least {MIN_CELLS} × {MIN_CELLS} are needed: choose a finer --grid (is the unit metres?)"
            )
        ground.to_map().save(output)
    if picture:
        from surffollow.scan.pictures import draw_map

        draw_map(picture, ground)
    facts = {"map": output, "rows": rows, "cols": cols, "grid_m": ground.grid_m, "extent_m": ground.extent_m}
    print_facts(facts | report, as_json)
    if report["covered"]:
        click.echo(
            f"warning: {report['covered']} cells stay unknown beneath what was seen above the ground and "
            "dropped; a path over them is flagged unknown_beneath, and keeps no gap from what is there",
            err=True,
        )


@click.command("compose")
@click.argument("stations", type=EXISTING)
@click.option("-o", "--output", required=True, type=OUT, help="Map file to write (.npz, .txt).")
@click.option("--grid", type=POSITIVE_LENGTH, help="Side of a cell.  [default: the finest of the stations]")
@REGION
@click.option("--fill", type=POSITIVE_LENGTH, help="Widest hole that is filled.  [default: 10 cells]")
@PICTURE
@JSON
@shows_compiling
def compose_command(
    stations: str,
    output: str,
    grid: float | None,
    region: tuple[float, ...] | None,
    fill: float | None,
    picture: str | None,
    as_json: bool,
) -> None:
    """Make one map of the maps of several STATIONS: a TOML file of map files and their poses.

    Reports how far the maps differ where they overlap: a median that is not near 0 is an error of a pose.
    In cells that differ by more than the noise explains (`disputed`) the highest map counts.
    """
    from pathlib import Path

    from surffollow.scan.composing import composed_stations
    from surffollow.scan.stations import overlaps, read_stations

    if picture:
        check_picture(picture)
    read = read_stations(stations)
    check_outputs((output, picture), (stations, *(Path(stations).parent / s.name for s in read)))
    side = grid if grid is not None else min(s.ground.grid_m for s in read)
    parts = [(s.ground, s.common_from_station) for s in read]
    widest = fill if fill is not None else 10.0 * side
    ground, disputed = composed_stations(parts, side, region=region, fill_m=widest)
    ground.to_map().save(output)
    if picture:
        from surffollow.scan.pictures import draw_map

        draw_map(picture, ground)
    rows, cols = ground.shape
    facts = {"map": output, "stations": len(read), "rows": rows, "cols": cols, "grid_m": ground.grid_m}
    both = overlaps(read)
    print_facts(facts | {"extent_m": ground.extent_m, "overlaps": both, "disputed": disputed}, as_json)
