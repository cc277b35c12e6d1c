"""Samples as a table: one row per sample, one column per number, units in the names."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import FaultError, RecordingError
from surffollow.extras import install_command
from surffollow.map.formats.atomic_file import replacing
from surffollow.record.samples import Event
from surffollow.record.sampling import FileSamples
from surffollow.shm.layout_adaptive import HEALTH_NAMES
from surffollow.shm.layout_follow import CHANNELS, MODE_ADAPTIVE, VALID, Output

Table = dict[str, NDArray[Any]]
_POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_AXES = {
    "demand": ("demand_x_m", "demand_y_m", "demand_z_m", "demand_rx_rad", "demand_ry_rad", "demand_rz_rad"),
    "normal": ("normal_x", "normal_y", "normal_z"),
}
# given by other columns, or the same in every row
_LEFT_OUT = ("t_ns", "pose_t_ns", "cycle", "epoch", "fresh")


def collect(source: FileSamples) -> tuple[NDArray[Any], NDArray[np.int64], NDArray[np.float64], list[Event]]:
    """All samples of files: (n,) rows of `Sample`, their segments (n,), target points (p, 3) [m], events.

    Raises
    ------
    RecordingError  no sample in any of the files
    """
    rows: list[NDArray[Any]] = []
    segments: list[NDArray[np.int64]] = []
    points: list[NDArray[np.float64]] = []
    events: list[Event] = []
    for part in source:
        if isinstance(part, Event):
            events.append(part)
            continue
        rows.append(part.rows)
        points.append(part.points_m)
        segments.append(np.full(len(part.rows), source.segment))
    if not sum(map(len, rows)):
        names = ", ".join(str(p) for p in source.paths)
        raise RecordingError(
            f"{names}: no whole cycle" + (f" ({'; '.join(source.damage)})" if source.damage else "")
        )
    return np.concatenate(rows), np.concatenate(segments), np.concatenate(points), events


def as_table(
    rows: NDArray[Any], segments: NDArray[np.int64], channels: int, mode: int, wall_ns: int
) -> Table:
    """Columns of samples.

    Parameters
    ----------
    rows : (n,) records of `Sample`
    segments : (n,) int64
    channels : in use
    mode : MODE_…, of the parameters in force at the end
    wall_ns : CLOCK_REALTIME less CLOCK_MONOTONIC; 0: unknown, the column is left out
    """
    o = rows["output"]
    out: Table = {"time_s": (o["t_ns"] - o["t_ns"][0]) * 1e-9, "t_ns": o["t_ns"]}
    if wall_ns:
        out["wall_ns"] = o["t_ns"] + wall_ns
    out |= {"segment": segments, "cycle": o["cycle"], "valid": (o["status"] & VALID) != 0}
    out["pose_t_ns"] = o["pose_t_ns"]
    for k, name in enumerate(_POSE):
        out[f"pose_{name}"] = rows["pose"][:, k]
    out["pose_delay_ns"] = rows["pose_delay_ns"]
    for f in Output.FIELDS:
        if f.name in _LEFT_OUT:
            continue
        if f.name == "target_m":
            for c in range(channels):
                # a target point is written once, in the row after it was found
                seen = (rows["seen"] >> c) & 1 != 0
                for k, axis in enumerate("xyz"):
                    out[f"target{c}_{axis}_m"] = np.where(seen, o[f.name][:, 3 * c + k], np.nan)
        elif f.count == CHANNELS:
            stem, _, unit = f.name.partition("_")
            out |= {f"{stem}{c}_{unit}": o[f.name][:, c] for c in range(channels)}
        elif f.count > 1:
            out |= {name: o[f.name][:, k] for k, name in enumerate(_AXES[f.name])}
        else:
            out[f.name] = o[f.name]
    if mode == MODE_ADAPTIVE:
        names = np.array([*HEALTH_NAMES, "?"])
        out["health_name"] = names[np.clip(o["health"], 0, len(HEALTH_NAMES))]
    return out


def table_of(source: FileSamples) -> Table:
    """The table of files; see `collect`."""
    rows, segments, _, _ = collect(source)
    p = source.sampler.params[0]
    return as_table(rows, segments, int(p["n_channels"]), int(p["mode"]), source.wall_offset_ns)


def write_csv(path: str | Path, table: Table) -> None:
    """Write a table as CSV, atomically: numbers so that they read back the same, empty cells for NaN.

    Raises
    ------
    MapFileError  the file cannot be written
    """
    with replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(table)
        writer.writerows(zip(*map(_cells, table.values())))


def _cells(column: NDArray[Any]) -> Iterable[Any]:
    if column.dtype.kind == "f":
        return ["" if v != v else v for v in column.tolist()]
    return [int(v) for v in column.tolist()] if column.dtype.kind == "b" else column.tolist()


def write_parquet(path: str | Path, table: Table) -> None:
    """Write a table as Parquet (extra `parquet`), atomically; NaN stays NaN.

    Raises
    ------
    FaultError  pyarrow is missing; MapFileError: the file cannot be written
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise FaultError(f"Parquet needs pyarrow: {install_command('parquet')}, or take --to csv") from None
    with replacing(path) as temporary:
        pq.write_table(pa.table({k: np.ascontiguousarray(v) for k, v in table.items()}), temporary)
