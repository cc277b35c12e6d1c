"""`surffollow calibrate`: a sensor's range table, latency and mount, for `[driver] calibration`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from surffollow.cli.option_types import JSON, SERVICE_NAME, Finite, InputFile, OutputFile

FILE = InputFile(Path, streams=True)
OUT = click.option(
    "--out",
    type=OutputFile(Path),
    required=True,
    help="Calibration file; what it holds of other kinds or channels stays.",
)
CHANNEL = click.option(
    "--channel", type=click.IntRange(0, 7), default=0, show_default=True, help="Channel of the sensor."
)


@click.group("calibrate")
def calibrate_group() -> None:
    """Calibrate a sensor; the file goes into a configuration as [driver] calibration = "FILE"."""


def calibration_there(out: Path, *read: Path | None) -> Any:
    """Read what the file to write holds already; raise before any measurement if it could not be written.

    Parameters
    ----------
    out : Path
        file to write
    read : Path or None
        files that the command reads
    """
    from surffollow.hw.calibration import merged
    from surffollow.map.formats.atomic_file import check_not_read, check_place

    check_not_read(out, *read)
    check_place(out)
    return merged(out)


def print_result(as_json: bool, found: dict[str, Any], text: str) -> None:
    """Print what was found."""
    if as_json:
        print(json.dumps(found, indent=2, allow_nan=False))
    else:
        print(text)


@calibrate_group.command("range")
@click.argument("pairs", type=FILE, required=False)
@click.option("--name", type=SERVICE_NAME, help="Guided: read this service's sensor beside typed distances.")
@click.option("--seconds", type=Finite(min=0.05), default=1.0, show_default=True, help="Guided: mean over.")
@click.option(
    "--unit", default="m", show_default=True, help="Unit of the column true in PAIRS, and of typed distances."
)
@click.option(
    "--indicated-unit",
    help="Unit of the column indicated in PAIRS, where it is a distance.  [default: the driver's, m or V]",
)
@click.option("--plot", type=OutputFile(), help="Draw table and residuals (extra plot).")
@CHANNEL
@OUT
@JSON
def range_command(
    pairs: Path | None,
    name: str | None,
    seconds: float,
    unit: str,
    indicated_unit: str | None,
    plot: str | None,
    channel: int,
    out: Path,
    as_json: bool,
) -> None:
    """Find what a sensor's volts (or metres) mean, from PAIRS: CSV with the columns indicated and true.

    The column indicated has what the driver gives without a calibration: metres for serial, CAN, UDP and
    pushed ranges, volts for an A/D converter (IIO with metres_per_volt = 1).
    """
    import numpy as np

    from surffollow.apps.fit_range import fit_range
    from surffollow.cli.range_pairs import draw_fit, typed_pairs, unit_notes
    from surffollow.config.input_file import contents_are_read
    from surffollow.hw.calibration import merged, save_calibration
    from surffollow.record.csv_cells import read_numbers
    from surffollow.record.figure import check_figure
    from surffollow.units import unit_scale

    if (pairs is None) == (name is None):
        raise click.UsageError("give either PAIRS or --name")
    if indicated_unit is not None and pairs is None:
        raise click.UsageError("--indicated-unit goes with PAIRS; a service tells the driver's unit")
    replaced = any(t.channel == channel for t in calibration_there(out, pairs).tables)
    if plot:
        check_figure(plot)
    scale = unit_scale(unit, "m")
    if pairs is not None:
        indicated, true = read_numbers(pairs, ("indicated", "true"))
        if indicated_unit is not None:
            indicated = unit_scale(indicated_unit, "m") * indicated
    else:
        indicated, true = map(np.array, typed_pairs(str(name), channel, seconds, unit))
    true_m = scale * true
    with contents_are_read():
        fit = fit_range(indicated, true_m, channel)
    notes = unit_notes(fit.table)
    if replaced and pairs is None:
        notes.append(
            f"the table of channel {channel} that {out} had is replaced; if service {name!r} runs with it, "
            "the new one is wrong: start it without `calibration`, and measure again"
        )
    about = {
        f"range {channel}": {
            "method": fit.method,
            "pairs": len(indicated),
            "residuals_m": list(fit.residuals_m),
        }
    }
    save_calibration(out, merged(out, tables=(fit.table,), about=about))
    driver_unit = "m" if indicated_unit else "m or V"
    if plot:
        draw_fit(plot, indicated, true_m, fit, driver_unit)
    worst_m = max(map(abs, fit.residuals_m), default=0.0)
    inner = np.unique(indicated)[1:-1]
    worst_at = float(inner[int(np.argmax(np.abs(fit.residuals_m)))])
    print_result(
        as_json,
        {
            "method": fit.method,
            "residuals_m": list(fit.residuals_m),
            "rms_m": fit.rms_m,
            "out": str(out),
            "notes": notes,
        },
        f"{fit.method} through {len(indicated)} pairs; each pair against the curve without it: RMS "
        f"{1e3 * fit.rms_m:.3g} mm, worst {1e3 * worst_m:.3g} mm where {worst_at:.6g} {driver_unit} is "
        f"indicated; wrote {out}" + "".join(f"\nnote: {note}" for note in notes),
    )


@calibrate_group.command("latency")
@click.argument("move", type=FILE, required=False)
@click.option("--name", type=SERVICE_NAME, help="Take what this service's follower has learned instead.")
@OUT
@JSON
def latency_command(move: Path | None, name: str | None, out: Path, as_json: bool) -> None:
    """Find the age of distances from MOVE, up and down over one spot: CSV with t_s, z_m and range_m."""
    from surffollow.config.input_file import contents_are_read
    from surffollow.errors import FaultError
    from surffollow.hw.calibration import merged, save_calibration

    calibration_there(out, move)
    if (move is None) == (name is None):
        raise click.UsageError("give either MOVE or --name")
    if move is not None:
        from surffollow.apps.fit_latency import fit_latency
        from surffollow.record.csv_cells import read_numbers

        t_s, z_m, range_m = read_numbers(move, ("t_s", "z_m", "range_m"))
        with contents_are_read():
            fit = fit_latency(t_s, z_m, t_s, range_m)
        latency_s, found = fit.latency_s, {"sigma_s": fit.sigma_s, "scatter_m": fit.scatter_m}
    else:
        from surffollow.client import observe

        with observe(str(name)) as watcher:
            reported = watcher.status()["follower"].get("latency_s")
        if reported is None:
            raise FaultError(
                f"service {name!r} has learned no latency; it does in mode adaptive, on an approach or a "
                "move up and down over one spot"
            )
        latency_s, found = float(reported), {}
    save_calibration(out, merged(out, latency_s=latency_s, about={"latency": found}))
    more = f" ± {1e3 * found['sigma_s']:.2f} ms" if found else ", as the follower learned it"
    print_result(
        as_json,
        {"latency_s": latency_s, **found, "out": str(out)},
        f"latency {1e3 * latency_s:.2f} ms{more}; wrote {out}",
    )


@calibrate_group.command("mount")
@click.argument("moves", type=FILE)
@CHANNEL
@OUT
@JSON
def mount_command(moves: Path, channel: int, out: Path, as_json: bool) -> None:
    """Find where a sensor sits from MOVES over a flat plate: CSV with x y z qx qy qz qw range_m."""
    import math

    import numpy as np

    from surffollow.apps.fit_mount import fit_mount
    from surffollow.config.input_file import contents_are_read
    from surffollow.hw.calibration import merged, save_calibration
    from surffollow.hw.driver import IDENTITY
    from surffollow.record.csv_cells import read_numbers

    there = calibration_there(out, moves)
    *poses, range_m = read_numbers(moves, ("x", "y", "z", "qx", "qy", "qz", "qw", "range_m"))
    with contents_are_read():
        fit = fit_mount(np.array(poses).T, range_m)
    mounts = list(there.mounts or ())
    mounts += [IDENTITY] * (channel + 1 - len(mounts))
    mounts[channel] = fit.mount
    about = {
        f"mount {channel}": {"covariance": fit.covariance, "plate": fit.plate, "scatter_m": fit.scatter_m}
    }
    save_calibration(out, merged(out, mounts=tuple(mounts), about=about))
    sigma = np.sqrt(np.diag(np.array(fit.covariance)))
    x, y, z = (1e3 * v for v in fit.mount[:3])
    print_result(
        as_json,
        {"mount": fit.mount, "covariance": fit.covariance, "scatter_m": fit.scatter_m, "out": str(out)},
        f"mount x {x:.2f} ± {1e3 * sigma[0]:.2g}, y {y:.2f} ± {1e3 * sigma[1]:.2g}, z {z:.2f} ± "
        f"{1e3 * sigma[2]:.2g} mm; beam ± {math.degrees(max(sigma[3:])):.2g} deg; wrote {out}",
    )
