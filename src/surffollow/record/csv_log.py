"""Read a CSV log by its column file: times, distances and poses in SI units."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal, localcontext
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surffollow.config.input_file import contents_are_read
from surffollow.errors import UsageError
from surffollow.record.columns import Columns
from surffollow.record.csv_cells import NUMBER, READING, VALUE, read_cells
from surffollow.record.csv_plausibility import unit_notes
from surffollow.record.csv_times import ISO_UNIT
from surffollow.record.csv_words import DeclaredUnit
from surffollow.units import numbers_text, unit_scale

MAX_SPAN_S = 1e9  # 31 years, well inside int64 nanoseconds


@dataclass(frozen=True)
class CsvLog:
    """Rows of a log; the world is x east, y north, z up, the vehicle x forward, y left, z up.

    Attributes
    ----------
    t_s : (n,) float64          ascending [s]
    range_m : (n,) float64      [m]; NaN: no reading
    pose : (n, 7) float64       x y z [m], unit quaternion qx qy qz qw, world from vehicle; NaN: no pose
    reference_m : (n,) float64  surface height of another estimator [m], or None
    since_s : (n,) float64      time since the first row [s] by the digits as written: a clock's origin takes
                                none of a float64's; None: `t_s` less its first
    lines : (n,) int64          line of each row in the file; None: not known
    written : (n,) float64      the range as written, in its column's unit; None: not known
    notes : texts               what hardly fits the units of the column file
    """

    t_s: NDArray[np.float64]
    range_m: NDArray[np.float64]
    pose: NDArray[np.float64]
    reference_m: NDArray[np.float64] | None
    since_s: NDArray[np.float64] | None = None
    lines: NDArray[np.int64] | None = None
    written: NDArray[np.float64] | None = None
    notes: tuple[str, ...] = ()

    def elapsed_s(self) -> NDArray[np.float64]:
        """Time since the first row [s], (n,)."""
        times = self.t_s if self.since_s is None else self.since_s
        return times - times[:1]

    def has_pose(self) -> NDArray[np.bool_]:
        """Which rows have a pose, (n,)."""
        return ~np.isnan(self.pose[:, 0])

    def slack_s(self) -> float:
        """By how much times may be off [s]: a nanosecond, or the resolution of a float64 at these times."""
        return max(1e-9, 2.0 * float(np.spacing(np.abs(self.t_s).max(initial=0.0))))

    def between(self, start_s: float | None, end_s: float | None) -> CsvLog:
        """The rows from `start_s` to `end_s`, both included."""
        for option, value in (("--start", start_s), ("--end", end_s)):
            if value is not None and not math.isfinite(value):
                raise UsageError(f"{option} must be a finite number of seconds, not {value}")
        if start_s is not None and end_s is not None and end_s < start_s:
            raise UsageError(f"--end {numbers_text(end_s)} lies before --start {numbers_text(start_s)}")
        keep = np.ones(self.t_s.size, bool)
        if start_s is not None:
            keep &= self.t_s >= start_s
        if end_s is not None:
            keep &= self.t_s <= end_s
        if self.t_s.size and not keep.any():
            first, last = (numbers_text(float(t)) for t in self.t_s[[0, -1]])
            raise UsageError(
                f"no row lies between --start and --end: the times of the log are {first} to {last} s; "
                "give both in its seconds, or as dates where it has them"
            )
        reference = None if self.reference_m is None else self.reference_m[keep]
        since = None if self.since_s is None else self.since_s[keep]
        lines = None if self.lines is None else self.lines[keep]
        written = None if self.written is None else self.written[keep]
        columns = (self.t_s[keep], self.range_m[keep], self.pose[keep], reference, since, lines, written)
        return CsvLog(*columns, self.notes)


@contents_are_read()
def read_csv(path: str | Path, columns: Columns, progress: Callable[[float], None] | None = None) -> CsvLog:
    """Read a log; `progress` gets the finished fraction 0 … 1.

    Raises
    ------
    InputFileError  it cannot be read
    UsageError  a column is missing or there twice, a row has values beyond the columns, a number
        is none, time goes back; names file, line, column
    """
    names = _names(columns)
    remedy = "change the column file to match"
    dated = columns.time.unit == ISO_UNIT
    scale = 1.0 if dated else unit_scale(columns.time.unit, "s")
    time, units = columns.time.column, _units(columns)
    cells, times, lines = read_cells(path, names, time, remedy, progress, dated, units)
    t_s = cells[time] * scale
    back = np.flatnonzero(np.diff(t_s) < 0.0)
    if back.size:
        raise UsageError(
            f"{path}, line {lines[back[0] + 1]}, column {columns.time.column!r}: time goes back; sort the log"
        )
    wide = np.flatnonzero(np.abs(t_s - t_s[:1]) > MAX_SPAN_S)
    if wide.size:
        raise UsageError(
            f"{path}, line {lines[wide[0]]}, column {columns.time.column!r}: more than {MAX_SPAN_S:g} s "
            "after the first row; correct or remove the row"
        )
    reference = None
    if columns.reference is not None:
        reference = cells[columns.reference.column] * unit_scale(columns.reference.unit, "m")
    since_s = _since(times, scale)
    for name in pose_columns(columns):
        if not np.isfinite(cells[name]).any():
            raise UsageError(
                f"{path}: column {name!r} has no value in any row; name another column, or leave its key or "
                "table out of the column file, which is 0"
            )
    poses = _poses(columns, cells, t_s.size)
    range_m, written = _ranges(columns, cells), cells[columns.range.column]
    notes = unit_notes(columns, cells, t_s, range_m, poses)
    return CsvLog(t_s, range_m, poses, reference, since_s, lines, written, notes)


def _since(times: list[str], scale: float) -> NDArray[np.float64] | None:
    """Numbers less the first, subtracted as decimals, times a scale; None when a decimal cannot hold them."""
    with localcontext() as context:
        context.prec = 60
        try:
            first = Decimal(times[0]) if times else Decimal(0)
            return np.array([float(Decimal(t) - first) for t in times], np.float64) * scale
        except ArithmeticError:
            return None


def _names(c: Columns) -> dict[str, int]:
    """The columns that are needed → what a cell may be (`read_cells`)."""
    names = dict.fromkeys(_units(c), VALUE)
    names[c.range.column] = READING
    if c.reference is not None:
        names[c.reference.column] = READING
    names[c.time.column] = NUMBER
    return names


def _units(c: Columns) -> dict[str, DeclaredUnit]:
    """The columns that are needed → their units."""
    units = {c.time.column: DeclaredUnit(c.time.unit, "[time] unit")}
    units[c.range.column] = DeclaredUnit(c.range.unit, "[range] unit")
    if c.position is not None:
        place = DeclaredUnit(c.position.unit, "[position] unit")
        units |= {name: place for name, _ in c.position.axes if name is not None}
    if c.attitude is not None:
        turn = DeclaredUnit(c.attitude.unit, "[attitude] unit")
        units |= dict.fromkeys((c.attitude.roll, c.attitude.pitch, c.attitude.yaw), turn)
    if c.reference is not None:
        units[c.reference.column] = DeclaredUnit(c.reference.unit, "[reference] unit")
    return units


def pose_columns(c: Columns) -> list[str]:
    """The columns without whose values a row has no pose."""
    names = [name for name, _ in c.position.axes if name is not None] if c.position is not None else []
    # a depth is straight down, however the vehicle is tilted
    if c.attitude is not None and c.range.kind == "range":
        names += [c.attitude.roll, c.attitude.pitch, c.attitude.yaw]
    return names


def _ranges(c: Columns, cells: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    raw = cells[c.range.column]
    range_m = raw * unit_scale(c.range.unit, "m")
    low, high = c.limits_m
    none = np.isin(raw, np.array(c.range.no_reading, np.float64)) | ~((range_m >= low) & (range_m <= high))
    return np.where(none, np.nan, range_m)


def _poses(c: Columns, cells: dict[str, NDArray[np.float64]], n: int) -> NDArray[np.float64]:
    from scipy.spatial.transform import Rotation

    pose = np.zeros((n, 7))
    pose[:, 6] = 1.0
    if c.position is not None:
        scale = unit_scale(c.position.unit, "m")
        for k, (name, sign) in enumerate(c.position.axes):
            if name is not None:
                pose[:, k] = sign * scale * cells[name]
    has = np.ones(n, bool)
    for name in pose_columns(c):
        has &= np.isfinite(cells[name])
    if c.attitude is not None and n > 0 and c.range.kind == "range":
        scale = unit_scale(c.attitude.unit, "rad")
        names = (c.attitude.yaw, c.attitude.pitch, c.attitude.roll)
        angles = [np.where(has, cells[name], 0.0) * scale for name in names]
        north_east_down = Rotation.from_euler("ZYX", np.stack(angles, axis=1))
        # x east, y north, z up from north-east-down; forward-right-down from forward, left, up
        world = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
        vehicle = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
        pose[:, 3:] = (world * north_east_down * vehicle).as_quat()
    pose[~has] = np.nan
    return pose
