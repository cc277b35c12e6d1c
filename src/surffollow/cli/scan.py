"""`surffollow scan`: depth images to a terrain map, a map to a path, and an independent check of it."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Any

import click

from surffollow.cli.map import LENGTH, progress_bar
from surffollow.cli.scan_field import calibrate_command, demo_command
from surffollow.cli.values import SERVICE_NAME
from surffollow.errors import UsageError
from surffollow.units import parse_quantity

if TYPE_CHECKING:
    from surffollow.scan.grid import TerrainGrid

_OUT = click.Path(dir_okay=False)
_EXISTING = click.Path(exists=True, dir_okay=False)


class Quantity(click.ParamType):  # type: ignore[type-arg]  # generic only in click 8.3's stubs
    """A number with a unit of one dimension."""

    def __init__(self, unit: str, name: str) -> None:
        self.unit, self.name = unit, name

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """SI number, or fail with what was expected."""
        if isinstance(value, float):
            return value
        try:
            return parse_quantity(str(value), self.unit)
        except UsageError as error:
            self.fail(str(error), param, ctx)


ANGLE, SPEED, ACCELERATION = (
    Quantity("rad", "ANGLE"),
    Quantity("m/s", "SPEED"),
    Quantity("m/s^2", "ACCELERATION"),
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
            made = tuple(parse_quantity(v, "m") for v in str(value).replace(",", " ").split())
        except UsageError as error:
            self.fail(str(error), param, ctx)
        if len(made) not in self.counts:
            wanted = " or ".join(map(str, self.counts))
            self.fail(f"{len(made)} lengths given; expected {wanted}, separated by commas", param, ctx)
        return made


_REGION = click.option("--region", type=Numbers(4), help="x_min,y_min,x_max,y_max.")
_JSON = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
_PICTURE = click.option("--picture", type=_OUT, help="Draw a PNG (extra `plot`).")
_LIVE = click.option("--live", type=SERVICE_NAME, help="The map of this running service, in place of MAP.")


@click.group("scan")
def scan_group() -> None:
    """Map ground from depth images, plan a scan over a map, check the plan; demonstrate it in simulation.

    MAP is any file that `surffollow map` reads, or --live NAME: a service's map as it is now.
    """


@scan_group.command("map")
@click.argument("depths", nargs=-1, required=True, type=_EXISTING)
@click.option("-o", "--output", required=True, type=_OUT, help="Map file to write (.npz, .txt).")
@click.option("--cameras", type=_EXISTING, help="TOML file of cameras by image name.")
@click.option("--grid", type=LENGTH, default="5mm", show_default=True, help="Side of a cell.")
@_REGION
@click.option(
    "--filter",
    "filter_name",
    type=click.Choice(["cpf", "cpf-fast", "gaussian", "median", "none"]),
    default="cpf",
    show_default=True,
    help="Of depth images.",
)
@click.option("--window", type=click.IntRange(3, 63), default=9, show_default=True, help="Pixels, odd.")
@click.option("--fill", type=LENGTH, help="Widest hole that is filled.  [default: 10 cells]")
@click.option("--support", type=LENGTH, default="10cm", show_default=True, help="Patches higher up float.")
@click.option("--min-pixels", type=click.IntRange(1), default=50, show_default=True, help="Of a patch.")
@click.option(
    "--border", type=click.IntRange(0, 64), default=0, show_default=True, help="Pixels left out beside jumps."
)
@_PICTURE
@_JSON
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
    from surffollow.scan.image_files import read_images
    from surffollow.scan.surveying import SurveySettings, survey

    if picture:
        _check_picture(picture)
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
        ground.to_map().save(output)
    if picture:
        from surffollow.scan.pictures import draw_map

        draw_map(picture, ground)
    rows, cols = ground.shape
    facts = {"map": output, "rows": rows, "cols": cols, "grid_m": ground.grid_m, "extent_m": ground.extent_m}
    _print(facts | report, as_json)


@scan_group.command("plan")
@click.argument("map_file", metavar="[MAP]", required=False, type=_EXISTING)
@_LIVE
@click.option("-o", "--output", required=True, type=_OUT, help="Path file to write (.csv).")
@_REGION
@click.option("--gap", type=LENGTH, required=True, help="Scanning gap.")
@click.option("--body", default="disc:0.1", show_default=True, help="disc:R, ring:R, rectangle:LxW or point.")
@click.option("--swath", type=LENGTH, help="Distance of passes.  [default: the body's width]")
@click.option("--scheme", type=click.Choice(["lanes", "arcs"]), default="lanes", show_default=True)
@click.option("--angle", type=ANGLE, default="0deg", show_default=True, help="Direction of lanes.")
@click.option("--base", type=Numbers(2, 3), help="x,y[,z] of the arm's base joint; arcs need it.")
@click.option("--reach", type=Numbers(1, 2), help="[least,]most distance of the tip from the base.")
@click.option("--speed", type=SPEED, default="0.5", show_default=True)
@click.option("--acceleration", type=ACCELERATION, default="2.66", show_default=True)
@click.option("--wrist", type=ANGLE, default="45deg", show_default=True, help="Limit of both wrist angles.")
@click.option(
    "--following",
    type=click.Choice(["atf", "reactionary"]),
    default="atf",
    show_default=True,
    help="Turn and lift the body, or lift only.",
)
@click.option("--fill", type=LENGTH, help="Fill holes of the map up to this width first.")
@_PICTURE
@_JSON
def plan_command(
    map_file: str | None,
    live: str | None,
    output: str,
    region: tuple[float, ...] | None,
    gap: float,
    body: str,
    swath: float | None,
    scheme: str,
    angle: float,
    base: tuple[float, ...] | None,
    reach: tuple[float, ...] | None,
    speed: float,
    acceleration: float,
    wrist: float,
    following: str,
    fill: float | None,
    picture: str | None,
    as_json: bool,
) -> None:
    """Plan a scan over MAP and write its path file; parts that cannot be planned are flagged."""
    from surffollow.scan.body import parse_body
    from surffollow.scan.holes import fill_holes
    from surffollow.scan.limits import Annulus, WristLimits
    from surffollow.scan.path_file import write_path
    from surffollow.scan.plan import PlanSettings, plan_figures, plan_scan
    from surffollow.scan.timing import MotionLimits

    if picture:
        _check_picture(picture)
    ground = _ground(map_file, live)
    if fill is not None:
        ground = fill_holes(ground, fill)
    space = None
    if reach is not None:
        if base is None:
            raise click.UsageError("--reach needs --base")
        place = (base[0], base[1], base[2] if len(base) > 2 else 0.0)
        space = Annulus(place, radius_max_m=reach[-1], radius_min_m=reach[0] if len(reach) > 1 else 0.0)
    plan = plan_scan(
        ground,
        PlanSettings(
            region=region if region is not None else _known_region(ground),
            gap_m=gap,
            body_m=parse_body(body),
            swath_m=swath,
            scheme=scheme,
            angle_rad=angle,
            base_m=base,
            following=following,
            wrist=WristLimits.symmetric(wrist),
            motion=MotionLimits(speed_mps=speed, acceleration_mps2=acceleration, lateral_mps2=acceleration),
            work_space=space,
        ),
    )
    write_path(output, plan)
    if picture:
        from surffollow.scan.pictures import draw_plan

        draw_plan(picture, ground, plan)
    _print({"path": output} | plan_figures(plan), as_json)


@scan_group.command("check")
@click.argument("files", nargs=-1, required=True, metavar="[MAP] PATH", type=_EXISTING)
@_LIVE
@_JSON
def check_command(files: tuple[str, ...], live: str | None, as_json: bool) -> None:
    """Check a path file against MAP: clearance, flags, limits, coverage. Exit code 1: not accepted."""
    from surffollow.scan.check import check_path

    if len(files) != (2 if live is None else 1):
        raise click.UsageError("give MAP and PATH, or --live NAME and PATH")
    ground = _ground(files[0] if live is None else None, live)
    findings = check_path(ground.heights_m, ground.origin_m, ground.grid_m, files[-1])
    accepted = all(f.ok for f in findings)
    if as_json:
        rows = [{"name": f.name, "ok": f.ok, "value": f.value, "text": f.text} for f in findings]
        click.echo(json.dumps({"accepted": accepted, "findings": rows}))
    else:
        for f in findings:
            click.echo(f"{'ok  ' if f.ok else 'FAIL'}  {f.name:<17} {f.text}")
        click.echo("accepted" if accepted else "NOT accepted")
    if not accepted:
        sys.exit(1)


def _ground(map_file: str | None, live: str | None) -> TerrainGrid:
    """The terrain grid of a map file, or of a service as it is now."""
    from surffollow.scan.grid import TerrainGrid

    if (map_file is None) == (live is None):
        raise click.UsageError("give a MAP file or --live NAME")
    if live is not None:
        from surffollow.scan.live_map import live_grid

        return live_grid(live)
    from surffollow.map import HeightMap

    return TerrainGrid.from_map(HeightMap.load(str(map_file)))


def _known_region(ground: TerrainGrid) -> tuple[float, ...]:
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


def _check_picture(path: str) -> None:
    from surffollow.scan.pictures import check_picture

    check_picture(path)


def _print(facts: dict[str, Any], as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps(facts))
        return
    width = max(map(len, facts))
    for key, value in facts.items():
        if isinstance(value, float):
            value = f"{value:.6g}"
        elif isinstance(value, dict):
            value = ", ".join(f"{k} {v}" for k, v in value.items() if v)
        elif isinstance(value, (list, tuple)) and value and isinstance(value[0], dict):
            for one in value:
                patches = ", ".join(f"{n} {k}" for k, n in one.get("patches", {}).items() if n)
                click.echo(f"{one.get('name', key):<{width}}  patches: {patches}")
            continue
        elif isinstance(value, (list, tuple)):
            value = " ".join(f"{v:.6g}" for v in value)
        click.echo(f"{key:<{width}}  {'-' if value is None else value}")


scan_group.add_command(calibrate_command)
scan_group.add_command(demo_command)
