"""Cells of a CSV file as numbers: separators, decimal signs, column names, errors that name a place."""

from __future__ import annotations

import contextlib
import csv
import io
import math
import re
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surffollow.config.input_file import contents_are_read, read_input
from surffollow.errors import InputFileError, UsageError, escaped
from surffollow.record.csv_times import ISO_UNIT, seconds_text
from surffollow.record.csv_words import MISSING, DeclaredUnit, check_units_row, is_units_row
from surffollow.record.mcap_reader import MAGIC
from surffollow.units import decimal_number

_DATE_OR_TIME = re.compile(r"\d{1,4}([-:/])\d{1,2}\1\d")
NUMBER, VALUE, READING = range(3)  # a cell must have a finite number, may have none, may be infinite, too
SHOWN = 200  # characters of a file in a message
SHOWN_ROWS, SHOWN_CELL = 5, 30  # wrong rows in a message, and characters of their cells
LAST_HEADER_LINE = 100  # so far the line of column names is looked for, for a message
ROWS_PER_REPORT = 1 << 14


class _WrongCellError(Exception):
    """A cell is wrong; the text has the remedy."""


class _WrongRows:
    """Rows that cannot be read: the first error, where the first of them are, and their number."""

    def __init__(self, path: str | Path) -> None:
        self._path = path
        self.n, self._first = 0, ""
        self._shown: list[str] = []

    def add(self, line: int, column: str, cell: str, text: str) -> None:
        """Note a row; `column` "": the row itself is wrong."""
        self.n += 1
        if self.n == 1:
            place = f", column {column!r}" if column else ""
            self._first = f"{self._path}, line {line}{place}: {text}"
        if self.n <= SHOWN_ROWS:
            short = cell if len(cell) <= SHOWN_CELL else f"{cell[:SHOWN_CELL]}…"
            what = f"{escaped(column)}: {escaped(short)!r}" if column else short
            self._shown.append(f"line {line} ({what})")

    def check(self, rows: int) -> None:
        """Refuse the log when one of its rows is wrong.

        Raises
        ------
        UsageError
        """
        if self.n == 1:
            raise UsageError(self._first)
        if self.n > 1:
            more = f" and {self.n - SHOWN_ROWS} more" if self.n > SHOWN_ROWS else ""
            raise UsageError(
                f"{self._first}. {self.n} of {rows} rows are wrong: {', '.join(self._shown)}{more}"
            )


@contents_are_read()
def read_numbers(path: str | Path, names: Sequence[str]) -> list[NDArray[np.float64]]:
    """Read columns of a CSV file as they are, in the order of `names`; NaN for one without a value.

    Separators and decimal signs are those of `read_csv`.

    Raises
    ------
    InputFileError, UsageError  as `read_csv`
    """
    remedy = f"expected: {', '.join(names)}"
    cells, _, _ = read_cells(path, dict.fromkeys(names, READING), names[0], remedy)
    return [cells[name] for name in names]


def read_cells(
    path: str | Path,
    names: Mapping[str, int],
    verbatim: str,
    remedy: str,
    progress: Callable[[float], None] | None = None,
    dated: bool | None = None,
    units: Mapping[str, DeclaredUnit] | None = None,
) -> tuple[dict[str, NDArray[np.float64]], list[str], NDArray[np.int64]]:
    """The columns as numbers, one of them as it is written, and the line of each row.

    `names`: the columns → what a cell may be, NUMBER, VALUE or READING. `remedy`: what the error of a missing
    column says. `dated`: the one as written has dates, which become seconds since 1970; None: it cannot be
    declared. `units`: those that the column file declares; None: no row may name units.
    `progress` gets the finished fraction 0 … 1. The file is decoded line by line: a log may be of gigabytes.
    """
    content = _content(path)
    separator = _separator(content, names)
    source = io.BytesIO(content)
    rows = csv.reader(_lines(source), delimiter=separator)
    signs: set[str] = set()
    try:
        header = [name.strip() for name in next(rows, [])]
        places = {}
        if not set(names) <= set(header):
            raise _missing(str(path), header, names, rows, remedy)
        for name in names:
            if header.count(name) > 1:
                raise UsageError(f"{path}: column {name!r} occurs more than once; rename the others")
            places[name] = header.index(name)
        values = {name: array("d") for name in names}
        written: list[str] = []
        lines = array("q")
        wrong, first = _WrongRows(path), units is not None
        for row in rows:
            if progress is not None and len(lines) % ROWS_PER_REPORT == 0:
                progress(source.tell() / len(content))
            if not any(cell.strip() for cell in row):
                continue
            line = rows.line_num
            if first and units is not None:
                first, cells = False, {name: row[k].strip() for name, k in places.items() if k < len(row)}
                if len(cells) == len(names) and is_units_row(cells):
                    check_units_row(cells, units, f"{path}, line {line}")
                    continue
            lines.append(line)
            if any(cell.strip() for cell in row[len(header) :]):
                text = f"{len(row)} values for {len(header)} columns"
                wrong.add(line, "", text, f"{text}; correct or remove the row")
                continue
            for name, kind in names.items():
                given = cell = row[places[name]].strip() if places[name] < len(row) else ""
                try:
                    if name == verbatim and dated is not None:
                        cell = _time(cell, dated)
                    if separator != "," and not (dated and name == verbatim):
                        cell = _with_point(cell, signs, f"{path}, line {line}, column {name!r}")
                    values[name].append(_number(cell, kind))
                except _WrongCellError as error:
                    wrong.add(line, name, given, str(error))
                    break
                if name == verbatim:
                    written.append(cell)
        wrong.check(len(lines))
    except csv.Error as e:
        raise UsageError(f"{path}, line {rows.line_num}: {e}") from None
    if not lines:
        raise UsageError(f"log {path} has a line of column names and no row; expected rows of numbers")
    numbers = {name: np.frombuffer(v, np.float64) for name, v in values.items()}
    return numbers, written, np.frombuffer(lines, np.int64)


def _lines(source: io.BytesIO) -> io.TextIOWrapper:
    """Lines with their ends, as `csv` takes them."""
    return io.TextIOWrapper(source, encoding="utf-8-sig", newline="")


def _content(path: str | Path) -> bytes:
    """Content of a log that is text in UTF-8."""
    try:
        content = read_input(path, device=False)
    except OSError as e:
        raise InputFileError(f"cannot read log {path}: {e.strerror}") from None
    if content.startswith(MAGIC):
        raise UsageError(f"log {path} is a recording; a recording must have a name ending in .mcap")
    if not content or content.isspace():
        raise UsageError(f"log {path} is empty; expected a line of column names, then rows of numbers")
    try:
        content.isascii() or content.decode("utf-8")
    except UnicodeDecodeError:
        raise UsageError(f"log {path} is no text in UTF-8; save it as UTF-8") from None
    if b"\0" in content:
        where = content.count(b"\n", 0, content.index(b"\0")) + 1
        raise UsageError(
            f"log {path} has zero bytes from line {where} on: a crash cut or padded it, or it is UTF-16; "
            "remove them with the row that they cut, or save it as UTF-8"
        )
    return content


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


def _separator(content: bytes, names: Iterable[str]) -> str:
    """The character between the columns: a comma, else a semicolon or a tab where the names need it."""
    for separator in (",", ";", "\t"):
        with contextlib.suppress(csv.Error):
            header = next(csv.reader(_lines(io.BytesIO(content)), delimiter=separator), [])
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


def _time(cell: str, dated: bool) -> str:
    """A cell of the column of times as the text of a number."""
    if not dated and not _DATE_OR_TIME.match(cell):
        return cell
    seconds = seconds_text(cell)
    if dated and seconds is None:
        raise _WrongCellError(
            f"{_shown(cell)!r} is no date with a time such as 2025-05-04T09:30:00.2Z; correct or remove the "
            "row, or give the unit of the column in the column file"
        )
    if not dated and seconds is not None:
        raise _WrongCellError(
            f'{_shown(cell)!r} is not a number; give [time] unit = "{ISO_UNIT}" in the column file'
        )
    return cell if seconds is None else seconds


def _number(cell: str, kind: int) -> float:
    """The number in a cell; NaN where it has no value and need have none (`kind`)."""
    try:
        value = decimal_number(cell)
    except ValueError:
        value = math.nan
    if math.isfinite(value) or (kind == READING and value == math.inf):
        return value
    if kind != NUMBER and cell.lower() in MISSING:
        return math.nan
    remedy = "correct or remove the row"
    if _DATE_OR_TIME.match(cell):
        remedy = "write dates and times of day as numbers, such as seconds since the first row"
    raise _WrongCellError(f"{_shown(cell)!r} is not a finite number; {remedy}")
