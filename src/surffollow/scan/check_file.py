"""The path file as the checker reads it: rows, facts, and the poses between rows. No code of the planner."""

from __future__ import annotations

import csv
import json
import math
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.config.input_file import contents_are_read
from surffollow.config.pose_limits import MAX_POSITION_M
from surffollow.errors import ScanFileError
from surffollow.scan.check_finding import Finding

FORMAT = "surffollow-scan-path-1"
COLUMNS = (
    *("t_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "nx", "ny", "nz"),
    *("azimuth_rad", "clearance_m", "lift_m", "pass", "flags"),
)
MAX_POINTS = 1000  # of a body, of a region: more than any planner writes
MAX_POSES_BETWEEN = 1_000_000  # poses between rows: more take too long
MAX_POSES_OF_WAY = 10_000  # of them from one row to the next: a planner's rows are far nearer
Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Facts:
    """Header of the file; lengths in metres, angles in radians, SI units of motion; the number of rows.

    `vertical` is infinite for files of before there was a limit of the vertical acceleration.
    """

    body: Array
    region: Array
    wrist: list[float]
    gap: float
    swath: float
    speed: float
    acceleration: float
    lateral: float
    climb: float
    tilt: float
    rows: float
    vertical: float = math.inf


@dataclass(frozen=True)
class Poses:
    """Poses of the body: rows of the file, or those between them.

    Attributes
    ----------
    position : (n, 3) float64 [m]
    quaternion : (n, 4) float64        x, y, z, w; not normalised
    azimuth : (n,) float64 [rad]
    flags : (n,) int64
    passes : (n,) int64                -1 on turns
    """

    position: Array
    quaternion: Array
    azimuth: Array
    flags: NDArray[np.int64]
    passes: NDArray[np.int64]

    @property
    def planned(self) -> Bools:
        """(n,) bool, the poses that have a height."""
        return np.asarray(np.isfinite(self.position).all(axis=1))


@contents_are_read()
def read_rows(path: str | os.PathLike[str]) -> tuple[Facts, dict[str, Array], Poses]:
    """Facts, columns by name and poses of a path file.

    Raises
    ------
    ScanFileError
        the file cannot be read, lacks what is needed to check it, or has a place that is none
    """
    found, at = _read(path)
    _check_places(path, at)
    whole = [np.isfinite(at[c]).all() and (at[c] == np.round(at[c])).all() for c in ("pass", "flags")]
    if (
        not all(whole)
        or np.abs(at["pass"]).max() > 2**31
        or not 0 <= at["flags"].min() <= at["flags"].max() < 2**32
    ):
        raise ScanFileError(f"{path} has a pass or flags that are no whole numbers")
    poses = Poses(
        np.column_stack([at["x_m"], at["y_m"], at["z_m"]]),
        np.column_stack([at[c] for c in ("qx", "qy", "qz", "qw")]),
        at["azimuth_rad"],
        at["flags"].astype(np.int64),
        at["pass"].astype(np.int64),
    )
    return _facts(path, found), at, poses


def _check_places(path: str | os.PathLike[str], at: dict[str, Array]) -> None:
    """Refuse rows without a place, or with numbers whose squares overflow; findings say of other NaN."""
    for name in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"):
        good = np.abs(at[name]) <= MAX_POSITION_M
        good |= np.isnan(at[name]) & (name not in ("x_m", "y_m"))
        if not good.all():
            k = int(np.argmin(good))
            raise ScanFileError(
                f"{path}, row {k + 1}: {name} is {at[name][k]:g}; expected a finite number of at most "
                f"{MAX_POSITION_M:g}: plan it again"
            )


def _facts(path: str | os.PathLike[str], found: dict[str, Any]) -> Facts:
    def refuse(key: str, expected: str) -> ScanFileError:
        if key not in found:
            return ScanFileError(f"{path} lacks the fact {key}, which a check needs; plan it again")
        return ScanFileError(
            f"{path}: the fact {key} is {str(found[key])[:80]}; expected {expected}: plan it again"
        )

    def numbers(key: str, columns: int, rows: tuple[int, int]) -> Array:
        try:
            made = np.array(found[key], np.float64)
        except (KeyError, TypeError, ValueError) as e:
            raise refuse(key, f"rows of {columns} finite numbers") from e
        made = made.reshape(1, -1) if made.ndim == 1 else made
        good = made.ndim == 2 and made.shape[1] == columns and rows[0] <= len(made) <= rows[1]
        if not good or not (np.abs(made) <= MAX_POSITION_M).all():
            raise refuse(key, f"rows of {columns} finite numbers of at most {MAX_POSITION_M:g}")
        return made

    def positive(key: str) -> float:
        value = found.get(key)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0.0 < value < math.inf:
            raise refuse(key, "a finite number above 0")
        return float(value)

    if found.get("format") != FORMAT:
        raise ScanFileError(f"{path} is no path file of this version; expected the format {FORMAT}")
    motion = ["speed_mps", "acceleration_mps2", "lateral_mps2", "vertical_mps", "tilt_radps"]
    last = [k for k in ("vertical_mps2",) if k in found]
    return Facts(
        numbers("body_m", 3, (1, MAX_POINTS)),
        numbers("region_m", 2, (3, MAX_POINTS)),
        numbers("wrist_rad", 4, (1, 1))[0].tolist(),
        *(positive(k) for k in ("gap_m", "swath_m", *motion, "rows", *last)),
    )


def check_rows(rows: int, facts: Facts) -> Finding:
    """A file that was cut off, or put together, has another number of rows than its header says.

    Parameters
    ----------
    rows : int      of the file
    facts : Facts   header of the file

    Returns
    -------
    Finding
    """
    return Finding("rows", rows == facts.rows, f"{rows} rows of {facts.rows:g}", rows)


def between(path: str | os.PathLike[str], rows: Poses, body: Array, step: float) -> Poses:
    """Poses between rows as a robot interpolates them, where a control point moves farther than `step` [m].

    Parameters
    ----------
    path : path                the file, for the error
    rows : Poses               rows of the file
    body : (m, 3) float64 [m]  control points of the body
    step : float [m]           greatest motion of a control point from pose to pose

    Raises
    ------
    ScanFileError
        rows are so far apart that more than MAX_POSES_BETWEEN poses would lie between, or more than
        MAX_POSES_OF_WAY between two

    Notes
    -----
    Position and quaternion change linearly from row to row. A pose is part of a pass when both rows are.
    """
    move = np.linalg.norm(np.diff(rows.position, axis=0), axis=1)
    turn = np.linalg.norm(np.diff(rows.quaternion, axis=0), axis=1)
    # a change dq of a unit quaternion turns by 2 |dq|
    travel = move + 2.0 * turn * float(np.linalg.norm(body, axis=1).max())
    travel = np.where(np.isnan(travel), 0.0, travel)
    parts = np.ceil(travel / step - 1e-9)
    if parts.sum() - len(parts) > MAX_POSES_BETWEEN or parts.max(initial=0.0) > MAX_POSES_OF_WAY:
        k = int(travel.argmax())
        raise ScanFileError(
            f"{path}: from row {k + 1} to row {k + 2} a control point moves by {travel[k]:g} m; the rows are "
            "too far apart to be checked: plan it again"
        )
    inner = np.maximum(parts.astype(np.int64) - 1, 0)
    first = np.repeat(np.arange(len(inner)), inner)
    number = np.arange(len(first)) - np.repeat(np.cumsum(inner) - inner, inner) + 1
    w = (number / parts[first])[:, None]

    def mix(column: Array) -> Array:
        return np.asarray(column[first] * (1.0 - w) + column[first + 1] * w, np.float64)

    same = rows.passes[first] == rows.passes[first + 1]
    return Poses(
        mix(rows.position),
        mix(rows.quaternion),
        mix(rows.azimuth[:, None])[:, 0],
        rows.flags[first] | rows.flags[first + 1],
        np.where(same, rows.passes[first], -1),
    )


def _read(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, Array]]:
    facts: dict[str, Any] = {}
    try:
        with open(path, encoding="ascii", newline="") as f:
            lines = []
            for line in f:
                if line.startswith("#"):
                    key, _, value = line[1:].partition("=")
                    facts[key.strip()] = json.loads(value)
                else:
                    lines.append(line)
        reader = csv.DictReader(lines)
        names = list(reader.fieldnames or [])
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"two columns are called {', '.join(twice)}")
        rows = list(reader)
        columns = {name: np.array([float(r[name]) for r in rows]) for name in rows[0]}
    except (OSError, ValueError, TypeError, IndexError, KeyError, RecursionError) as e:
        raise ScanFileError(f"cannot read {path} as a path file: {e!r}") from e
    missing = [name for name in COLUMNS if name not in columns]
    if missing:
        raise ScanFileError(f"{path} lacks the columns {', '.join(missing)}")
    return facts, columns
