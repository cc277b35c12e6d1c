"""Contents of a recording, sampled: the data behind its figure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import RecordingError
from surffollow.map.formats.picture import known_part
from surffollow.record.channel_feed import SERVICE
from surffollow.record.map_rebuild import Remapper
from surffollow.record.mcap_reader import CHANNEL, MESSAGE, MESSAGE_HEAD, McapReader
from surffollow.record.mcap_records import read_channel
from surffollow.record.samples import Event
from surffollow.record.sampling import FileSamples

_RATE_NS = 10_000_000
_MAX_SAMPLES = 40_000


@dataclass
class FigureData:
    """Contents of a recording, sampled.

    Attributes
    ----------
    t_s : (n,) float64        since the first sample
    rows : (n,) records of `Sample`
    offset_m : (n,) float64   stand-off desired at that time
    map : heights (ny, nx) [m], (x, y, grid) [m] of what is known; None: it cannot be built again
    """

    source: FileSamples
    t_s: NDArray[np.float64]
    rows: NDArray[Any]
    offset_m: NDArray[np.float64]
    map: tuple[NDArray[np.float64], tuple[float, float, float]] | None
    map_fault: str = ""

    @property
    def ground_m(self) -> NDArray[np.float64]:
        """Height of channel 0's newest target point (n,) [m]; NaN where there is no new one."""
        return np.where(self.rows["seen"] & 1 != 0, self.rows["output"]["target_m"][:, 2], np.nan)

    @property
    def error_m(self) -> NDArray[np.float64]:
        """Stand-off less the desired one (n,) [m]; NaN without a distance."""
        error: NDArray[np.float64] = self.rows["output"]["range_m"][:, 0] - self.offset_m
        return error


def read_figure_data(path: str | Path, progress: Any = None) -> FigureData:
    """Sample a recording and build its map again.

    Raises
    ------
    RecordingError  no recording, or no whole cycle in it
    """
    source = FileSamples([path], _RATE_NS, progress)
    mapped, rows, offsets = Remapper(), [], []
    for part in source:
        if isinstance(part, Event):
            if part.kind == "map":
                mapped.command(part.code, part.t_ns, part.values)
            continue
        mapped.add(part.points_m)
        rows.append(part.rows)
        offsets.append(np.full(len(part.rows), float(source.sampler.params[0]["offset_m"])))
    if not sum(map(len, rows)):
        raise RecordingError(f"{path} holds no whole cycle")
    every = max(1, sum(map(len, rows)) // _MAX_SAMPLES)
    all_rows, all_offsets = np.concatenate(rows)[::every], np.concatenate(offsets)[::every]
    t_s = (all_rows["output"]["t_ns"] - all_rows["output"]["t_ns"][0]) * 1e-9
    try:
        found, fault = known_part(mapped.finish()), ""
    except RecordingError as e:
        found, fault = None, str(e)
    return FigureData(source, t_s, all_rows, all_offsets, found, fault)


def last_service(path: str | Path) -> dict[str, Any] | None:
    """The newest counters and histograms of the service, when the recording has them."""
    newest, number = None, -1
    with McapReader(path) as reader:
        for opcode, body in reader.records():
            if opcode == CHANNEL:
                found, _, topic, _, _ = read_channel(body)
                number = found if topic == "/service" else number
            elif opcode == MESSAGE and int.from_bytes(body[:2], "little") == number:
                newest = bytes(body[MESSAGE_HEAD.size :])
    return None if newest is None else SERVICE.decode(newest)
