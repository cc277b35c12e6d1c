"""Replay a CSV log through the follower: target points, surface height, slope, and forecasts of the range."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.config.params import PARAMS, names_given, param_name
from surffollow.errors import UsageError
from surffollow.follower import Follower
from surffollow.follower.range_forecast import UNIT_TAUS
from surffollow.follower.setup import TABLES
from surffollow.record.columns import Columns
from surffollow.record.csv_log import CsvLog
from surffollow.record.csv_points import target_points
from surffollow.record.table import write_csv
from surffollow.units import parse_quantity, unit_scale

ROWS_PER_REPORT = 4096  # of the progress
ROW_HEADER = ("t_s", "range_m", "target_x_m", "target_y_m", "target_z_m", "height_m", "slope", "reference_m")


@dataclass(frozen=True)
class CsvReplay:
    """Results, row by row.

    Attributes
    ----------
    log : CsvLog
    target_m : (n, 3) float64      where the beam ended; NaN without a reading
    height_m, slope : (n,) float64 the follower's surface; NaN before the first reading
    forecast_m : (n, h) float64    range expected at each horizon after the row; NaN without a reading
    mode : str
    depth : bool                   the readings are depths, straight down
    """

    log: CsvLog
    target_m: NDArray[np.float64]
    height_m: NDArray[np.float64]
    slope: NDArray[np.float64]
    forecast_m: NDArray[np.float64]
    mode: str
    depth: bool = False


def make_follower(columns: Columns, log: CsvLog, mode: str | None) -> Follower:
    """A follower set up for the log's sensor; its desired stand-off is the first reading.

    Raises
    ------
    ConfigError  the column file's [follow] names an unknown parameter or a value out of bounds
    """
    near_m, far_m = columns.limits_m
    readings = log.range_m[np.isfinite(log.range_m)]
    given = names_given(k for k in columns.follow if k not in TABLES)
    sensor: dict[str, Any] = {
        "position_m": [parse_quantity(v, "m") for v in columns.mount.position],
        "orientation": list(columns.mount.orientation),
    }
    # the kernels take readings strictly inside the limits; [follow] has the last word
    if "range_min_m" not in given:
        sensor["near_m"] = float(np.nextafter(near_m, 0.0))
    if "range_max_m" not in given:
        sensor["far_m"] = float(np.nextafter(far_m, math.inf))
    config: dict[str, Any] = {"sensors": [sensor]}
    if "sensor_latency_ns" not in given:
        config["sensor_latency_ns"] = round(columns.delay_s * 1e9)
    config |= columns.follow
    if mode is not None:
        config["mode"] = mode
    offset_m = float(readings[0]) if readings.size and "offset_m" not in given else None
    return Follower(config, offset_m=offset_m)


def _no_reading(log: CsvLog, columns: Columns) -> str:
    """Why no row has a reading."""
    rows, given = log.t_s.size, columns.range
    written = np.zeros(0) if log.written is None else log.written
    some = written[~np.isnan(written) & ~np.isin(written, given.no_reading)]
    if not some.size:
        return (
            f"none of the {rows} rows has a reading: column {given.column!r} is empty or no_reading in all; "
            "check [range] column and no_reading, and --start and --end"
        )
    value_m = float(some[0]) * unit_scale(given.unit, "m")
    low_m, high_m = columns.limits_m
    meant = "" if value_m == some[0] else f", which is {value_m:g} m"
    for unit in ("mm", "cm"):
        other_m = float(some[0]) * unit_scale(unit, "m")
        if not meant and low_m < other_m < high_m:
            meant = f" (in {unit} it would be {other_m:g} m)"
    return (
        f"none of the {rows} rows has a reading from min {low_m:g} to max {high_m:g} m: the first value of "
        f"column {given.column!r} is {some[0]:g} {given.unit}{meant}; check [range] unit, min and max"
    )


def _of_row(log: CsvLog, columns: Columns, row: int, error: UsageError) -> UsageError:
    """The error of a row that the follower refuses, such as times that stand still."""
    line = "" if log.lines is None else f"line {log.lines[row]}, "
    return UsageError(f"{line}column {columns.time.column!r}: {error}; check [time] column and unit")


def run_csv(
    log: CsvLog,
    columns: Columns,
    mode: str | None = None,
    progress: Callable[[float], object] | None = None,
) -> CsvReplay:
    """Give every row's pose and reading to a follower, in their order, and ask it for forecasts.

    Parameters
    ----------
    log, columns
    mode : "paper", "adaptive", or None for the column file's or the product's default
    progress : gets the finished fraction 0 … 1

    Raises
    ------
    UsageError  no row has a reading, or the times of the rows stand still or are in another unit
    """
    if not np.isfinite(log.range_m).any():
        raise UsageError(_no_reading(log, columns))
    has_pose = log.has_pose()
    if not has_pose.any():
        raise UsageError(
            f"none of the {log.t_s.size} rows has a pose: cells of [position] and [attitude] have no value; "
            "check their columns, and --start and --end"
        )
    follower = make_follower(columns, log, mode)
    horizons = columns.horizons_s
    n = log.t_s.size
    height, slope = np.full(n, np.nan), np.full(n, np.nan)
    forecast = np.full((n, len(horizons)), np.nan)
    known = posed = False
    elapsed_s = log.elapsed_s()
    for i in range(n):
        if progress is not None and i % ROWS_PER_REPORT == 0:
            progress(i / n)
        t_ns = round(float(elapsed_s[i]) * 1e9) + 1_000_000_000
        posed = posed or bool(has_pose[i])
        if not posed:  # a range without a pose is no place
            continue
        try:
            if has_pose[i]:
                follower.pose(t_ns, log.pose[i])
            follower.step(t_ns, [float(log.range_m[i])])
        except UsageError as error:
            raise _of_row(log, columns, i, error) from None
        reading = math.isfinite(log.range_m[i])
        known = known or reading
        if known:
            height[i], slope[i] = follower.surface()
        if reading:
            forecast[i] = [follower.forecast_range_m(h) for h in horizons]
    if progress is not None:
        progress(1.0)
    used_mode = follower.state()["mode"]
    return CsvReplay(
        log,
        target_points(log, columns),
        height,
        slope,
        forecast,
        used_mode,
        columns.range.kind == "depth",
    )


# what of [follow] bears upon height, slope and forecast: in the paper's mode these alone, in the adaptive
# mode not the sizes of the paper's means of target points and intervals
PAPER_SETTINGS = (
    "mode",
    "sensor_readings",
    "ee_readings",
    "interval_size_m",
    "range_size",
    "sensor_latency_ns",
)
ADAPTIVE_IGNORES = ("ee_readings", "interval_size_m", "range_size", "pose_interpolate")


def follow_notes(columns: Columns, mode: str) -> list[str]:
    """Settings of the column file's [follow] that the replay in this mode ignores, as text."""
    names = {key: param_name(key) for key in columns.follow if key not in TABLES}
    paper = mode == "paper"
    idle = [k for k, n in names.items() if (n not in PAPER_SETTINGS if paper else n in ADAPTIVE_IGNORES)]
    if not idle:
        return []
    other = "; --mode paper uses some" if not paper else ""
    return [f"[follow] {', '.join(idle)}: without effect on height, slope and forecast in {mode} mode{other}"]


def horizon_notes(columns: Columns, mode: str) -> list[str]:
    """Horizons of an adaptive replay that are shorter than its forecast is made for, as text."""
    given = {param_name(key): value for key, value in columns.follow.items() if key not in TABLES}
    plant = columns.follow.get("plant", {})
    tau_s = parse_quantity(given.get("plant_tau_s", plant.get("tau_s", PARAMS["plant_tau_s"].default)), "s")
    least_s = UNIT_TAUS * tau_s
    short = ", ".join(f"{h:g}" for h in columns.horizons_s if h < least_s * (1.0 - 1e-9))
    if not short or mode == "paper":
        return []
    return [
        f"[forecast] horizons of {short} s are below {UNIT_TAUS:g} plant_tau ({least_s:g} s): the "
        "forecast is made for longer ones, and the newest range may be nearer"
    ]


def write_rows(path: str | Path, replay: CsvReplay) -> None:
    """Write target points, surface height and slope as CSV, atomically and exactly; empty cells for none.

    Raises
    ------
    MapFileError  the file cannot be written
    """
    log = replay.log
    reference = log.reference_m if log.reference_m is not None else np.full(log.t_s.size, np.nan)
    columns = (log.t_s, log.range_m, *replay.target_m.T, replay.height_m, replay.slope, reference)
    write_csv(path, dict(zip(ROW_HEADER, columns)))
