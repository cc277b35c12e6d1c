"""Series of a figure: lines that end at pauses, and an envelope where there are more rows than pixels."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# a page is about 1100 pixels wide
COLUMNS = 1000
MAX_ROWS = 4 * COLUMNS
PAUSE_INTERVALS = 5.0


class Series(NamedTuple):
    """A series as it is drawn, (n,) each; NaN in a row of its own at each pause.

    Attributes
    ----------
    t_s : time [s]
    low, middle, high : least value, median and greatest value of the rows of a column, NaN without one
    reduced : bool     False: every row is a column of its own
    """

    t_s: NDArray[np.float64]
    low: NDArray[np.float64]
    middle: NDArray[np.float64]
    high: NDArray[np.float64]
    reduced: bool


def pauses(t_s: NDArray[np.float64]) -> NDArray[np.intp]:
    """Rows before a pause: the next row comes later than five usual intervals.

    Parameters
    ----------
    t_s : (n,) float64  ascending [s]
    """
    step = np.diff(t_s)
    usual = float(np.median(step)) if step.size else 0.0
    return np.flatnonzero((step > PAUSE_INTERVALS * usual) & (usual > 0.0))


def drawn_series(
    t_s: NDArray[np.float64], values: NDArray[np.float64], after: NDArray[np.intp] | None = None
) -> Series:
    """A series as it is drawn: all rows, or columns of equal duration when there are more than `MAX_ROWS`.

    Parameters
    ----------
    t_s : (n,) float64     ascending [s]
    values : (n,) float64  NaN: none
    after : (k,) integer   rows before a pause; None: as `pauses` finds them
    """
    after = pauses(t_s) if after is None else after
    n = t_s.size
    if n <= MAX_ROWS:
        values = np.insert(values.astype(np.float64), after + 1, np.nan)
        return Series(np.insert(t_s, after + 1, t_s[after]), values, values, values, False)
    column = np.floor((t_s - t_s[0]) / (t_s[-1] - t_s[0]) * COLUMNS)
    begins = np.diff(column, prepend=-1.0) > 0.0
    begins[after + 1] = True
    first = np.flatnonzero(begins)
    last = np.append(first[1:], n) - 1
    middle = np.array([_median(values[a : b + 1]) for a, b in zip(first, last)])
    # a column before a pause ends with the row before it
    at = np.searchsorted(last, after) + 1
    t = np.insert(0.5 * (t_s[first] + t_s[last]), at, t_s[after])
    columns = (np.fmin.reduceat(values, first), middle, np.fmax.reduceat(values, first))
    low, middle, high = (np.insert(v, at, np.nan) for v in columns)
    return Series(t, low, middle, high, True)


def _median(values: NDArray[np.float64]) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else float("nan")


def reduction(t_s: NDArray[np.float64]) -> str:
    """For the title of a panel: what is drawn of the rows at these times (n,) [s]; "": all of them."""
    if t_s.size <= MAX_ROWS:
        return ""
    return f": median of {(t_s[-1] - t_s[0]) / COLUMNS:.2g} s, shaded from the least to the greatest value"


def draw_series(ax: Any, series: Series, color: str, label: str, lw: float = 0.9, style: str = "-") -> None:
    """Draw a series as a line or as points; where it is reduced, its median and envelope.

    Parameters
    ----------
    ax : Axes
    series : Series   in units of the axes
    color, label : str
    lw : float        width of the line
    style : str       of Matplotlib, for rows that are drawn one by one: "-", ".", ".-"
    """
    if not series.reduced:
        shown = style if series.t_s.size > 1 else "."  # a line of one row is not seen
        ax.plot(series.t_s, series.middle, shown, ms=2.5, lw=lw, color=color, label=label)
        return
    ax.fill_between(series.t_s, series.low, series.high, color=color, alpha=0.3, lw=0)
    ax.plot(series.t_s, series.middle, lw=lw, color=color, label=label)
