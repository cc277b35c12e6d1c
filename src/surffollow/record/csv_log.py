"""Read a CSV log by its column file: times, distances and poses in SI units."""

from __future__ import annotations

import contextlib
import csv
import io
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from decimal import Decimal, localcontext
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surffollow.config.input_file import contents_are_read, read_input
from surffollow.errors import InputFileError, UsageError, escaped
from surffollow.record.columns import Columns
from surffollow.record.mcap_reader import MAGIC
from surffollow.units import decimal_number, numbers_text, unit_scale

_DATE_OR_TIME = re.compile(r"\d{1,4}([-:/])\d{1,2}\1\d")
SHOWN = 200  # characters of a file in a message
LAST_HEADER_LINE = 100  # so far the line of column names is looked for, for a message
MAX_SPAN_S = 1e9  # 31 years, well inside int64 nanoseconds


@dataclass(frozen=True)
class CsvLog:
    """Rows of a log; the world is x east, y north, z up, the vehicle x forward, y left, z up.

    Attributes
    ----------
    t_s : (n,) float64          ascending [s]
    range_m : (n,) float64      [m]; NaN: no reading
    pose : (n, 7) float64       x y z [m], unit quaternion qx qy qz qw, world from vehicle
    reference_m : (n,) float64  surface height of another estimator [m], or None
    since_s : (n,) float64      time since the first row [s] by the digits as written: a clock's origin takes
                                none of a float64's; None: `t_s` less its first
    lines : (n,) int64          line of each row in the file; None: not known
    written : (n,) float64      the range as written, in its column's unit; None: not known
    """

    t_s: NDArray[np.float64]
    range_m: NDArray[np.float64]
    pose: NDArray[np.float64]
    reference_m: NDArray[np.float64] | None
    since_s: NDArray[np.float64] | None = None
    lines: NDArray[np.int64] | None = None
    written: NDArray[np.float64] | None = None

    def elapsed_s(self) -> NDArray[np.float64]:
        """Time since the first row [s], (n,)."""
        times = self.t_s if self.since_s is None else self.since_s
        return times - times[:1]

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
        reference = None if self.reference_m is None else self.reference_m[keep]
        since = None if self.since_s is None else self.since_s[keep]
        lines = None if self.lines is None else self.lines[keep]
        written = None if self.written is None else self.written[keep]
        return CsvLog(self.t_s[keep], self.range_m[keep], self.pose[keep], reference, since, lines, written)


@contents_are_read()
def read_csv(path: str | Path, columns: Columns) -> CsvLog:
    """Read a log.

    Raises
    ------
    InputFileError  it cannot be read
    UsageError  a column is missing or there twice, a row has values beyond the columns, a number
        is none, time goes back; names file, line, column
    """
    names = _names(columns)
    remedy = "change the column file to match"
    cells, times, lines = _cells(str(path), _text(path), names, columns.time.column, remedy)
    t_s = cells[columns.time.column] * unit_scale(columns.time.unit, "s")
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
    since_s = _since(times, unit_scale(columns.time.unit, "s"))
    poses, at = _poses(columns, cells, t_s.size), np.array(lines, np.int64)
    return CsvLog(t_s, _ranges(columns, cells), poses, reference, since_s, at, cells[columns.range.column])


@contents_are_read()
def read_numbers(path: str | Path, names: Sequence[str]) -> list[NDArray[np.float64]]:
    """Read columns of a CSV file as they are, in the order of `names`; NaN for an empty cell.

    Separators and decimal signs are those of `read_csv`.

    Raises
    ------
    InputFileError, UsageError  as `read_csv`
    """
    remedy = f"expected: {', '.join(names)}"
    cells, _, _ = _cells(str(path), _text(path), dict.fromkeys(names, True), names[0], remedy)
    return [cells[name] for name in names]


def _text(path: str | Path) -> str:
    """Content of a log."""
    try:
        content = read_input(path, device=False)
    except OSError as e:
        raise InputFileError(f"cannot read log {path}: {e.strerror}") from None
    if content.startswith(MAGIC):
        raise UsageError(f"log {path} is a recording; a recording must have a name ending in .mcap")
    if not content.strip():
        raise UsageError(f"log {path} is empty; expected a line of column names, then rows of numbers")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise UsageError(f"log {path} is no text in UTF-8; save it as UTF-8") from None
    if "\0" in text:
        where = text.count("\n", 0, text.index("\0")) + 1
        raise UsageError(
            f"log {path} has zero bytes from line {where} on: a crash cut or padded it, or it is UTF-16; "
            "remove them with the row that they cut, or save it as UTF-8"
        )
    return text


def _shown(text: str) -> str:
    """Text of a file for a message, not longer than a line; no character of it controls a terminal."""
    text = escaped(text)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}…"


def _missing(
    path: str, header: list[str], names: Iterable[str], rows: Iterable[list[str]], remedy: str
) -> UsageError:
    """The error of a log whose first line lacks a column, with the cause where it can be seen."""
    missing = next(name for name in names if name not in header)
    for number, row in zip(range(2, LAST_HEADER_LINE + 1), rows):
        if set(names) <= {cell.strip() for cell in row}:
            return UsageError(f"{path}: the column names are in line {number}; remove the lines above it")
    if len(header) == 1 and len(header[0].split()) > 1:
        remedy = f"separate columns by commas, semicolons or tabs, not by spaces, or {remedy}"
    return UsageError(f"{path} has no column {missing!r}; it has {_shown(', '.join(header))}; {remedy}")


def _since(times: list[str], scale: float) -> NDArray[np.float64] | None:
    """Numbers less the first, subtracted as decimals, times a scale; None when a decimal cannot hold them."""
    with localcontext() as context:
        context.prec = 60
        try:
            first = Decimal(times[0]) if times else Decimal(0)
            return np.array([float(Decimal(t) - first) for t in times], np.float64) * scale
        except ArithmeticError:
            return None


def _names(c: Columns) -> dict[str, bool]:
    """The columns that are needed → whether a cell may be empty."""
    names = {c.time.column: False, c.range.column: True}
    if c.position is not None:
        names |= dict.fromkeys([name for name, _ in c.position.axes if name is not None], False)
    if c.attitude is not None:
        names |= dict.fromkeys((c.attitude.roll, c.attitude.pitch, c.attitude.yaw), False)
    if c.reference is not None:
        names[c.reference.column] = True
    return names


def _cells(
    path: str, text: str, names: dict[str, bool], verbatim: str, remedy: str
) -> tuple[dict[str, NDArray[np.float64]], list[str], list[int]]:
    """The columns as numbers, one of them as it is written, and the line of each row.

    `remedy` : what the error of a missing column says
    """
    separator = _separator(text, names)
    rows = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
    signs: set[str] = set()
    try:
        header = [name.strip() for name in next(rows, [])]
        places = {}
        if not set(names) <= set(header):
            raise _missing(path, header, names, rows, remedy)
        for name in names:
            if header.count(name) > 1:
                raise UsageError(f"{path}: column {name!r} occurs more than once; rename the others")
            places[name] = header.index(name)
        values: dict[str, list[float]] = {name: [] for name in names}
        written: list[str] = []
        lines: list[int] = []
        for row in rows:
            if not any(cell.strip() for cell in row):
                continue
            if any(cell.strip() for cell in row[len(header) :]):
                raise UsageError(
                    f"{path}, line {rows.line_num}: {len(row)} values for {len(header)} columns; "
                    "correct or remove the row"
                )
            lines.append(rows.line_num)
            for name, optional in names.items():
                cell = row[places[name]].strip() if places[name] < len(row) else ""
                if separator != ",":
                    cell = _with_point(cell, signs, f"{path}, line {rows.line_num}, column {name!r}")
                values[name].append(_number(cell, optional, f"{path}, line {rows.line_num}, column {name!r}"))
                if name == verbatim:
                    written.append(cell)
    except csv.Error as e:
        raise UsageError(f"{path}, line {rows.line_num}: {e}") from None
    if not lines:
        raise UsageError(f"log {path} has a line of column names and no row; expected rows of numbers")
    return {name: np.array(v, np.float64) for name, v in values.items()}, written, lines


def _separator(text: str, names: Iterable[str]) -> str:
    """The character between the columns: a comma, else a semicolon or a tab where the names need it."""
    for separator in (",", ";", "\t"):
        with contextlib.suppress(csv.Error):
            header = next(csv.reader(io.StringIO(text, newline=""), delimiter=separator), [])
            if set(names) <= {name.strip() for name in header}:
                return separator
    return ","


def _with_point(cell: str, signs: set[str], where: str) -> str:
    """A number with a decimal point, also where commas are none between columns.

    `signs` : decimal signs of the log so far, updated
    """
    signs |= {sign for sign in ",." if sign in cell}
    if len(signs) > 1:
        raise UsageError(
            f"{where}: {_shown(cell)!r}: the log has numbers with a comma and numbers with a point; save it "
            "with one decimal sign and nothing between thousands"
        )
    return cell.replace(",", ".")


def _number(cell: str, optional: bool, where: str) -> float:
    if optional and cell.lower() in ("", "nan"):
        return math.nan
    try:
        value = decimal_number(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) and not (optional and value == math.inf):
        remedy = "correct or remove the row"
        if _DATE_OR_TIME.match(cell):
            remedy = "write dates and times of day as numbers, such as seconds since the first row"
        raise UsageError(f"{where}: {_shown(cell)!r} is not a finite number; {remedy}")
    return value


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
    # a depth is straight down, however the vehicle is tilted
    if c.attitude is not None and n > 0 and c.range.kind == "range":
        scale = unit_scale(c.attitude.unit, "rad")
        angles = [cells[name] * scale for name in (c.attitude.yaw, c.attitude.pitch, c.attitude.roll)]
        north_east_down = Rotation.from_euler("ZYX", np.stack(angles, axis=1))
        # x east, y north, z up from north-east-down; forward-right-down from forward, left, up
        world = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
        vehicle = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
        pose[:, 3:] = (world * north_east_down * vehicle).as_quat()
    return pose
