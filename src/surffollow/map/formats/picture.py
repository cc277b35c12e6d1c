"""Draw a map: shaded relief and sample counts of what is known."""

from __future__ import annotations

import os
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import MapFileError
from surffollow.extras import install_command
from surffollow.map import access
from surffollow.map.formats.atomic_file import FilePath, Progress, replacing, report
from surffollow.map.formats.axis_labels import height_unit, label_axis, label_plan
from surffollow.shm import map_layout as ml

_MAX_SIDE = 800  # as many as a figure has dots
_STRIP = 8  # a map so many times longer than wide is stretched


def shaded_relief(heights_m: NDArray[np.float64], grid_m: float) -> NDArray[np.float64]:
    """Brightness 0 … 1 of a surface lit from the north-west, 45° above it, its relief stretched to show.

    Parameters
    ----------
    heights_m : (ny, nx) float64 [m]      rows ascend in y, NaN unknown
    grid_m : float

    Returns
    -------
    (ny, nx) float64, NaN where unknown
    """
    if min(heights_m.shape) < 2:
        return np.where(np.isfinite(heights_m), 0.7, np.nan)
    mean = np.nanmean(heights_m) if np.isfinite(heights_m).any() else 0.0
    known = np.isfinite(heights_m)
    slope_y, slope_x = np.gradient(np.where(known, heights_m, mean), grid_m)
    valid = known & np.isfinite(slope_x + slope_y)
    typical = np.percentile(np.hypot(slope_x, slope_y)[valid], 90) if valid.any() else 0.0
    stretch = 0.5 / typical if typical > 0 else 1.0
    slope_x, slope_y = stretch * slope_x, stretch * slope_y
    light = (slope_x - slope_y) / np.sqrt(2.0) * np.sqrt(0.5) + np.sqrt(0.5)
    shade = np.clip(light / np.sqrt(1.0 + slope_x**2 + slope_y**2), 0.0, 1.0)
    return np.where(known, shade, np.nan)


def known_bounds(header: NDArray[Any], pairs: NDArray[Any]) -> tuple[int, int, int, int, int] | None:
    """First and end row, first and end column of the grids that are known, and how many are; None: none."""
    ny, nx = access.shape_of(header)
    rows: list[int] = []
    n = 0
    columns = np.zeros(nx, bool)
    for first, last in access.row_blocks(ny, nx, 1 << 20):
        known = access.quanta(pairs, first * nx, last * nx).reshape(-1, nx) != ml.UNKNOWN
        rows += (first + np.flatnonzero(known.any(axis=1))).tolist()
        columns |= known.any(axis=0)
        n += int(known.sum())
    if not rows:
        return None
    across = np.flatnonzero(columns)
    return rows[0], rows[-1] + 1, int(across[0]), int(across[-1]) + 1, n


def _shown(header: NDArray[Any], pairs: NDArray[Any]) -> tuple[int, int, int, int]:
    """Range of a picture: the known grids and a margin of a twentieth about them; all where none is."""
    ny, nx = access.shape_of(header)
    bounds = known_bounds(header, pairs)
    if bounds is None:
        return 0, ny, 0, nx
    r0, r1, c0, c1, _ = bounds
    down, across = max(2, (r1 - r0 + 19) // 20), max(2, (c1 - c0 + 19) // 20)
    return max(0, r0 - down), min(ny, r1 + down), max(0, c0 - across), min(nx, c1 + across)


def aspect_of(ny: int, nx: int) -> tuple[str, str]:
    """How a picture's axes are scaled, and a remark for its title: a strip would else be a line."""
    if max(ny, nx) > _STRIP * min(ny, nx):
        return "auto", f" ({'y' if nx > ny else 'x'} stretched)"
    return "equal", ""


def _thinned(
    header: NDArray[Any], pairs: NDArray[Any], progress: Progress | None
) -> tuple[NDArray[np.float64], NDArray[np.uint8], float, tuple[float, float, float, float]]:
    """Heights and counts of what is shown, spacing and extent [m]; of blocks of a large map."""
    _, nx = access.shape_of(header)
    r0, r1, c0, c1 = _shown(header, pairs)
    step = max(1, -(-max(r1 - r0, c1 - c0) // _MAX_SIDE))
    at = np.arange(0, c1 - c0, step)
    rows, most = [], []
    for row in range(r0, r1, step):
        total, n, count = np.zeros(at.size), np.zeros(at.size), np.zeros(at.size, np.uint8)
        for k in range(row, min(row + step, r1)):
            first, last = k * nx + c0, k * nx + c1
            z = access.metres(header, access.quanta(pairs, first, last))
            known = np.isfinite(z)
            total += np.add.reduceat(np.where(known, z, 0.0), at)
            n += np.add.reduceat(known.astype(np.float64), at)
            count = np.maximum(count, np.maximum.reduceat(access.counts(pairs, first, last), at))
        rows.append(np.divide(total, n, out=np.full(at.size, np.nan), where=n > 0))
        most.append(count)
        report(progress, 0.5 * (row - r0) / (r1 - r0))
    w, grid = header[0], float(header[0]["grid_m"])
    x0, y0 = float(w["x0_m"]), float(w["y0_m"])
    r1, c1 = r0 + len(rows) * step, c0 + at.size * step
    extent = (x0 + c0 * grid, x0 + c1 * grid, y0 + r0 * grid, y0 + r1 * grid)
    return np.array(rows), np.array(most), grid * step, extent


def known_part(m: Any) -> tuple[NDArray[np.float64], tuple[float, float, float]] | None:
    """Heights (ny, nx) [m] of a map's known part with a margin, thinned; x, y of its corner and spacing [m].

    None: no grid is known.
    """
    if known_bounds(m.header, m.pairs) is None:
        return None
    heights, _, spacing, extent = _thinned(m.header, m.pairs, None)
    return heights, (extent[0], extent[2], spacing)


def write_picture(
    path: FilePath, header: NDArray[Any], pairs: NDArray[Any], *, progress: Progress | None = None
) -> None:
    """Write shaded relief and counts as PNG, SVG or PDF by the suffix (extra `plot`).

    Shown is what is known, with a margin; of a large map the means of blocks of grids, at most 800 a side.

    Parameters
    ----------
    path : path          replaced when it exists
    header : (1,) structured `MapHeader`
    pairs : (n,) structured `GridPair`
    progress : callable  as for `map.formats.text_file.write_text`
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from matplotlib.ticker import MaxNLocator
    except ImportError as e:
        raise MapFileError(f"a picture needs matplotlib: {install_command('plot')}") from e
    heights, counts, spacing, extent = _thinned(header, pairs, progress)
    aspect, remark = aspect_of(*heights.shape)
    side = 0.2 if remark else (extent[3] - extent[2]) / (extent[1] - extent[0])
    across = side > 0.4
    size = (11.0, min(7.5, max(3.2, 5.0 * side + 1.0))) if across else (11.0, min(9.0, 22.0 * side + 2.6))
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    relief_axes, count_axes = figure.subplots(*((1, 2) if across else (2, 1)))
    common: dict[str, Any] = {
        "origin": "lower",
        "extent": extent,
        "interpolation": "nearest",
        "aspect": aspect,
    }
    known = np.isfinite(heights)
    spread = float(np.ptp(heights[known])) if known.any() else 0.0
    factor, unit = height_unit(spread)
    relief = relief_axes.imshow(heights * factor, cmap="viridis", **common)
    relief_axes.imshow(shaded_relief(heights, spacing), cmap="gray", alpha=0.35, vmin=0, vmax=1, **common)
    bar = figure.colorbar(relief, ax=relief_axes, shrink=0.8)
    z = heights[known] if known.any() else np.zeros(1)
    label_axis(bar.ax.yaxis, "height", (float(z.min()), float(z.max())), factor, unit)
    shown = np.ma.masked_where(~known, counts)
    # counts are whole numbers from 0, also of a map of priors alone
    most = max(1, int(counts.max(initial=0)))
    image = count_axes.imshow(shown, cmap="cividis", vmin=0, vmax=most, **common)
    ticks = MaxNLocator(integer=True)
    figure.colorbar(image, ax=count_axes, label="samples per grid", shrink=0.8, ticks=ticks)
    grid, n = float(header[0]["grid_m"]), header[0]["nx"] * header[0]["ny"]
    side_text = f"{grid:.4g} m" if grid >= 1.0 else f"{grid * 1e3:.4g} mm"
    bounds = known_bounds(header, pairs)
    for axes, title in (
        (relief_axes, f"Shaded relief, grids of {side_text}{remark}"),
        (count_axes, f"Samples (0: prior); {bounds[4] if bounds else 0} of {n} grids known"),
    ):
        axes.set_title(title, loc="left", fontsize=10, fontweight="bold")
        label_plan(axes, extent)
    with replacing(path) as temporary:
        drawn = BytesIO()  # matplotlib's PDF hides a full disk behind an error of its own
        figure.savefig(drawn, format=os.path.splitext(path)[1].lower()[1:], dpi=130)
        temporary.write_bytes(drawn.getbuffer())
        report(progress, 1.0)
