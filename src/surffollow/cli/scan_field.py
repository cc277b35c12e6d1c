"""`surffollow scan demo` and `scan calibrate`."""

from __future__ import annotations

import json
import sys
from typing import Any

import click

from surffollow.cli.facts import print_facts
from surffollow.cli.option_types import JSON, POSITIVE_LENGTH
from surffollow.cli.progress import shows_compiling
from surffollow.cli.scan_options import EXISTING, OUT


@click.command("demo")
@click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of ground, errors and noise."
)
@click.option(
    "--seeds",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="Number of seeds, run one after another.",
)
@click.option(
    "--ground",
    type=click.Choice(["flat", "bumpy", "hump"]),
    default="bumpy",
    show_default=True,
    help="Form of the ground.",
)
@click.option(
    "--tables",
    is_flag=True,
    help="Also each element switched off, and filter × correction × shaping; means over the seeds.",
)
@click.option("--picture", type=OUT, help="Draw a PNG (extra `plot`).")
@click.option("--report", type=OUT, help="Write one HTML page with figures and picture (extra `plot`).")
@click.option("--signal", type=OUT, help="Write the signal map as a GeoTIFF (extra `geo`).")
@JSON
@shows_compiling
def demo_command(
    seed: int,
    seeds: int,
    ground: str,
    tables: bool,
    picture: str | None,
    report: str | None,
    signal: str | None,
    as_json: bool,
) -> None:
    """Scan a simulated field: survey, filter, map, plan, calibrate, shaped scan, signal map.

    Exit code 1: a limit of the demonstration is exceeded.
    """
    from surffollow.apps.field_demo import demonstrate
    from surffollow.cli.output_checks import check_outputs

    check_outputs((picture, report, signal))
    if signal:
        from surffollow.scan.signals import check_geotiff

        check_geotiff()
    if picture or report:
        from surffollow.scan.pictures import check_picture

        check_picture(picture or "report.png")

    def show_progress(text: str, part: float) -> None:
        click.echo(f"surffollow: {text} ({100 * part:.0f} %)", err=True)

    made = [demonstrate(ground, seed + k, show_progress) for k in range(seeds)]
    facts: dict[str, Any] = {"runs": [m.figures for m in made]}
    if tables:
        from surffollow.apps.field_tables import elements_table, filters_table

        every = range(seed, seed + seeds)
        facts["elements"] = elements_table(every, show_progress)
        facts["filters"] = filters_table(every, show_progress)
    if picture:
        from surffollow.apps.field_pictures import draw_field

        show_progress("picture", 1.0)
        draw_field(picture, made[0])
    if report:
        from surffollow.apps.field_report import write_report

        show_progress("report", 1.0)
        write_report(report, made[0], {k: v for k, v in facts.items() if k != "runs"})
    if signal:
        made[0].signal.save_geotiff(signal)
    if as_json:
        click.echo(json.dumps(facts))
    else:
        _print_runs(facts)
        for name in ("elements", "filters"):
            if name in facts:
                _print_table(facts[name])
    if any(m.figures["failures"] for m in made):
        sys.exit(1)


@click.command("calibrate")
@click.argument("spots", type=EXISTING)
@click.option("-o", "--output", required=True, type=OUT, help="Calibration file to write (.json).")
@click.option("--map", "map_file", type=EXISTING, help="Map of the touched ground; SPOTS then holds x, y, z.")
@click.option(
    "--grid", type=POSITIVE_LENGTH, default="10cm", show_default=True, help="Distance of the matrix' nodes."
)
@click.option(
    "--outside",
    type=click.Choice(["nearest", "unknown"]),
    default="nearest",
    show_default=True,
    help="Correction beyond the spots: that of the nearest one, or none.",
)
@click.option(
    "--model",
    type=click.Choice(["auto", "none", "constant", "plane", "triangles"]),
    default="auto",
    show_default=True,
    help="Model of the correction; auto: the one that left-out spots confirm.",
)
@JSON
def calibrate_command(
    spots: str, output: str, map_file: str | None, grid: float, outside: str, model: str, as_json: bool
) -> None:
    """Make a calibration matrix of touched SPOTS (CSV, metres).

    Columns x_m, y_m, correction_m; with --map x_m, y_m, z_m of the model's tip at contact. The correction
    is that z minus the mapped ground. Model "none" (all zero): left-out spots confirm no correction.
    """
    import math

    import numpy as np

    from surffollow.cli.output_checks import check_outputs
    from surffollow.scan.held_out import choose_matrix
    from surffollow.scan.spot_files import read_spots

    check_outputs((output,), (spots, map_file))
    chosen = choose_matrix(read_spots(spots, map_file), model=model, grid_m=grid, outside=outside)
    made = chosen.matrix
    made.save(output)
    left = made.left_out_m[np.isfinite(made.left_out_m)]
    facts = {
        "calibration": output,
        "spots": len(made.spots_m),
        "rows": made.values_m.shape[0],
        "cols": made.values_m.shape[1],
        "model": chosen.model,
        "held_out_rms_m": {k: v if math.isfinite(v) else None for k, v in chosen.held_out_rms_m.items()},
        "correction_max_m": float(np.abs(made.spots_m[:, 2]).max()),
        "left_out_rms_m": float(np.sqrt((left**2).mean())) if left.size else None,
        "left_out_max_m": float(np.abs(left).max()) if left.size else None,
    }
    if as_json:
        click.echo(json.dumps(facts))
        return
    residuals = {k: "-" if v is None else f"{v:.3g}" for k, v in facts["held_out_rms_m"].items()}
    print_facts(facts | {"held_out_rms_m": residuals}, False)
    if chosen.model == "none" and model == "auto":
        click.echo("surffollow: left-out spots confirm no correction; the matrix is zero", err=True)


def _print_runs(facts: dict[str, Any]) -> None:
    for f in facts["runs"]:
        click.echo(
            f"\n{f['ground']} ground, seed {f['seed']}: gap {1e3 * f['gap_m']:.0f} mm, {f['speed_mps']} m/s"
        )
        for name in ("unshaped", "shaped"):
            r = f[name]
            click.echo(
                f"  {name:<9} gap error P99 {1e3 * r['gap_error_p99_m']:5.1f} mm, mean "
                f"{1e3 * r['gap_error_mean_m']:5.1f} mm, clearance ≥ {1e3 * r['clearance_min_m']:.1f} mm, "
                f"acceleration {r['tip_acceleration_rms_mps2']:.2f} m/s² RMS, {r['duration_s']:.1f} s"
            )
        c, t = f["calibration"], f["target"]
        click.echo(
            f"  calibration: {c['spots']} spots, correction up to {1e3 * c['correction_max_m']:.1f} mm, "
            f"{c['model']}, left-out residual {1e3 * c['left_out_rms_m']:.1f} mm RMS; "
            f"mode {c['mode_hz']:.2f} Hz, "
            f"damping {c['mode_damping']:.3f}"
        )
        click.echo(
            f"  target found {1e3 * t['error_m']:.0f} mm off ({1e3 * t['error_in_map_m']:.0f} mm in the map)"
        )
        for name, r in f["line"].items():
            parts = r.get("residual_part", {})
            wrong = ", ".join(f"{p} f: {100 * v:.0f} %" for p, v in parts.items())
            click.echo(
                f"  line of 2.4 m, {name:<8}: residual ±{1e3 * r['residual_m']:.1f} mm, acceleration "
                f"{r['acceleration_rms_mps2']:.2f} m/s² RMS, after it {r['acceleration_rms_after_mps2']:.2f}"
                f"{'; residual at ' + wrong if wrong else ''}"
            )
        for failure in f["failures"]:
            click.echo(f"  FAIL: {failure}")


def _print_table(rows: list[dict[str, Any]]) -> None:
    names = [
        k for k in rows[0] if k in ("switched_off", "ground", "filter", "speed_mps", "following", "shaping")
    ]
    click.echo(
        "\n"
        + "".join(f"{n:<{30 if n == 'switched_off' else 12}}" for n in names)
        + "P99 mm  worst  RMS mm  laser P99  least mm"
    )
    for r in rows:
        left = "".join(f"{r[n]!s:<{30 if n == 'switched_off' else 12}}" for n in names)
        click.echo(
            f"{left}{1e3 * r['gap_error_p99_m']:6.1f}  {1e3 * r['gap_error_p99_worst_m']:5.1f}  "
            f"{1e3 * r['gap_error_rms_m']:6.1f}  {1e3 * r['laser_error_p99_m']:9.1f}  "
            f"{1e3 * r['clearance_min_m']:8.1f}"
        )
