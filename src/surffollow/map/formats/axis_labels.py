"""Labels of axes far from zero: short ticks about a round origin, which the label names."""

from __future__ import annotations

import math
from typing import Any

# values so many times their spread would need ticks of six digits and more
FAR = 1000.0
_TICKS = 6  # of short labels; long ones print over each other
_IN_MM_M = 0.5  # heights that spread by less are shown in mm


def round_origin(low: float, high: float) -> float:
    """A round number amid values that lie far from zero; 0.0: ticks show the values themselves.

    Parameters
    ----------
    low, high : float   least and greatest value
    """
    span, far = high - low, max(abs(low), abs(high))
    if not (math.isfinite(far) and far > 0.0) or far < FAR * span:
        return 0.0
    # a few spreads, so that the origin has few digits and the ticks do, too
    step = 10.0 ** math.ceil(math.log10(max(span, 1e-9 * far) / 1.5))
    return round((low + high) / 2 / step) * step


def height_unit(spread_m: float) -> tuple[float, str]:
    """Units per metre, and unit, of an axis of heights that spread so far [m]."""
    return (1e3, "mm") if spread_m < _IN_MM_M else (1.0, "m")


def label_axis(
    axis: Any, name: str, limits: tuple[float, float], factor: float = 1.0, unit: str = "m"
) -> None:
    """Label an axis "name [unit]", or "name − origin m [unit]" with ticks that count from there.

    Parameters
    ----------
    axis : Axis      of Matplotlib
    name : str       of the quantity
    limits : floats  least and greatest value [m]
    factor : float   units of the axis per metre
    unit : str       of the axis
    """
    from matplotlib.ticker import MaxNLocator, ScalarFormatter

    origin = round_origin(*limits)
    ticks = ScalarFormatter(useOffset=origin * factor if origin else False)
    ticks.set_scientific(False)
    axis.set_major_formatter(ticks)
    axis.set_major_locator(MaxNLocator(_TICKS, steps=(1, 2, 2.5, 5, 10)))
    axis.get_offset_text().set_visible(False)  # the label has it
    about = f" {'−' if origin > 0.0 else '+'} {abs(origin):.12g} m" if origin else ""
    axis.set_label_text(f"{name}{about} [{unit}]")


def label_plan(
    ax: Any, extent: tuple[float, float, float, float], names: tuple[str, str] = ("x", "y")
) -> None:
    """Label both axes of a view from above.

    Parameters
    ----------
    ax : Axes        its aspect is set already
    extent : floats  x_min, x_max, y_min, y_max [m]
    names : str      of its axes
    """
    x0, x1, y0, y1 = extent
    if ax.get_aspect() != "auto":  # what is narrow is drawn with as much beside it
        side = max(x1 - x0, y1 - y0)
        x0, x1, y0, y1 = *_widened(x0, x1, side), *_widened(y0, y1, side)
    label_axis(ax.xaxis, names[0], (x0, x1))
    label_axis(ax.yaxis, names[1], (y0, y1))


def _widened(low: float, high: float, span: float) -> tuple[float, float]:
    middle = (low + high) / 2
    return middle - span / 2, middle + span / 2
