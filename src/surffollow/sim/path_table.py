"""Read a planner's path file, CSV or NPZ: places, and times, heights, attitudes, speeds, stops if given."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.config.input_file import check_plain_file, contents_are_read
from surffollow.errors import InputFileError, UsageError
from surffollow.map.formats.npz import DAMAGED_ARCHIVE
from surffollow.sim.column_file import read_columns
from surffollow.units import decimal_number

NEEDED = ("x_m", "y_m")
ATTITUDE = ("qx", "qy", "qz", "qw")
KNOWN = ("t_s", *NEEDED, "z_m", *ATTITUDE, "speed_mps", "stop")
NORM_TOLERANCE = 1e-3
_WORDS = {"stop": 1.0, "pass": 0.0}  # of the column stop
# a column that is one of ours but for its unit: x, x_mm, t_ms, speed_mm_s, speed
_OTHER_UNIT = re.compile(r"(t|x|y|z|speed)(_[a-z0-9_]+)?")


@dataclass(frozen=True)
class PathTable:
    """Corners of a path, finite and in the right order.

    Attributes
    ----------
    x_m, y_m : (n,) float64 [m]
    t_s : (n,) float64, when the tool is to be there [s], ascending; None: not planned
    z_m : (n,) float64, planned height of the tool [m]; None
    attitude : (n, 4) float64, planned unit quaternion, world from tool; None
    speed_mps : (n,) float64, limit on the way to the corner [m/s]; None
    stop : (n,) bool, come to rest there
    """

    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    t_s: NDArray[np.float64] | None
    z_m: NDArray[np.float64] | None
    attitude: NDArray[np.float64] | None
    speed_mps: NDArray[np.float64] | None
    stop: NDArray[np.bool_]


@contents_are_read()
def read_path_table(file: str) -> PathTable:
    """Read a path file.

    Parameters
    ----------
    file : CSV with a header line (lines that begin with # are passed over), or NPZ; the columns `x_m`, `y_m`,
        and optionally `t_s`, `z_m`, `qx` `qy` `qz` `qw`, `speed_mps`, `stop` (1 or stop, 0 or pass); others
        are passed over

    Raises
    ------
    InputFileError
        it cannot be read
    UsageError
        it lacks a column, holds what is no number, or cannot be: times that go back, speeds
        that are not positive, a quaternion whose norm is not 1, another unit in a column's name,
        corners at one place
    """
    columns = _read_npz(file) if file.lower().endswith(".npz") else _read_csv(file)
    _check_names(file, columns)
    lengths = {len(c) for c in columns.values()}
    if len(lengths) > 1 or min(lengths) < 2:
        raise UsageError(
            f"path '{file}' has {' or '.join(map(str, sorted(lengths)))} corners; two or more are "
            "needed, as many in each column"
        )
    for name, values in columns.items():
        _check(file, name, np.isfinite(values), values, "finite")
    t_s, speed = columns.get("t_s"), columns.get("speed_mps")
    if t_s is not None:
        later = np.concatenate([[True], np.diff(t_s) >= 0.0])
        _check(file, "t_s", later, t_s, "not before the row above: times go back")
    if speed is not None:
        _check(file, "speed_mps", speed > 0.0, speed, "above 0")
    attitude = None
    if "qw" in columns:
        attitude = np.column_stack([columns[n] for n in ATTITUDE])
        norm = np.linalg.norm(attitude, axis=1)
        _check(file, "qx qy qz qw", np.abs(norm - 1.0) <= NORM_TOLERANCE, norm, "of norm 1")
        attitude /= norm[:, None]
    moves = np.hypot(np.diff(columns["x_m"]), np.diff(columns["y_m"])) > 0.0
    if not moves.any():
        raise UsageError(f"path '{file}' needs two or more different corners")
    if "z_m" in columns and (np.diff(columns["z_m"])[~moves] != 0.0).any():
        raise UsageError(
            f"path '{file}' changes z_m at one place; the robot's height changes on its way only"
        )
    stop = columns.get("stop", np.zeros(len(columns["x_m"])))
    _check(file, "stop", (stop == 0.0) | (stop == 1.0), stop, "1 (stop) or 0 (pass)")
    return PathTable(
        columns["x_m"], columns["y_m"], t_s, columns.get("z_m"), attitude, speed, stop.astype(bool)
    )


def _check(file: str, name: str, good: NDArray[np.bool_], values: NDArray[np.float64], desired: str) -> None:
    if not good.all():
        row = int(np.argmin(good))
        raise UsageError(f"path '{file}', corner {row + 1}: {name} is {values[row]:g}; it must be {desired}")


def _check_names(file: str, columns: dict[str, Any]) -> None:
    missing = [n for n in NEEDED if n not in columns]
    some = [n for n in ATTITUDE if n in columns]
    if some and len(some) < len(ATTITUDE):
        missing += [n for n in ATTITUDE if n not in columns]
    odd = [n for n in columns if n not in KNOWN and _OTHER_UNIT.fullmatch(n)]
    for name in odd:
        ours = next(n for n in KNOWN if n.startswith(name.partition("_")[0] + "_"))
        if ours not in columns:
            raise UsageError(f"path '{file}' has the column {name}; write {ours}, in metres and seconds")
    if missing:
        raise UsageError(
            f"path '{file}' has the columns {', '.join(columns) or 'none'}; {', '.join(missing)} needed"
        )
    for name in [n for n in columns if n not in KNOWN]:
        del columns[name]


def _read_npz(file: str) -> dict[str, NDArray[np.float64]]:
    check_plain_file(file)
    try:
        with np.load(file, allow_pickle=False) as stored:
            found = {name: stored[name] for name in stored.files}
        if any(v.dtype.kind not in "biuf" for n, v in found.items() if n in KNOWN or v.ndim == 1):
            raise TypeError("no real numbers")
        return {
            n: np.atleast_1d(np.asarray(v, np.float64)) for n, v in found.items() if n in KNOWN or v.ndim == 1
        }
    except OSError as error:
        raise InputFileError(f"cannot read the path '{file}': {error.strerror or error}") from None
    except DAMAGED_ARCHIVE:
        raise UsageError(
            f"path '{file}' is no NPZ file of numbers; numpy.savez(FILE, x_m=…, y_m=…) writes one"
        ) from None


def _read_csv(file: str) -> dict[str, NDArray[np.float64]]:
    try:
        _, text = read_columns(file)
    except ValueError as error:
        raise UsageError(f"cannot read the path '{file}': {error}") from None
    if not text:
        raise UsageError(f"path '{file}' is empty; a header line and two or more corners are needed")
    return {
        name: np.array([_number(file, k, name, v) for k, v in enumerate(values, 1)], np.float64)
        for name, values in text.items()
    }


def _number(file: str, number: int, name: str, text: str) -> float:
    if name == "stop" and text in _WORDS:
        return _WORDS[text]
    try:
        return decimal_number(text)
    except ValueError:
        if name not in KNOWN:
            return 0.0
        raise UsageError(
            f"path '{file}', corner {number}: {name} is {text!r}; it must be a number without a unit"
        ) from None
