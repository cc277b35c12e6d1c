"""Target points of a CSV log, by the poses at the times of its readings; whether a map can hold them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import UsageError
from surffollow.record.columns import Columns
from surffollow.record.csv_log import CsvLog
from surffollow.record.drawn_series import PAUSE_INTERVALS
from surffollow.record.figure import outliers
from surffollow.shm.map_layout import MAX_REGION_M
from surffollow.units import numbers_text, parse_quantity

SHOWN_ROWS = 5  # of those that a message names
COARSE = 10.0  # times: grids wider than points lie apart, rows farther off than usual


def target_points(log: CsvLog, columns: Columns) -> NDArray[np.float64]:
    """End of each row's beam in the world, (n, 3) [m]; NaN without a reading or a pose at its time."""
    from scipy.spatial.transform import Rotation

    position_m, attitude = _poses_of_readings(log, columns.delay_s)
    sensor = Rotation.from_quat(columns.mount.orientation)
    mount_m = np.array([parse_quantity(v, "m") for v in columns.mount.position])
    beam = -log.range_m[:, None] * sensor.apply([0.0, 0.0, 1.0])
    points: NDArray[np.float64] = position_m + attitude.apply(mount_m + beam)
    return points


def _poses_of_readings(log: CsvLog, delay_s: float) -> tuple[NDArray[np.float64], Any]:
    """Positions (n, 3) [m] and attitudes (n rotations) when the readings were taken, `delay_s` before rows.

    They are interpolated between rows that have a pose. The position is NaN before the first and behind the
    last one, and between two that a longer gap of rows without a pose separates.
    """
    from scipy.spatial.transform import Rotation

    t = log.elapsed_s()
    rows = np.flatnonzero(log.has_pose())
    if rows.size == 0:
        return np.full((t.size, 3), np.nan), Rotation.from_quat(np.tile([0.0, 0.0, 0.0, 1.0], (t.size, 1)))
    position, attitude, at = log.pose[rows, :3], Rotation.from_quat(log.pose[rows, 3:]), t[rows]
    if delay_s == 0.0 and rows.size == t.size:
        return position, attitude
    then = t - delay_s
    then = np.where(np.abs(then) < log.slack_s(), 0.0, then)
    # then lies from pose `before` to the next; of poses with one time it is the last
    before = np.maximum(np.searchsorted(at, then, side="right") - 1, 0)
    after = np.minimum(before + 1, at.size - 1)
    gap_s, usual_s = at[after] - at[before], float(np.median(np.diff(at))) if at.size > 1 else 0.0
    lost = (rows[after] - rows[before] > 1) & (gap_s > PAUSE_INTERVALS * usual_s) & (then != at[before])
    known = ((then >= at[0]) & (then <= at[-1]) & ~lost)[:, None]
    part = np.clip((then - at[before]) / np.maximum(gap_s, 1e-9), 0.0, 1.0)
    turn = (attitude[before].inv() * attitude[after]).as_rotvec()
    moved = position[before] + part[:, None] * (position[after] - position[before])
    return np.where(known, moved, np.nan), attitude[before] * Rotation.from_rotvec(part[:, None] * turn)


def pose_notes(log: CsvLog, points_m: NDArray[np.float64]) -> list[str]:
    """That rows have no pose, and how many readings have no target point (n, 3) [m], as text."""
    without = np.flatnonzero(~log.has_pose())
    if not without.size:
        return []
    read = np.isfinite(log.range_m)
    lost = int((read & ~np.isfinite(points_m).all(axis=1)).sum())
    return [
        f"{without.size} of {log.t_s.size} rows have no pose, because a cell of it has no value: "
        f"{_rows_text(log, without)}; {lost} of {int(read.sum())} readings have no target point, those "
        "between poses have an interpolated one"
    ]


def check_extent(file: str, log: CsvLog, points_m: NDArray[np.float64]) -> None:
    """Refuse target points (n, 3) [m] that no map holds: one row at 0, 0 among places of a survey.

    Raises
    ------
    UsageError  they extend over more than a map may; names the extent and the rows far from the others
    """
    sides_m = _sides(points_m)
    if max(sides_m) > MAX_REGION_M:
        raise UsageError(
            f"{file}: the target points extend over {_by(sides_m)} m, but a side of a map is at most "
            f"{numbers_text(MAX_REGION_M)} m.{_far_text(log, points_m, 0.5 * MAX_REGION_M)}"
        )


def map_notes(log: CsvLog, points_m: NDArray[np.float64], grid_m: float) -> list[str]:
    """That the grids of a map are much coarser than target points (n, 3) [m] lie apart, and why, as text."""
    has = np.isfinite(points_m).all(axis=1)
    steps = np.hypot(*np.diff(points_m[has, :2], axis=0).T)
    usual_m = float(np.median(steps)) if steps.size else 0.0
    if not 0.0 < COARSE * usual_m < grid_m:
        return []
    off = np.abs(points_m[has, :2] - np.median(points_m[has, :2], axis=0)).max(axis=1)
    return [
        f"the map's grids are {grid_m:.3g} m wide, and target points usually {usual_m:.3g} m apart: they "
        f"extend over {_by(_sides(points_m))} m.{_far_text(log, points_m, COARSE * float(np.median(off)))}"
    ]


def outlier_notes(log: CsvLog, points_m: NDArray[np.float64]) -> list[str]:
    """That the map has target points (n, 3) [m] far above or below their neighbours, as text."""
    odd = np.flatnonzero(outliers(points_m[:, 2]))
    if not odd.size:
        return []
    return [
        f"the map has {odd.size} target point{'s' if odd.size > 1 else ''} far above or below the "
        f"neighbours, which the figure crosses out: {_rows_text(log, odd)}; correct or remove the rows, or "
        "leave them out with [range] min and max of the column file"
    ]


def _rows_text(log: CsvLog, which: NDArray[np.int64]) -> str:
    """Lines of the file, or times, of some rows; not all where there are many."""
    kind, names = ("time [s]", log.t_s) if log.lines is None else ("line", log.lines)
    shown = ", ".join(numbers_text(float(v)) for v in names[which[:SHOWN_ROWS]])
    more = f" and {which.size - SHOWN_ROWS} more" if which.size > SHOWN_ROWS else ""
    return f"{kind} {shown}{more}"


def _sides(points_m: NDArray[np.float64]) -> list[float]:
    """Extents in x and y [m]."""
    xy = points_m[np.isfinite(points_m).all(axis=1), :2]
    return [float(v) for v in np.ptp(xy, axis=0)] if len(xy) else [0.0, 0.0]


def _by(sides_m: list[float]) -> str:
    return " × ".join(numbers_text(v) for v in sides_m)


def _far_text(log: CsvLog, points_m: NDArray[np.float64], limit_m: float) -> str:
    """The rows whose place or target point is farther than a limit from the median; "" for none."""
    middle = np.nanmedian(points_m[:, :2], axis=0)
    off = np.fmax(np.abs(points_m[:, :2] - middle), np.abs(log.pose[:, :2] - middle)).max(axis=1)
    far = np.flatnonzero(off > limit_m)
    if not far.size:
        return ""
    rounded, x, y = (numbers_text(float(v)) for v in (f"{limit_m:.3g}", *middle))
    return (
        f" {far.size} of {len(off)} rows lie more than {rounded} m from the median place {x}, {y} m: "
        f"{_rows_text(log, far)}; correct or remove them, or leave them out with --start and --end"
    )
