"""`surffollow map`: look at map files, export, compose, refocus and compare them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from surffollow.cli.clipped_heights import warn_of_clipped
from surffollow.cli.facts import print_facts
from surffollow.cli.map_facts import map_facts
from surffollow.cli.map_fill import fill_command
from surffollow.cli.map_live import install_command, reset_command, upload_command
from surffollow.cli.option_types import JSON, LENGTH, InputFile, OutputFile, SignedArguments
from surffollow.cli.progress import progress_bar, shows_compiling
from surffollow.errors import UsageError

if TYPE_CHECKING:
    from surffollow.map import HeightMap

_FILE = OutputFile()
_EXISTING = InputFile()
_SHADES = " .:-=+*#%@"


@click.group("map")
def map_group() -> None:
    """Show, export, compose, refocus, fill and compare map files; upload, install and reset a service's map.

    Every command reads the text format of UpLoadMap and .npz (lossless), ESRI ASCII grids and GeoTIFF
    (as a prior, count 0), by their content. Every command writes what the suffix says: .txt .map .npz
    .asc .tif .ply .xyz .las .png .svg .pdf.
    """


map_group.add_command(fill_command)
map_group.add_command(upload_command)
map_group.add_command(install_command)
map_group.add_command(reset_command)


def _load(path: str) -> HeightMap:
    from surffollow.map import HeightMap

    return HeightMap.load(path)


@map_group.command("info")
@click.argument("file", type=_EXISTING)
@JSON
def info_command(file: str, as_json: bool) -> None:
    """Say what a map file holds."""
    m = _load(file)
    print_facts(map_facts(m), as_json, digits=9)
    warn_of_clipped(m.header)


@map_group.command("show")
@click.argument("file", type=_EXISTING)
@click.option(
    "--width", default=72, show_default=True, type=click.IntRange(4, 400), help="Characters per row."
)
@click.option("--counts", "show_counts", is_flag=True, help="Shade by sample counts instead of heights.")
def show_command(file: str, width: int, show_counts: bool) -> None:
    """Draw a map in the terminal: dark is low, ? is unknown, north is up."""
    import numpy as np

    m = _load(file)
    ny, nx = m.shape
    columns = min(width, nx)
    rows = max(1, min(ny, round(columns * ny / nx / 2)))
    values = m.heights_m
    known = np.isfinite(values)
    if show_counts:
        values = np.where(known, m.counts.astype(float), np.nan)
    i = np.arange(ny) * rows // ny
    j = np.arange(nx) * columns // nx
    cell = (i[:, None] * columns + j[None, :])[known]
    n = np.bincount(cell, minlength=rows * columns)
    total = np.bincount(cell, weights=values[known], minlength=rows * columns)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = (total / n).reshape(rows, columns)
    seen = mean[np.isfinite(mean)]
    if not seen.size:
        click.echo(f"nothing is known: none of {nx} × {ny} grids has a height")
        return
    low, high = float(seen.min()), float(seen.max())
    scale = (len(_SHADES) - 1) / (high - low) if high > low else 0.0
    for row in mean[::-1]:
        click.echo("".join("?" if v != v else _SHADES[int((v - low) * scale + 0.5)] for v in row.tolist()))
    unit = "samples" if show_counts else "m"
    click.echo(f"'{_SHADES[0]}' {low:.6g} {unit}  '{_SHADES[-1]}' {high:.6g} {unit}  {nx} × {ny} grids")


@map_group.command("export")
@click.argument("file", type=_EXISTING)
@click.argument("target", type=_FILE)
@JSON
def export_command(file: str, target: str, as_json: bool) -> None:
    """Write a map as TARGET; its suffix says how.

    .txt .map (text) .npz lossless; .asc ESRI ASCII grid; .tif GeoTIFF; .ply mesh; .xyz and .las points of
    known grids; .png .svg .pdf shaded relief and counts of what is known.
    """
    from surffollow.map.files import check_suffix, export

    check_suffix(target)
    m = _load(file)
    with progress_bar("exporting") as progress:
        export(target, m.header, m.pairs, progress=progress)
    if as_json:
        print_facts(map_facts(m) | {"out": target}, as_json)


@map_group.command("compose")
@click.argument("files", nargs=-1, required=True, type=_EXISTING)
@click.option("-o", "--output", required=True, type=_FILE, help="Map file to write.")
@click.option(
    "--grids",
    type=click.IntRange(1, 10**9),
    help="Most grids in the result: coarser ones where the finest map's would be more. Default: the finest "
    "map's grids, as many as the whole area takes, up to 8 times those of all files (or a million).",
)
@click.option("--json", "as_json", is_flag=True, help="Print the facts of the result as JSON.")
@shows_compiling
def compose_command(files: Sequence[str], output: str, grids: int | None, as_json: bool) -> None:
    """Put several maps together into one, weighted by sample counts.

    Where maps differ by more than their noise explains, the highest one counts (`disputed`): it may be an
    obstacle. A thing that was moved is then at both places.
    """
    from surffollow.map.compose import composition
    from surffollow.map.files import check_suffix, export

    check_suffix(output)
    with progress_bar("composing") as progress:
        whole, disputed = composition([_load(f) for f in files], grids=grids, progress=progress)
    export(output, whole.header, whole.pairs)
    print_facts(map_facts(whole) | {"disputed": disputed}, as_json, digits=9)


@map_group.command("refocus", cls=SignedArguments)
@click.argument("file", type=_EXISTING)
@click.argument("region", nargs=4, type=LENGTH, metavar="X_MIN Y_MIN X_MAX Y_MAX")
@click.option("-o", "--output", required=True, type=_FILE, help="Map file to write.")
@click.option(
    "--grids",
    type=click.IntRange(1, 10**9),
    help="Most grids in the result, no fewer than FILE has; default: just so many.",
)
@click.option("--finest", type=LENGTH, help="Finest useful grid; default: the file's.")
@click.option("--json", "as_json", is_flag=True, help="Print the facts of the result as JSON.")
@shows_compiling
def refocus_command(
    file: str,
    region: tuple[float, float, float, float],
    output: str,
    grids: int | None,
    finest: float | None,
    as_json: bool,
) -> None:
    """Lay a map over another region; heights are carried over, counts become 0.

    Grids are as fine as memory (--grids) and --finest allow. Where the size of the grids stays, whole
    grids are moved and no height changes; other sizes are area-weighted means.
    """
    from surffollow.map import HeightMap
    from surffollow.map.files import check_suffix, export

    check_suffix(output)
    m = HeightMap.load(file, grids=grids)
    before, known = m.grid_m, _known(m)
    if finest is not None:
        if not finest > 0:
            raise UsageError(f"--finest must be positive, not {finest}")
        m.header["finest_grid_m"] = finest  # goes into the file, for the next refocus
    m.refocus(region)
    export(output, m.header, m.pairs)
    facts = map_facts(m)
    print_facts({**facts, "grid_before_m": before, "known_before": known}, as_json, digits=9)
    if not as_json:
        click.echo(_kept_text(before, m, finest), err=True)


def _known(m: HeightMap) -> int:
    import numpy as np

    return int(np.isfinite(m.heights_m).sum())


def _kept_text(before_m: float, m: HeightMap, finest: float | None) -> str:
    """Effect of a MapRefocus on the resolution, and the option that changes it."""
    after_m = m.grid_m
    sizes = f"grids of {before_m * 1e3:.6g} mm"
    if abs(after_m - before_m) <= 1e-9 * before_m:
        text = f"{sizes} kept, heights as they were"
        return text if finest is not None else f"{text}; --finest LENGTH lays finer ones"
    text = f"{sizes} became {after_m * 1e3:.6g} mm: heights are area-weighted means"
    if after_m < before_m:
        return f"{text}; no detail is gained until new samples come"
    return f"{text}; --grids N (more memory) keeps finer ones"


@map_group.command("diff")
@click.argument("one", type=_EXISTING)
@click.argument("other", type=_EXISTING)
@click.option("--limit", type=LENGTH, help="Exit with 1 when any grid differs by more.")
@JSON
@shows_compiling
def diff_command(one: str, other: str, limit: float | None, as_json: bool) -> None:
    """Compare two maps: OTHER minus ONE on the grids of ONE."""
    import numpy as np

    from surffollow.map.compose import difference

    first, second = _load(one), _load(other)
    delta = difference(first, second)
    both = np.isfinite(delta)
    d = delta[both]
    facts = {
        "compared": int(both.sum()),
        "only_one": int((np.isfinite(first.heights_m) & ~both).sum()),
        "mean_m": float(d.mean()) if d.size else None,
        "rms_m": float(np.sqrt(np.mean(d**2))) if d.size else None,
        "median_abs_m": float(np.median(np.abs(d))) if d.size else None,
        "max_abs_m": float(np.abs(d).max()) if d.size else None,
        "same_grids": bool(first.shape == second.shape and first.extent_m == second.extent_m),
    }
    print_facts(facts, as_json, digits=9)
    if limit is not None and not (d.size and float(np.abs(d).max()) <= limit):
        sys.exit(1)
