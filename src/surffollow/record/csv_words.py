"""Words in the cells of a CSV log: those for a missing value, and a row of units below the column names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from surffollow.errors import UsageError
from surffollow.units import unit_scale

# what loggers and spreadsheets write where there is no value, in lower case
MISSING = frozenset(("", "nan", "-nan", "na", "n/a", "#n/a", "<na>", "null", "none", "-", "--", "---"))
_BRACKETS = "[](){}<>"
_SI = ("s", "m", "rad")
# written-out units as a column file has them
_WRITTEN = {
    "sec": "s",
    "secs": "s",
    "second": "s",
    "seconds": "s",
    "msec": "ms",
    "milliseconds": "ms",
    "microseconds": "us",
    "nanoseconds": "ns",
    "meter": "m",
    "meters": "m",
    "metre": "m",
    "metres": "m",
    "feet": "ft",
    "inch": "in",
    "degree": "deg",
    "degrees": "deg",
    "radian": "rad",
    "radians": "rad",
}


class DeclaredUnit(NamedTuple):
    """The unit of a column by the column file, and the key that declares it."""

    unit: str
    key: str


def unit_of(cell: str) -> str:
    """The unit that a cell names, as a column file writes it; "": it names none."""
    word = cell.strip().strip(_BRACKETS).strip()
    for unit in (word, word.lower(), _WRITTEN.get(word.lower(), "")):
        if _dimension(unit):
            return unit
    return ""


def _dimension(unit: str) -> str:
    """The SI unit of the same dimension; "": it is no unit of a log's columns."""
    for si in _SI:
        try:
            unit_scale(unit, si)
        except UsageError:
            continue
        return si
    return ""


def is_units_row(cells: Mapping[str, str]) -> bool:
    """Whether the cells of the needed columns name units, and none has a number.

    Parameters
    ----------
    cells : column → cell of the first row below the column names
    """
    return any(map(unit_of, cells.values())) and not any(c.isdigit() for cell in cells.values() for c in cell)


def check_units_row(cells: Mapping[str, str], declared: Mapping[str, DeclaredUnit], where: str) -> None:
    """Refuse a row of units that contradicts the column file.

    Raises
    ------
    UsageError  names the key and what to write there
    """
    for name, (unit, key) in declared.items():
        said = unit_of(cells[name])
        if not said or said == unit or not _dimension(unit):  # dates have no unit
            continue
        si = _dimension(said)
        if si == _dimension(unit) and unit_scale(said, si) == unit_scale(unit, si):
            continue
        raise UsageError(
            f"{where}: the row of units says that column {name!r} is in {said}, the column file says {unit}; "
            f'write {key} = "{said}" in the column file, or remove the row'
        )
