"""Notes on a CSV log whose values hardly fit the units and signs that its column file declares.

Each note needs evidence that a right log does not give: what is merely unusual is none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from surffollow.record.columns import DEGREES_REMEDY, Columns
from surffollow.record.csv_times import ISO_UNIT
from surffollow.units import unit_scale

TIME_UNITS = ("s", "ms", "us", "ns")
QUICKEST_S = 1e-4  # between rows with poses
FASTEST_MPS = 1000.0
EPOCH_S = (1e9, 4.1e9)  # seconds since 1970 of 2001 to 2099
LATEST_S = 1e11  # 3000 years
STEPS, LEAST_STEPS = 200, 30  # differences over parts of a log: noise of single rows does not count
TURN = 2.0 * math.pi + 0.01
GOES_WITH, GOES_NOT_WITH = 0.8, 0.5  # mean resultant lengths of course less yaw
EVENER = 5.0  # times: ground with the other sign of the height


def other_time_unit(columns: Columns, interval_s: float) -> str:
    """The unit of times in which rows so far apart by the column file were 1 ms to 1 s apart, as text."""
    unit = columns.time.unit
    if unit == ISO_UNIT:
        return ""
    for other in TIME_UNITS:
        would_s = interval_s / unit_scale(unit, "s") * unit_scale(other, "s")
        if other != unit and 1e-3 <= would_s <= 1.0:
            return f"in {other} they would be {would_s:g} s apart"
    return ""


def unit_notes(
    columns: Columns,
    cells: Mapping[str, NDArray[np.float64]],
    t_s: NDArray[np.float64],
    range_m: NDArray[np.float64],
    pose: NDArray[np.float64],
) -> tuple[str, ...]:
    """Notes on a log as it was read.

    Parameters
    ----------
    columns : Columns
    cells : column → values as written, (n,); NaN: none
    t_s : (n,) float64      ascending [s]
    range_m : (n,) float64  [m]; NaN: no reading
    pose : (n, 7) float64   as `CsvLog.pose`
    """
    has = np.isfinite(pose).all(axis=1)
    notes = _time_notes(columns, t_s, pose[has], t_s[has])
    notes += _degree_notes(columns, cells)
    return (*notes, *_angle_notes(columns, cells, pose), *_height_notes(columns, range_m, pose[:, 2]))


def _degree_notes(columns: Columns, cells: Mapping[str, NDArray[np.float64]]) -> list[str]:
    place = columns.position
    if place is None or place.north is None or place.east is None:
        return []
    named = "lat" in place.north.lower() and any(w in place.east.lower() for w in ("lon", "lng"))
    values = ((cells[place.north], 90.0), (cells[place.east], 180.0))
    if not named or any(not (np.isfinite(v).any() and np.nanmax(np.abs(v)) <= most) for v, most in values):
        return []
    return [
        f'[position] north = "{place.north}" and east = "{place.east}" look like degrees, and count as '
        f"{place.unit}: {DEGREES_REMEDY}"
    ]


def _time_notes(
    columns: Columns, t_s: NDArray[np.float64], pose: NDArray[np.float64], pose_t_s: NDArray[np.float64]
) -> list[str]:
    unit = columns.time.unit
    if unit == ISO_UNIT or t_s.size < 2:
        return []
    declared, scale = f'[time] unit = "{unit}"', unit_scale(unit, "s")
    latest_s = float(np.abs(t_s).max())
    if latest_s > LATEST_S:
        for other in TIME_UNITS:
            if EPOCH_S[0] <= latest_s / scale * unit_scale(other, "s") <= EPOCH_S[1]:
                return [f"times of {latest_s:.3g} s by {declared} are dates of this century in {other}"]
    if columns.position is None:
        return []
    steps = np.diff(t_s)
    usual_s = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    if 0.0 < usual_s < QUICKEST_S:
        other = other_time_unit(columns, usual_s)
        return [f"the rows are {usual_s:.3g} s apart by {declared}; {other or 'check it'}"]
    at = np.unique(np.linspace(0, len(pose) - 1, 21).astype(int)) if len(pose) else np.zeros(0, int)
    if at.size < 5:
        return []
    way_m, took_s = np.linalg.norm(np.diff(pose[at, :3], axis=0), axis=1), np.diff(pose_t_s[at])
    speed_mps = float(np.median(way_m / np.maximum(took_s, 1e-9)))
    if speed_mps <= FASTEST_MPS:
        return []
    return [
        f'the vehicle moves at {speed_mps:.3g} m/s by {declared} and [position] unit = "'
        f'{columns.position.unit}"; check both'
    ]


def _angle_notes(
    columns: Columns, cells: Mapping[str, NDArray[np.float64]], pose: NDArray[np.float64]
) -> list[str]:
    names = columns.attitude
    if names is None or columns.range.kind != "range":
        return []
    declared = f'[attitude] unit = "{names.unit}"'
    tilts = np.abs(np.stack([cells[names.roll], cells[names.pitch]]))
    if names.unit == "rad":
        beyond = int((tilts > TURN).any(axis=0).sum())
        if beyond <= 0.01 * len(pose):
            return []
        return [f"roll or pitch is beyond a full turn in {beyond} of {len(pose)} rows by {declared}; try deg"]
    yaw = cells[names.yaw]
    if names.unit != "deg" or columns.position is None or np.nanmax(tilts) > 0.5 * math.pi:
        return []
    rows = np.flatnonzero(np.isfinite(pose).all(axis=1))
    rows = rows[:: max(1, rows.size // STEPS)]
    moved = np.diff(pose[rows, :2], axis=0)
    way_m = np.hypot(*moved.T)
    moves = way_m > 0.3 * np.median(way_m) if way_m.size else np.zeros(0, bool)
    if moves.sum() < LEAST_STEPS:
        return []
    course = np.arctan2(moved[moves, 0], moved[moves, 1])  # from north to east, as yaw
    then = yaw[rows[:-1]][moves]
    as_rad, as_deg = (float(abs(np.mean(np.exp(1j * (course - y))))) for y in (then, np.radians(then)))
    if not (as_rad > GOES_WITH and as_deg < GOES_NOT_WITH):
        return []
    return [
        f"roll and pitch stay below 1.6 by {declared}, and the course over ground turns as yaw does in rad; "
        "try rad"
    ]


def _height_notes(columns: Columns, range_m: NDArray[np.float64], z_m: NDArray[np.float64]) -> list[str]:
    place = columns.position
    if place is None or (place.up is None and place.down is None):
        return []
    has = np.isfinite(range_m) & np.isfinite(z_m)
    z, r = z_m[has], range_m[has]
    k = max(1, z.size // STEPS)
    if z.size < LEAST_STEPS + k:
        return []
    rise, longer = z[k:] - z[:-k], r[k:] - r[:-k]
    given_m, other_m = (float(np.median(np.abs(v))) for v in (rise - longer, rise + longer))
    if given_m <= EVENER * other_m or given_m == 0.0:
        return []
    key, other = ("up", "down") if place.down is None else ("down", "up")
    column = place.up if place.down is None else place.down
    return [
        f'the range becomes shorter by what the vehicle rises by [position] {key} = "{column}": the sign of '
        f'the height seems wrong; try {other} = "{column}"'
    ]
