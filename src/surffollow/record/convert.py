"""Convert recordings: to standard channels for viewers, or to tables; blocks' recordings to tables, too."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from surffollow.errors import FaultError, RecordingError, UsageError
from surffollow.map import HeightMap, access
from surffollow.map.formats.atomic_file import check_not_read, replacing
from surffollow.record import foxglove as fx
from surffollow.record.block_file import BlockFile
from surffollow.record.channels import StandardChannels
from surffollow.record.map_channel import MapPace, known_points
from surffollow.record.map_rebuild import Remapper
from surffollow.record.samples import Event
from surffollow.record.sampling import FileSamples
from surffollow.record.table import Table, table_of, write_csv, write_parquet
from surffollow.record.writer import MessageWriter

FORMATS = {"foxglove": ".foxglove.mcap", "csv": ".csv", "parquet": ".parquet"}
Progress = Callable[[float], object]


@dataclass
class Converted:
    """Counts of a conversion: `rows` of tables, `messages` for viewers."""

    files: list[str] = field(default_factory=list)
    cycles: int = 0
    rows: int = 0
    messages: int = 0
    differing: int = 0
    damage: list[str] = field(default_factory=list)


def convert(
    paths: Sequence[str | Path],
    to: str,
    out: str | Path | None = None,
    *,
    rate_hz: float = 100.0,
    force: bool = False,
    progress: Progress | None = None,
) -> Converted:
    """Convert recordings, whole or damaged, of any age that this release can read.

    Parameters
    ----------
    paths : of recordings of a service, which together become one file; or one of blocks: a table per block
    to : "foxglove", "csv" or "parquet"
    out : file to write; default: the first recording's name with another suffix
    rate_hz : samples per second; 0: every cycle
    force : replace an existing file

    Raises
    ------
    RecordingError  no recording, or nothing in it
    UsageError      the output is one of the recordings, or the format does not go with them
    FaultError      the output exists already or cannot be written, or an extra is missing
    """
    blocks = BlockFile.opened(paths[0])
    if blocks is not None:
        with blocks:
            return _convert_blocks(blocks, paths, to, out, force)
    source = FileSamples(paths, round(1e9 / rate_hz) if rate_hz > 0 else 0, progress)
    target = _target(paths, to, out, force)
    done = Converted([str(target)])
    if to == "foxglove":
        with replacing(target) as temporary:
            done.messages = _write_channels(source, temporary, target)
    else:
        table = table_of(source)
        done.rows = len(table["t_ns"])
        write_table(target, table, to)
    done.cycles, done.differing, done.damage = source.cycles, source.differing, source.damage
    return done


def write_table(path: str | Path, table: Table, to: str) -> None:
    """Write a table as CSV or Parquet."""
    (write_parquet if to == "parquet" else write_csv)(path, table)


def _target(
    paths: Sequence[str | Path], to: str, out: str | Path | None, force: bool, part: str = ""
) -> Path:
    ending = Path(FORMATS[to]).suffix or FORMATS[to]
    if out is not None and Path(out).suffix.lower() != ending:
        raise UsageError(f"--out {out}: what --to {to} writes ends in {ending}; choose such a name")
    target = Path(paths[0]).with_suffix("") if out is None else Path(out)
    if out is None or part:
        suffix = FORMATS[to] if out is None else target.suffix
        stem = target.name if out is None else target.stem
        target = target.with_name(f"{stem}{'-' + part if part else ''}{suffix}")
    check_not_read(target, *paths)
    if os.path.exists(target) and not force:
        raise FaultError(f"{target} exists already; choose another --out, or replace it with --force")
    return target


def _write_channels(source: FileSamples, path: Path, target: Path) -> int:
    """Standard channels of all files into one, which becomes `target`; the number of messages."""
    offset_ns = source.wall_offset_ns
    with MessageWriter(path, force=True, wall_offset=offset_ns, target=target) as writer:
        channels = StandardChannels(writer, source.sampler.params)
        mapped, pace, t_ns = Remapper(), MapPace(), 0
        for part in source:
            channels.take(part)
            if isinstance(part, Event):
                t_ns = part.t_ns
                if part.kind == "map":
                    mapped.command(part.code, part.t_ns, part.values)
                continue
            mapped.add(part.points_m)
            if len(part.rows):
                t_ns = int(part.rows[-1]["output"]["t_ns"])
            if mapped.map is not None and pace.free(t_ns * 1e-9):
                pace.spent(t_ns * 1e-9, _publish_map(channels, mapped.map, t_ns))
        if not writer.messages:
            raise RecordingError(f"{', '.join(map(str, source.paths))}: no whole cycle")
        try:
            _publish_map(channels, mapped.finish(), t_ns)
        except RecordingError as e:
            channels.log(t_ns, str(e), fx.WARNING)
        writer.finish({"cycles": str(source.cycles), "from": " ".join(p.name for p in source.paths)})
        return writer.messages


def _publish_map(channels: StandardChannels, m: HeightMap, t_ns: int) -> int:
    ny, nx = m.shape
    quanta = access.quanta(m.pairs, 0, nx * ny).reshape(ny, nx)
    counts = access.counts(m.pairs, 0, nx * ny).reshape(ny, nx)
    origin = (float(m.origin_m[0]), float(m.origin_m[1]))
    points, samples = known_points(quanta, counts, origin, m.grid_m, m.quantum_m, m.datum_m)
    return channels.map_points(t_ns, points, samples) if len(points) else 0


def _convert_blocks(
    blocks: BlockFile, paths: Sequence[str | Path], to: str, out: str | Path | None, force: bool
) -> Converted:
    if to == "foxglove":
        raise UsageError(
            f"{paths[0]} holds blocks, which viewers read as they are: there is nothing to convert"
        )
    if len(paths) > 1:
        raise UsageError("recordings of blocks are converted one by one")
    done = Converted()
    tables = blocks.tables()
    for name, table in tables.items():
        part = name if out is None or len(tables) > 1 else ""
        target = _target(paths, to, out, force, part)
        write_table(target, {k: np.asarray(v) for k, v in table.items()}, to)
        done.files.append(str(target))
        done.rows += len(next(iter(table.values())))
    done.damage = [str(blocks.damage)] if blocks.damage else []
    return done
