"""Path files: CSV with one row per sample; the lines before it, each `# key = JSON value`, are its facts.

Columns: t_s, x_m, y_m, z_m, qx, qy, qz, qw, nx, ny, nz, azimuth_rad, clearance_m, lift_m, pass, flags.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from surffollow.errors import ScanFileError
from surffollow.map.atomic_file import replacing
from surffollow.scan.path import ScanPath

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


def write_path(path: str | os.PathLike[str], plan: ScanPath) -> None:
    """Write a path file, atomically.

    Raises
    ------
    ScanFileError, MapFileError
        a fact that JSON cannot hold, or a place that cannot be written
    """
    try:
        facts = [f"# {k} = {json.dumps(v, allow_nan=False)}\n" for k, v in plan.facts.items()]
    except (TypeError, ValueError) as e:
        raise ScanFileError(f"cannot write {path}: a fact of the path is no JSON value: {e}") from e
    table = np.column_stack(
        [plan.t_s, plan.poses, plan.normal, plan.azimuth_rad, plan.clearance_m, plan.lift_m]
    )
    with replacing(path) as temporary, open(temporary, "w", encoding="ascii", newline="\n") as f:
        f.write(f"# format = {json.dumps(FORMAT)}\n")
        f.writelines(facts)
        f.write(",".join(COLUMNS) + "\n")
        for row, number, bits in zip(table.tolist(), plan.passes.tolist(), plan.flags.tolist()):
            f.write(",".join([f"{v:.9g}" for v in row]) + f",{number},{bits}\n")


def read_path(path: str | os.PathLike[str]) -> ScanPath:
    """Read a path file.

    Raises
    ------
    ScanFileError
        it cannot be read, is of another format, lacks columns, or has rows that are not numbers
    """
    try:
        lines = Path(path).read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError) as e:
        raise ScanFileError(f"cannot read {path}: {e}") from e
    facts: dict[str, Any] = {}
    first = 0
    for first, line in enumerate(lines):
        if not line.startswith("#"):
            break
        key, equals, value = line[1:].partition("=")
        if equals:
            try:
                facts[key.strip()] = json.loads(value)
            except ValueError as e:
                raise ScanFileError(f"{path}, line {first + 1}: the fact {key.strip()} is no JSON") from e
    if facts.pop("format", None) != FORMAT:
        raise ScanFileError(f"{path} is no path file of this version; expected the format {FORMAT}")
    names = lines[first].split(",") if first < len(lines) else []
    missing = [c for c in COLUMNS if c not in names]
    if missing:
        raise ScanFileError(f"{path} lacks the columns {', '.join(missing)}")
    try:
        rows = np.array([[float(v) for v in line.split(",")] for line in lines[first + 1 :] if line])
    except ValueError as e:
        raise ScanFileError(f"{path} has a row that is not numbers: {e}") from e
    if rows.ndim != 2 or rows.shape[1] != len(names) or len(rows) == 0:
        raise ScanFileError(f"{path} needs at least one row, each of {len(names)} numbers")
    at = {name: rows[:, names.index(name)] for name in COLUMNS}
    return ScanPath(
        at["t_s"],
        np.column_stack([at["x_m"], at["y_m"], at["z_m"]]),
        np.column_stack([at["nx"], at["ny"], at["nz"]]),
        at["azimuth_rad"],
        at["clearance_m"],
        at["lift_m"],
        at["flags"].astype(np.uint32),
        at["pass"].astype(np.int32),
        facts,
    )
