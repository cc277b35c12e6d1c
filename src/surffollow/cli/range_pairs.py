"""Pairs of indicated and true distances: typed beside a sensor's readings, examined for their unit, drawn."""

from __future__ import annotations

import math
import sys
import time
from typing import Any

import numpy as np

from surffollow.apps.fit_range import RangeFit
from surffollow.client import observe
from surffollow.hw.calibration import RangeTable
from surffollow.record.figure import new_figure, save_figure
from surffollow.units import parse_quantity

FAR_M = 20.0  # no robot's tool is held so far above a surface


def unit_notes(table: RangeTable) -> list[str]:
    """Signs that the unit of a table is not the one that was meant."""
    low, high = sorted((table.range_m[0], table.range_m[-1]))
    slope = (high - low) / (table.indicated[-1] - table.indicated[0])
    notes = []
    if high > FAR_M:
        notes.append(f"the distances are {low:.4g} m to {high:.4g} m; is their --unit mm?")
    elif np.isclose(slope, 1e-3, rtol=0.2):
        notes.append(
            f"the indicated values, {table.indicated[0]:.4g} to {table.indicated[-1]:.4g}, seem to be in mm; "
            "a driver of distances gives metres: --indicated-unit mm"
        )
    return notes


def typed_pairs(name: str, channel: int, seconds: float, unit: str) -> tuple[list[float], list[float]]:
    """Ask for true distances one after the other; the sensor's mean beside each.

    Parameters
    ----------
    name : str           of the service
    channel : int
    seconds : float [s]  of each mean
    unit : str           of the distances typed
    """
    indicated: list[float] = []
    true: list[float] = []
    print(f"Service {name!r} has to run without a calibration of this channel.", file=sys.stderr)
    with observe(name) as watcher:
        while True:
            print(
                f"distance of the target [{unit}], or an empty line to end: ",
                end="",
                file=sys.stderr,
                flush=True,
            )
            text = sys.stdin.readline().strip()
            if not text:
                return indicated, true
            try:
                distance = parse_quantity(text, unit, bare=True)
            except ValueError as error:
                print(f"  {error}", file=sys.stderr)
                continue
            readings, end = [], time.monotonic() + seconds
            while time.monotonic() < end:
                value = watcher.raw_distance(channel)
                if math.isfinite(value):
                    readings.append(value)
                time.sleep(0.005)
            if not readings:
                print("  the sensor sees nothing there; not taken", file=sys.stderr)
                continue
            indicated.append(sum(readings) / len(readings))
            true.append(distance)
            print(f"  {len(true)}: indicated {indicated[-1]:.6g}", file=sys.stderr)


def draw_fit(path: str, indicated: Any, true_m: Any, fit: RangeFit, unit: str) -> None:
    """Table and residuals as a picture.

    Parameters
    ----------
    path : str                 the picture
    indicated : (n,) float64   what the sensor showed
    true_m : (n,) float64 [m]  true distances
    fit : RangeFit
    unit : str                 of the indicated values
    """
    figure = new_figure((7, 5))
    curve, rest = figure.subplots(2, sharex=True)
    curve.plot(fit.table.indicated, 1e3 * np.array(fit.table.range_m), label=fit.method)
    curve.plot(indicated, 1e3 * true_m, "o", label="pairs")
    curve.set_ylabel("distance [mm]")
    curve.legend()
    inner = np.unique(indicated)[1:-1]
    rest.stem(inner, 1e3 * np.array(fit.residuals_m))
    rest.set(ylabel="residual without the pair [mm]", xlabel=f"indicated [{unit}]")
    save_figure(figure, path)
