"""`surffollow scan plan` and `scan check`."""

from __future__ import annotations

import json
import sys

import click

from surffollow.cli.facts import print_facts
from surffollow.cli.option_types import JSON, POSITIVE_LENGTH, Finite
from surffollow.cli.output_checks import check_outputs
from surffollow.cli.progress import shows_compiling
from surffollow.cli.scan_options import (
    ACCELERATION,
    ANGLE,
    EXISTING,
    LIVE,
    OUT,
    PICTURE,
    REGION,
    SPEED,
    Numbers,
    check_picture,
    gap_of,
    ground_of,
    known_region,
)

SLOW_SAMPLES = 60_000  # from so many on the planner says how long it may take

_SLOWER = "choose a lower --speed or a higher --acceleration"
REMEDIES = {
    "clearance": "choose a larger --gap",
    "between_rows": "choose a larger --gap",
    "wrist": "choose a larger --wrist",
    "reach": "choose a smaller --region or a larger --reach",
    "speed": _SLOWER,
    "climb": _SLOWER,
    "vertical_acceleration": "or with a higher --vertical-acceleration",
    "tilt_rate": _SLOWER,
    "turn_rate": _SLOWER,
    "acceleration": _SLOWER,
    "lateral": _SLOWER,
    "unplanned": "or map more ground around the region",
    "swath": "choose a smaller --swath",
    "coverage": "choose a smaller --swath, or a --region on known ground",
}


def _fill_note(map_file: str | None, fill_m: float) -> str:
    """Where the filled heights are not known, and the command that writes them."""
    return (
        "note: scan check and scan run with the map as it is refuse a path over holes that --fill filled; "
        f"write the filled map (surffollow map fill {map_file or 'MAP'} --width {fill_m:g} -o FILLED.npz), "
        "and plan, check and run with it"
    )


@click.command("plan")
@click.argument("map_file", metavar="[MAP]", required=False, type=EXISTING)
@LIVE
@click.option("-o", "--output", required=True, type=OUT, help="Path file to write (.csv).")
@REGION
@click.option("--gap", type=POSITIVE_LENGTH, required=True, help="Scanning gap between body and ground [m].")
@click.option("--body", default="disc:0.1", show_default=True, help="disc:R, ring:R, rectangle:LxW or point.")
@click.option(
    "--swath", type=POSITIVE_LENGTH, help="Distance of passes.  [default: the body's width across them]"
)
@click.option(
    "--scheme",
    type=click.Choice(["lanes", "arcs"]),
    default="lanes",
    show_default=True,
    help="Passes along straight lanes, or along arcs about the arm's base.",
)
@click.option("--angle", type=ANGLE, default="0deg", show_default=True, help="Direction of lanes.")
@click.option("--base", type=Numbers(2, 3), help="x,y[,z] of the arm's base joint; arcs need it.")
@click.option("--reach", type=Numbers(1, 2), help="[least,]most distance of the tip from the base.")
@click.option("--speed", type=SPEED, default="0.5", show_default=True, help="Greatest speed [m/s].")
@click.option(
    "--acceleration",
    type=ACCELERATION,
    default="2.66",
    show_default=True,
    help="Greatest acceleration along and across the path [m/s²].",
)
@click.option(
    "--vertical-acceleration",
    type=ACCELERATION,
    help="Greatest acceleration up and down [m/s²].  [default: that of --acceleration]",
)
@click.option("--wrist", type=ANGLE, default="45deg", show_default=True, help="Limit of both wrist angles.")
@click.option(
    "--following",
    type=click.Choice(["atf", "reactionary"]),
    default="atf",
    show_default=True,
    help="Turn and lift the body, or lift only.",
)
@click.option(
    "--lateral-mode",
    type=Finite(0.0, 50.0),
    default=0.0,
    help="Frequency [Hz] of the arm sideways, at which x and y are shaped (ZVD).  [default: not shaped]",
)
@click.option(
    "--damping", type=Finite(0.0, 0.9), default=0.04, show_default=True, help="Damping ratio of that mode."
)
@click.option(
    "--fill",
    type=POSITIVE_LENGTH,
    help="Fill holes of the map up to this width first, for this plan only (see `map fill`).",
)
@PICTURE
@JSON
@shows_compiling
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
    vertical_acceleration: float | None,
    wrist: float,
    following: str,
    lateral_mode: float,
    damping: float,
    fill: float | None,
    picture: str | None,
    as_json: bool,
) -> None:
    """Plan a scan over MAP, write its path file and check it; parts that cannot be planned are flagged.

    Exit code 1: `scan check` refuses the path. Standard error says why; the file is there to be looked at.
    """
    from surffollow.scan.body import parse_body
    from surffollow.scan.check import check_path
    from surffollow.scan.holes import fill_holes
    from surffollow.scan.limits import Annulus, WristLimits
    from surffollow.scan.path_file import write_path
    from surffollow.scan.plan import PlanSettings, plan_scan
    from surffollow.scan.plan_size import SAMPLES_PER_S, refuse_large_plan
    from surffollow.scan.plan_summary import plan_figures
    from surffollow.scan.shaping import Shaper
    from surffollow.scan.swath import swath_warning
    from surffollow.scan.timing import MotionLimits

    if picture:
        check_picture(picture)
    check_outputs((output, picture), (map_file,))
    ground = ground_of(map_file, live, gap)
    if fill is not None:
        known, ground = int(ground.known.sum()), fill_holes(ground, fill)
        if ground.known.sum() > known:
            click.echo(_fill_note(map_file, fill), err=True)
    space = None
    if reach is not None:
        if base is None:
            raise click.UsageError("--reach needs --base")
        place = (base[0], base[1], base[2] if len(base) > 2 else 0.0)
        space = Annulus(place, radius_max_m=reach[-1], radius_min_m=reach[0] if len(reach) > 1 else 0.0)
    settings = PlanSettings(
        region=region if region is not None else known_region(ground),
        gap_m=gap,
        body_m=parse_body(body),
        swath_m=swath,
        scheme=scheme,
        angle_rad=angle,
        base_m=base,
        following=following,
        wrist=WristLimits.symmetric(wrist),
        motion=MotionLimits(
            speed_mps=speed,
            acceleration_mps2=acceleration,
            lateral_mps2=acceleration,
            vertical_mps2=acceleration if vertical_acceleration is None else vertical_acceleration,
        ),
        work_space=space,
        shaper=Shaper.zvd(lateral_mode, damping) if lateral_mode > 0.0 else None,
    )
    samples = refuse_large_plan(settings, ground.grid_m)
    if samples > SLOW_SAMPLES:
        minutes = samples / SAMPLES_PER_S / 60.0
        click.echo(f"planning about {samples:.2g} samples; this may take {minutes:.0f} min", err=True)
    plan = plan_scan(ground, settings)
    write_path(output, plan)
    if picture:
        from surffollow.scan.pictures import draw_plan

        draw_plan(picture, ground, plan)
    warning = swath_warning(plan)
    if warning:
        click.echo(f"warning: {warning}", err=True)
    findings = check_path(ground.heights_m, ground.origin_m, ground.grid_m, output)
    warned = [f for f in findings if f.ok and f.warning]
    for f in warned:
        if f.name != "swath":  # the planner's own warning says more
            click.echo(f"warning: {f.name}: {f.text}", err=True)
    names = [f.name for f in warned]
    said = {"warnings": names if as_json else ", ".join(names) or "none"}
    print_facts({"path": output} | plan_figures(plan) | said, as_json)
    refused = [f for f in findings if not f.ok]
    for f in refused:
        remedy = REMEDIES.get(f.name, "report this plan as a fault of the planner")
        click.echo(f"error: scan check refuses {output}: {f.name}: {f.text}; {remedy}", err=True)
    if refused:
        sys.exit(1)


@click.command("check")
@click.argument("files", nargs=-1, required=True, metavar="[MAP] PATH", type=EXISTING)
@LIVE
@click.option(
    "--vertical-acceleration",
    type=ACCELERATION,
    help="Greatest acceleration up and down [m/s²].  [default: that of the file, if it has one]",
)
@JSON
@shows_compiling
def check_command(
    files: tuple[str, ...], live: str | None, vertical_acceleration: float | None, as_json: bool
) -> None:
    """Check a path file against MAP: clearance, flags, attitude, limits, coverage. Exit code 1: not accepted.

    Speeds and turn rates may exceed their limits by 2 %, accelerations by 10 %: they are quotients of
    rounded rows.
    A swath that is wider than the body is a warning: it is the sensor's width then. Passes over unknown
    ground are a warning, too. Warnings do not change the exit code.
    """
    from surffollow.scan.check import check_path
    from surffollow.scan.path_file import read_path

    if len(files) != (2 if live is None else 1):
        raise click.UsageError("give MAP and PATH, or --live NAME and PATH")
    ground = ground_of(files[0] if live is None else None, live, gap_of(read_path(files[-1])))
    place = (ground.heights_m, ground.origin_m, ground.grid_m)
    findings = check_path(*place, files[-1], vertical_mps2=vertical_acceleration)
    accepted = all(f.ok for f in findings)
    if as_json:
        rows = [
            {"name": f.name, "ok": f.ok, "value": f.value, "text": f.text, "warning": f.warning}
            for f in findings
        ]
        click.echo(json.dumps({"accepted": accepted, "findings": rows}))
    else:
        for f in findings:
            click.echo(f"{f.mark}  {f.name:<21} {f.text}")
        warned = ", ".join(f.name for f in findings if f.warning)
        click.echo(
            ("accepted" if accepted else "NOT accepted") + (f", with a warning: {warned}" if warned else "")
        )
    if not accepted:
        sys.exit(1)
