"""Column files (TOML): which columns of a CSV log mean what, in which units."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal

import msgspec

from surffollow.config.input_file import contents_are_read
from surffollow.config.key_errors import key_error_text
from surffollow.config.toml_file import naming_source, read_toml
from surffollow.errors import UsageError
from surffollow.record.csv_times import ISO_UNIT
from surffollow.units import parse_quantity, unit_scale

Quantity = str | float
DEGREES_REMEDY = "convert latitude and longitude to metres north and east first (docs/reference/csv-logs.md)"


class TimeColumn(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When the row was taken; unit "iso8601": dates with times."""

    column: str
    unit: str


class RangeColumn(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The reading; limits are inclusive, `no_reading` values are in the column's unit.

    `kind` "range": the distance along the beam, which attitude and mount tilt. "depth": how far the ground
    lies straight below the position, positive down, as echo sounders and their programs log it.
    """

    column: str
    unit: str
    kind: Literal["range", "depth"] = "range"
    min: Quantity = 0.0
    max: Quantity = 1e5
    no_reading: tuple[float, ...] = ()
    delay: Quantity = 0.0


class PositionColumns(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Position of the vehicle; an axis without a column is 0. The height is `up`, or `down` as in NED."""

    unit: str
    north: str | None = None
    east: str | None = None
    up: str | None = None
    down: str | None = None

    @property
    def axes(self) -> tuple[tuple[str | None, float], ...]:
        """Columns of x, y and z of the world, and their signs."""
        height = (self.up, 1.0) if self.down is None else (self.down, -1.0)
        return (self.east, 1.0), (self.north, 1.0), height


class AttitudeColumns(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Roll (right side down), pitch (nose up), yaw (north to east); turned in the order yaw, pitch, roll."""

    roll: str
    pitch: str
    yaw: str
    unit: str


class ReferenceColumn(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Another estimator's surface height, to compare with."""

    column: str
    unit: str


class Mount(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Mount of the sensor on the vehicle (x forward, y left, z up); its beam leaves along its -z."""

    position: tuple[Quantity, Quantity, Quantity] = (0.0, 0.0, 0.0)
    orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)


class Forecast(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How far ahead to forecast, and how late a reading may come to count as the truth of then."""

    horizons: tuple[Quantity, ...] = ("0.2 s", "0.5 s", "1 s", "2 s")
    match: Quantity = "0.15 s"


class Columns(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A whole column file."""

    time: TimeColumn
    range: RangeColumn
    position: PositionColumns | None = None
    attitude: AttitudeColumns | None = None
    reference: ReferenceColumn | None = None
    mount: Mount = Mount()
    forecast: Forecast = Forecast()
    follow: dict[str, Any] = {}
    description: str = ""

    @property
    def horizons_s(self) -> list[float]:
        """Forecast horizons [s]."""
        return [parse_quantity(h, "s") for h in self.forecast.horizons]

    @property
    def match_s(self) -> float:
        """How much later than asked the true reading may be [s]."""
        return parse_quantity(self.forecast.match, "s")

    @property
    def limits_m(self) -> tuple[float, float]:
        """Nearest and farthest valid reading [m]."""
        return parse_quantity(self.range.min, "m"), parse_quantity(self.range.max, "m")

    @property
    def delay_s(self) -> float:
        """How old the range in a row is [s]."""
        return parse_quantity(self.range.delay, "s")


def parse_columns(data: dict[str, Any], source: str = "column file") -> Columns:
    """Check a column file given as nested dictionaries.

    Raises
    ------
    UsageError  unknown key, wrong type, unknown unit, impossible value; the text names source and key
    """
    try:
        columns = msgspec.convert(data, Columns)
    except msgspec.ValidationError as e:
        raise UsageError(
            f"{source}: {key_error_text(e, Columns)}; see docs/reference/csv-logs.md of the source "
            "distribution"
        ) from None
    checks: list[tuple[str, Any, str]] = [
        ("time", columns.time, "s"),
        ("range", columns.range, "m"),
        ("position", columns.position, "m"),
        ("attitude", columns.attitude, "rad"),
        ("reference", columns.reference, "m"),
    ]
    for key, table, si_unit in checks:
        if table is not None and (si_unit != "s" or table.unit != ISO_UNIT):
            other = f', and "{ISO_UNIT}" for dates with times' if key == "time" else ""
            with naming_source(f"{source}: [{key}] unit", UsageError):
                try:
                    unit_scale(table.unit, si_unit)
                except UsageError as error:
                    raise UsageError(f"{error}{other}{_degrees(key, table.unit)}") from None
    with naming_source(source, UsageError):
        _check(columns)
    return columns


def _degrees(key: str, unit: str) -> str:
    """The remedy for positions in degrees; empty: that is not the fault."""
    try:
        unit_scale(unit, "rad")
    except UsageError:
        return ""
    return f"; {DEGREES_REMEDY}" if key == "position" else ""


def _check(c: Columns) -> None:
    if c.position is not None:
        if c.position.up is not None and c.position.down is not None:
            raise UsageError("[position] has both up and down; keep the one that the log's height is")
        if not any(name for name, _ in c.position.axes):
            raise UsageError(
                "[position] names no column; give north, east, up or down, or leave the table out"
            )
    if c.range.kind == "depth" and c.mount != Mount():
        raise UsageError(
            '[mount] tilts and moves a beam; a depth (kind = "depth") is straight down: leave it out'
        )
    low, high = c.limits_m
    if not 0.0 <= low < high:
        raise UsageError(f"[range] min {low:g} m must be at least 0 and below max {high:g} m")
    if not c.horizons_s or not all(0.0 < h <= 3600.0 for h in c.horizons_s):
        raise UsageError("[forecast] horizons must be one or more times above 0 s, at most an hour")
    if not 0.0 <= c.match_s <= 3600.0:
        raise UsageError(f"[forecast] match is {c.match_s:g} s; it must be between 0 and an hour")
    if not 0.0 <= c.delay_s <= 10.0:
        raise UsageError(f"[range] delay is {c.delay_s:g} s; it must be between 0 and 10 s")
    for value in c.mount.position:
        parse_quantity(value, "m")
    if not abs(math.fsum(q * q for q in c.mount.orientation) - 1.0) <= 1e-3:
        raise UsageError("[mount] orientation must be a unit quaternion [qx, qy, qz, qw]")


@contents_are_read()
def load_columns(path: str | Path) -> Columns:
    """Read a column file.

    Raises
    ------
    InputFileError  it cannot be read
    UsageError  it is not TOML, or says something wrong
    """
    return parse_columns(read_toml(path, "column file", UsageError), str(path))
