"""Draw a map: shaded relief and sample counts side by side, as PNG."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import MapFileError
from surffollow.map import access
from surffollow.map.atomic_file import Progress, replacing, report

_MAX_SIDE = 2000


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


def write_png(
    path: str | os.PathLike[str],
    header: NDArray[Any],
    pairs: NDArray[Any],
    *,
    progress: Progress | None = None,
) -> None:
    """Write shaded relief and counts as a PNG (extra `plot`); a large map is thinned to 2000 grids a side."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as e:
        raise MapFileError("PNG needs matplotlib: install the extra 'plot' (surffollow[plot])") from e
    ny, nx = access.shape_of(header)
    w = header[0]
    grid = float(w["grid_m"])
    step = max(1, -(-max(ny, nx) // _MAX_SIDE))
    rows, known = [], []
    for row in range(0, ny, step):
        rows.append(access.metres(header, access.quanta(pairs, row * nx, (row + 1) * nx))[::step])
        known.append(access.counts(pairs, row * nx, (row + 1) * nx)[::step])
        report(progress, 0.5 * row / ny)
    heights, counts = np.array(rows), np.array(known)
    x0, y0 = float(w["x0_m"]), float(w["y0_m"])
    extent = (x0, x0 + nx * grid, y0, y0 + ny * grid)
    figure = Figure(figsize=(11, 5), layout="constrained")
    FigureCanvasAgg(figure)
    relief_axes, count_axes = figure.subplots(1, 2)
    common: dict[str, Any] = {"origin": "lower", "extent": extent, "interpolation": "nearest"}
    relief = relief_axes.imshow(heights * 1e3, cmap="terrain", **common)
    relief_axes.imshow(shaded_relief(heights, grid * step), cmap="gray", alpha=0.45, vmin=0, vmax=1, **common)
    figure.colorbar(relief, ax=relief_axes, label="height [mm]", shrink=0.8)
    shown = np.ma.masked_where(~np.isfinite(heights), counts)
    image = count_axes.imshow(shown, cmap="viridis", vmin=0, **common)
    figure.colorbar(image, ax=count_axes, label="samples per grid", shrink=0.8)
    for axes, title in ((relief_axes, "shaded relief"), (count_axes, "samples (0: prior)")):
        axes.set_title(title)
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
        report(progress, 1.0)
