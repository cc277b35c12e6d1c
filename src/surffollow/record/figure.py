"""Common parts of figures: file types, style, shading, scales."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import FaultError, UsageError
from surffollow.extras import install_command
from surffollow.map.formats.atomic_file import replacing
from surffollow.map.formats.axis_labels import label_axis, label_plan

SUFFIXES = (".png", ".svg", ".pdf")
INK, BLUE, ORANGE, GREEN, RED, SAND, GREY = (
    "#22303c",
    "#2b7bba",
    "#d9772b",
    "#3a8f5c",
    "#c0392b",
    "#efe6d6",
    "#8a949c",
)
STYLE: Any = {
    "font.size": 8.5,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.titleweight": "bold",
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": True,
    "legend.framealpha": 0.9,
    "legend.edgecolor": "none",
    "legend.fontsize": 7.5,
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
}
A4_IN = (8.27, 11.69)
# a reading is an outlier when it is so many standard deviations from the median of its neighbours
OUTLIER_SIGMAS, NEIGHBOURS = 8.0, 9
# an axis leaves so many spans of the other values to outliers on either side
OUTLIER_ROOM = 1.0


def check_figure(path: str | Path) -> None:
    """Find out before the work whether a figure can be drawn.

    Raises
    ------
    UsageError  the suffix is of no kind that is drawn
    FaultError  matplotlib is missing
    """
    from importlib.util import find_spec

    if Path(path).suffix.lower() not in SUFFIXES:
        raise UsageError(f"{path}: figures end in {', '.join(SUFFIXES)}; choose one of them")
    if find_spec("matplotlib") is None:
        raise FaultError(f"drawing needs matplotlib: {install_command('plot')}")


def new_figure(size_in: tuple[float, float] = A4_IN) -> Any:
    """An empty figure in this style, without a window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    figure = Figure(figsize=size_in, layout=ConstrainedLayoutEngine(h_pad=0.06, w_pad=0.06))
    FigureCanvasAgg(figure)
    return figure


def time_axes(figure: Any, places: Iterable[Any]) -> list[Any]:
    """Axes in places of a grid, one below the other, with one axis of time."""
    axes = [figure.add_subplot(place) for place in places]
    for ax in axes[1:]:
        ax.sharex(axes[0])
    return axes


def save_figure(figure: Any, path: str | Path) -> None:
    """Write it in the format that the suffix names, atomically.

    Raises
    ------
    MapFileError  the file cannot be written
    """
    suffix = Path(path).suffix.lower()
    # no date in it: the same data make the same file
    metadata: dict[str, dict[str, None]] = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
    drawn = BytesIO()  # matplotlib's PDF hides a full disk behind an error of its own
    figure.savefig(drawn, format=suffix[1:], dpi=150, metadata=metadata.get(suffix))
    with replacing(path) as temporary:
        temporary.write_bytes(drawn.getbuffer())


def length_scale(values: NDArray[np.float64]) -> tuple[float, str]:
    """Factor and unit in which lengths read well: mm below half a metre of spread, else m."""
    finite = values[np.isfinite(values)]
    spread = float(np.ptp(finite)) if finite.size else 0.0
    return (1e3, "mm") if spread < 0.5 else (1.0, "m")


def error_scale(*errors: NDArray[np.float64]) -> tuple[float, str]:
    """Factor and unit of all errors in a figure: mm where those that the axes show are below half a metre."""
    shown = [robust_limits(e) for e in errors if np.isfinite(e).any()]
    return length_scale(np.array([0.0, *itertools.chain(*shown)]))


def spans(t: NDArray[np.float64], where: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Begin and end of each run of samples where something holds; a run ends with the sample after it."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], where, [False])).astype(np.int8)))
    return [(float(t[a]), float(t[min(b, len(t) - 1)])) for a, b in edges.reshape(-1, 2)]


def shade(ax: Any, found: list[tuple[float, float]], color: str, label: str) -> None:
    """Shade spans of time; one entry in the legend. A span narrower than a line is drawn as one.

    Parameters
    ----------
    ax : Axes
    found : list of (begin, end)  in units of the axis
    color, label : str
    """
    from matplotlib.collections import PolyCollection

    if not found:
        return
    # one collection: thousands of spans take a minute one by one
    corners = [((a, 0.0), (a, 1.0), (b, 1.0), (b, 0.0)) for a, b in found]
    place = ax.get_xaxis_transform()
    spans_drawn = PolyCollection(
        corners, facecolor=color, edgecolor=color, lw=1.0, zorder=0, label=label, transform=place
    )
    ax.add_collection(spans_drawn, autolim=False)


def outliers(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which values (NaN: none) lie far from the median of their neighbours, by the usual scatter about it."""
    from scipy.ndimage import median_filter

    found = np.zeros(values.size, bool)
    has = np.flatnonzero(np.isfinite(values))
    if has.size < NEIGHBOURS:
        return found
    off = values[has] - median_filter(values[has], NEIGHBOURS, mode="mirror")
    sigma = 1.4826 * float(np.median(np.abs(off)))
    # a sensor of coarse steps scatters by nothing at all most of the time, and rows may repeat a value
    steps = np.abs(np.diff(values[has]))
    window = NEIGHBOURS - 1
    mean_steps = np.abs(values[has][window:] - values[has][:-window]) / window
    usual = max(float(np.median(steps)), float(np.median(mean_steps)))
    sigma = max(sigma, usual, float(np.percentile(np.abs(off), 90)) / 1.645, 1e-9)
    found[has] = np.abs(off) > OUTLIER_SIGMAS * sigma
    return found


def mark_outliers(
    ax: Any,
    t: NDArray[np.float64],
    values: NDArray[np.float64],
    odd: NDArray[np.bool_],
    limits: tuple[float, float] = (-np.inf, np.inf),
) -> None:
    """Cross them out, with their number in the legend; beyond the limits at the edge.

    Parameters
    ----------
    ax : Axes
    t, values : (n,) float64  in units of the axes
    odd : (n,) bool           the outliers
    limits : (low, high)      of the axis of the values
    """
    n = int(odd.sum())
    if n:
        beyond = int(np.sum((values[odd] < limits[0]) | (values[odd] > limits[1])))
        label = f"{n} outlier{'s' * (n != 1)}" + f", {beyond} beyond the axis" * bool(beyond)
        at = np.clip(values[odd], *limits)
        ax.plot(t[odd], at, "x", ms=5, mew=1.2, color=RED, label=label, clip_on=not beyond)


def limits_beside_outliers(
    values: NDArray[np.float64], odd: NDArray[np.bool_], least: float = 0.0
) -> tuple[float, float]:
    """Limits as `with_room` of all values; outliers count that far out as the other values reach, at most.

    Parameters
    ----------
    values : (n,) float64  in units of the axis; not finite: none
    odd : (n,) bool        the outliers
    least : float          as for `with_room`
    """
    low, high = ends(values[~odd])
    span = max(high - low, least * abs(high))
    if span > 0.0:
        values = np.clip(values, low - OUTLIER_ROOM * span, high + OUTLIER_ROOM * span)
    return with_room(values, least)


def robust_limits(values: NDArray[np.float64], part: float = 99.5) -> tuple[float, float]:
    """Limits of an axis that a few wild values do not set."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return -1.0, 1.0
    low, high = np.percentile(finite, [100.0 - part, part])
    pad = 0.12 * max(high - low, 1e-9)
    return float(low - pad), float(high + pad)


def ends(values: NDArray[np.float64]) -> tuple[float, float]:
    """Least and greatest finite value; 0 and 0 without one."""
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)


def with_room(values: NDArray[np.float64], least: float = 0.0) -> tuple[float, float]:
    """Limits of all values with room for a legend above.

    Parameters
    ----------
    values : float64  in units of the axis; not finite: none
    least : float     spread that is shown at least, as a part of the greatest value
    """
    if not np.isfinite(values).any():
        return 0.0, 1.0
    low, high = ends(values)
    if high - low <= 1e-9 * max(abs(low), abs(high)):
        least = 0.02  # of equal values: ticks with few digits
    span = max(high - low, least * abs(high), 1e-6)
    return low - 0.05 * span, high + 0.38 * span


def rms(values: NDArray[np.float64]) -> float:
    """Root of the mean square of the finite values; NaN without one."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


def draw_map(figure: Any, ax: Any, heights_m: NDArray[np.float64], frame: tuple[float, float, float]) -> str:
    """A shaded map with a scale.

    Parameters
    ----------
    figure, ax : Figure, Axes
    heights_m : (ny, nx) float64 [m]  rows ascend in y, NaN unknown
    frame : (x, y, grid) [m]  outer corner of heights_m[0, 0], and side of a grid

    Returns
    -------
    str   what the title must say beyond: a strip is stretched across
    """
    from surffollow.map.formats.picture import aspect_of, shaded_relief

    x0, y0, grid = frame
    ny, nx = heights_m.shape
    factor, unit = length_scale(heights_m)
    common: dict[str, Any] = {
        "origin": "lower",
        "extent": (x0, x0 + nx * grid, y0, y0 + ny * grid),
        "interpolation": "nearest",
    }
    image = ax.imshow(heights_m * factor, cmap="viridis", **common)
    ax.imshow(shaded_relief(heights_m, grid), cmap="gray", alpha=0.3, vmin=0, vmax=1, **common)
    aspect, remark = aspect_of(ny, nx)
    wide = aspect == "equal" and nx > 2 * ny
    bar = figure.colorbar(image, ax=ax, shrink=0.9, location="bottom" if wide else "right", aspect=25)
    label_axis(bar.ax.xaxis if wide else bar.ax.yaxis, "height", ends(heights_m), factor, unit)
    ax.set_aspect(aspect)
    label_plan(ax, common["extent"])
    return remark
