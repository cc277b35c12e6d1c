"""Path files: CSV with one row per sample; the lines before it, each `# key = JSON value`, are its facts.

Columns: t_s, x_m, y_m, z_m, qx, qy, qz, qw, nx, ny, nz, azimuth_rad, clearance_m, lift_m, pass, flags.
"""

from __future__ import annotations

import json
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.config.input_file import contents_are_read
from surffollow.config.pose_limits import MAX_POSITION_M
from surffollow.errors import ScanFileError
from surffollow.map.formats.atomic_file import replacing
from surffollow.scan.attitude_angles import quaternions_of
from surffollow.scan.checks import Floats
from surffollow.scan.path import ScanPath
from surffollow.sim.column_file import read_columns

FORMAT = "surffollow-scan-path-1"
COLUMNS = (
    "t_s",
    "x_m",
    "y_m",
    "z_m",
    "qx",
    "qy",
    "qz",
    "qw",
    "nx",
    "ny",
    "nz",
    "azimuth_rad",
    "clearance_m",
    "lift_m",
    "pass",
    "flags",
)

ATTITUDE_SPARE = 1e-6  # as `scan check` allows
DECIMALS = 9  # nanometres and nanoseconds, wherever the origin is: rows lie far farther apart
NUMBERS = (
    *("gap_m", "grid_m", "swath_m", "speed_mps", "acceleration_mps2", "lateral_mps2", "vertical_mps"),
    *("tilt_radps", "vertical_mps2"),
)
# of arrays, possible lengths of each axis
ARRAYS: dict[str, tuple[tuple[int, ...], ...]] = {
    "body_m": ((), (3,)),
    "region_m": ((), (2,)),
    "wrist_rad": ((4,),),
    "base_m": ((3, 2),),
}


def write_path(path: str | os.PathLike[str], plan: ScanPath) -> None:
    """Write a path file, atomically.

    Parameters
    ----------
    path : path
        of the file
    plan : ScanPath
        to be written

    Raises
    ------
    ScanFileError, MapFileError
        a fact that JSON cannot hold, or a place that cannot be written

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from surffollow.scan import ScanPath, write_path
    >>> xy_m = np.array([[0.0, 0.0], [0.1, 0.0]])
    >>> plan = ScanPath.planar(xy_m, np.zeros(2, np.int32), facts={"gap_m": 0.05})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder, "plan.csv")
    ...     write_path(file, plan)
    ...     file.read_text().splitlines()[:3]
    ['# format = "surffollow-scan-path-1"', '# rows = 2', '# gap_m = 0.05']
    """
    try:
        facts = [f"# {k} = {json.dumps(v, allow_nan=False)}\n" for k, v in plan.facts.items()]
    except (TypeError, ValueError) as e:
        raise ScanFileError(f"cannot write {path}: a fact of the path is no JSON value: {e}") from e
    table = np.column_stack(
        [plan.t_s, plan.poses, plan.normal, plan.azimuth_rad, plan.clearance_m, plan.lift_m]
    )
    rows = zip(table.tolist(), plan.passes.tolist(), plan.flags.tolist())
    with replacing(path) as temporary, open(temporary, "w", encoding="ascii", newline="\n") as f:
        f.write(f"# format = {json.dumps(FORMAT)}\n# rows = {len(plan)}\n")
        f.writelines(facts)
        f.write(",".join(COLUMNS) + "\n")
        for row, number, bits in rows:
            f.write(",".join([str(round(v, DECIMALS) + 0.0) for v in row]) + f",{number},{bits}\n")


def _check_facts(path: str | os.PathLike[str], facts: dict[str, Any]) -> None:
    """Refuse facts of another type than the planner writes; absent ones are left to their users."""
    for key in sorted(facts.keys() & {*NUMBERS, *ARRAYS}):
        try:
            value = np.asarray(facts[key], np.float64)
        except (TypeError, ValueError):
            value = np.full(1, np.nan)
        columns = ARRAYS.get(key)
        good = value.size > 0 and bool((np.abs(value) <= MAX_POSITION_M).all())
        if columns is None:
            good = good and value.ndim == 0 and float(value) > 0.0
        else:
            good = good and value.ndim == len(columns) and value.shape[-1] in columns[-1]
        if not good:
            expected = "a number above 0" if columns is None else f"rows of {columns[-1][0]} numbers"
            raise ScanFileError(
                f"{path}: the fact {key} is {str(facts[key])[:80]}; expected {expected}, finite and at most "
                f"{MAX_POSITION_M:g}: plan it again"
            )


def _check_attitudes(path: str | os.PathLike[str], plan: ScanPath, quaternion: Floats) -> None:
    """Refuse a row whose quaternion is another attitude than its normal and azimuth, which a run uses."""
    with np.errstate(invalid="ignore", over="ignore"):  # infinite ones are wrong, too
        expected = quaternions_of(plan.normal, plan.azimuth_rad)
        apart = [np.linalg.norm(quaternion + sign * expected, axis=1) for sign in (-1.0, 1.0)]
        off = np.maximum(np.minimum(*apart), np.abs(np.linalg.norm(plan.normal, axis=1) - 1.0))
    wrong = ~(off <= ATTITUDE_SPARE)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise ScanFileError(
            f"{path}, row {k + 1}: the quaternion and the attitude of normal and azimuth differ by "
            f"{off[k]:.3g}, expected at most {ATTITUDE_SPARE:g}, in {wrong.sum()} rows: plan it again"
        )


def _whole(path: str | os.PathLike[str], values: Floats, kind: type[np.integer[Any]]) -> NDArray[Any]:
    """The column in an integer type, which has to hold it."""
    bounds = np.iinfo(kind)
    if not ((values >= bounds.min) & (values <= bounds.max) & (values == np.floor(values))).all():
        raise ScanFileError(f"{path} has a pass or flags that are no whole numbers")
    return values.astype(kind)


def _check_places(path: str | os.PathLike[str], at: dict[str, Floats]) -> None:
    """Refuse rows without a place, or beyond the farthest that a service takes; a height may be NaN."""
    for name in ("x_m", "y_m", "z_m"):
        good = np.abs(at[name]) <= MAX_POSITION_M
        good |= np.isnan(at[name]) & (name == "z_m")
        if not good.all():
            k = int(np.argmin(good))
            raise ScanFileError(
                f"{path}, row {k + 1}: {name} is {at[name][k]:g}; expected a finite number of at most "
                f"{MAX_POSITION_M:g} m: plan it again"
            )


@contents_are_read()
def read_path(path: str | os.PathLike[str]) -> ScanPath:
    """Read a path file.

    Parameters
    ----------
    path : path
        of a file that `write_path` wrote

    Returns
    -------
    ScanPath
        with its facts

    Raises
    ------
    ScanFileError
        it cannot be read, is of another format, lacks columns or rows, has rows or facts that are not
        numbers, a place that is none, or a quaternion that is not the attitude of normal and azimuth

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from surffollow.scan import ScanPath, read_path, write_path
    >>> xy_m = np.array([[0.0, 0.0], [0.1, 0.0]])
    >>> plan = ScanPath.planar(xy_m, np.zeros(2, np.int32), facts={"gap_m": 0.05})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_path(Path(folder, "plan.csv"), plan)
    ...     path = read_path(Path(folder, "plan.csv"))
    >>> len(path), path.facts["gap_m"]
    (2, 0.05)
    """
    try:
        comments, text = read_columns(path, ScanFileError)
    except ValueError as e:
        raise ScanFileError(f"cannot read {path}: {e}") from e
    facts: dict[str, Any] = {}
    for comment in comments:
        key, equals, value = comment.partition("=")
        if equals:
            try:
                facts[key.strip()] = json.loads(value)
            except (ValueError, RecursionError) as e:
                shown = value.strip()[:80]
                raise ScanFileError(f"{path}: the fact {key.strip()} is no JSON: {shown}") from e
    if facts.pop("format", None) != FORMAT:
        raise ScanFileError(f"{path} is no path file of this version; expected the format {FORMAT}")
    _check_facts(path, facts)
    count = facts.pop("rows", "nothing")
    missing = [c for c in COLUMNS if c not in text]
    if missing:
        raise ScanFileError(f"{path} lacks the columns {', '.join(missing)}")
    try:
        at = {name: np.array([float(v) for v in text[name]]) for name in COLUMNS}
    except ValueError as e:
        raise ScanFileError(f"{path} has a row that is not numbers: {e}") from e
    if len(at["t_s"]) == 0:
        raise ScanFileError(f"{path} has no row; expected at least one")
    if len(at["t_s"]) != count:
        raise ScanFileError(
            f"{path} has {len(at['t_s'])} rows, its header says {count}; the file is not whole: plan it again"
        )
    _check_places(path, at)
    flags, passes = _whole(path, at["flags"], np.uint32), _whole(path, at["pass"], np.int32)
    plan = ScanPath(
        at["t_s"],
        np.column_stack([at["x_m"], at["y_m"], at["z_m"]]),
        np.column_stack([at["nx"], at["ny"], at["nz"]]),
        at["azimuth_rad"],
        at["clearance_m"],
        at["lift_m"],
        flags,
        passes,
        facts,
    )
    _check_attitudes(path, plan, np.column_stack([at[c] for c in ("qx", "qy", "qz", "qw")]))
    return plan
