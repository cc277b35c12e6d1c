"""Read a map's text file line by line; every fault is reported with its line.

The grammar is in docs/reference/map-file-format.md. NumPy only.
"""

from __future__ import annotations

import os
import stat
import zlib
from collections.abc import Iterator
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import MapFileError
from surffollow.map import access
from surffollow.map.formats.atomic_file import Progress, report
from surffollow.map.header import numbers_fault, tile_shift_of
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import zeros

FIRST_LINE = "surffollow-map 1"
MAX_GRIDS = 10**9
_HEAD_LINE = 4096
_LONGEST_NUMBER = 24  # characters of a value, or of value*times, and the space behind it
REAL = ("grid_m", "x0_m", "y0_m", "datum_m", "quantum_m", "finest_grid_m", "gate_m")
WHOLE = (
    "nx",
    "ny",
    "datum_set",
    "datum_auto",
    "gate_min_count",
    "dither_seed",
    "dither_count",
    "dither_offset",
    "samples",
    "outside",
    "clipped",
    "gated",
    "invalid",
)
_NEEDED = ("nx", "ny", "grid_m", "x0_m", "y0_m", "datum_m", "quantum_m")


class Reader:
    """Reads one file; knows the line for its messages."""

    def __init__(self, f: TextIO, name: str) -> None:
        self.f, self.name, self.number = f, name, 0
        self.crc = 0  # of the header's lines so far

    def fail(self, what: str) -> MapFileError:
        return MapFileError(f"{self.name}:{self.number}: {what}")

    def line(self, longest: int = _HEAD_LINE) -> str:
        self.number += 1
        # a file that is one endless line must not fill the memory
        text = self.f.readline(longest)
        if len(text) == longest:
            raise self.fail(f"the line is longer than {longest} characters; this is not a map text file")
        if not text.endswith("\n"):
            raise self.fail("the file ends too early; it was cut short")
        return text.rstrip("\r\n")

    def head(self) -> Iterator[tuple[str, str]]:
        if self._head_line() != FIRST_LINE:
            raise self.fail(f"not a map text file of version 1 (the first line must be '{FIRST_LINE}')")
        said = None
        while True:
            before = self.crc
            text = self._head_line()
            if text == "heights":
                return
            if said is not None:
                raise self.fail("a line follows the header's checksum (head_crc), which is its last")
            if text and not text.startswith("#"):
                key, _, value = text.partition(" ")
                if key == "head_crc":
                    said = value
                    if said != f"{before:08x}":
                        why = f"the header's checksum is {before:08x}, head_crc says {said!r}"
                        raise self.fail(f"{why}: damaged, or changed manually; then delete the line head_crc")
                yield key, value

    def _head_line(self) -> str:
        text = self.line()
        self.crc = zlib.crc32(text.encode("ascii") + b"\n", self.crc)
        return text

    def read(
        self, capacity_grids: int | None, progress: Progress | None
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        header = zeros(ml.MapHeader)
        w = header[0]
        w["finest_grid_m"], w["gate_min_count"], w["datum_set"] = 0.0, 8, 1
        seen = set()
        for key, value in self.head():
            self._take(w, key, value)
            seen.add(key)
        missing = [k for k in _NEEDED if k not in seen]
        if missing:
            raise self.fail(f"the header lacks {', '.join(missing)}")
        nx, ny = int(w["nx"]), int(w["ny"])
        capacity = nx * ny if capacity_grids is None else capacity_grids
        self._check(w, nx, ny, capacity)
        pairs = zeros(ml.GridPair, ml.pairs_of(capacity))
        pairs["h"] = ml.UNKNOWN
        crc = self._grids(pairs, nx, ny, progress)
        unknown = pairs["h"] == ml.UNKNOWN
        pairs["c"][unknown] = 0
        if not unknown.all():
            # or the next sample would move the datum under the heights
            w["datum_set"] = 1
        end = self.line().split()
        if len(end) != 2 or end[0] != "end" or end[1] != f"{crc:08x}":
            raise self.fail(
                f"the checksum is {crc:08x}, the file says {' '.join(end)!r}: the file is damaged"
            )
        self._complete(w, capacity)
        return header, pairs

    def _take(self, w: Any, key: str, value: str) -> None:
        try:
            if key in WHOLE:
                w[key] = int(value)
            elif key in REAL:
                w[key] = float(value)
            elif key == "region_m":
                corners = [float(v) for v in value.split()]
                if len(corners) != 4 or not np.isfinite(corners).all():
                    raise ValueError("a region has four corners")
                w[key] = corners
            elif key == "rounding":
                w[key] = ml.ROUNDING_NAMES.index(value)
            # other keys: a later version may add some
        except (ValueError, OverflowError) as e:
            raise self.fail(f"'{value}' is not a value for {key}") from e

    def _check(self, w: Any, nx: int, ny: int, capacity: int) -> None:
        if nx < 1 or ny < 1 or nx * ny > MAX_GRIDS:
            raise self.fail(f"a map has 1 … 1e9 grids, this one has {nx} × {ny}")
        # before memory for a billion grids is touched: a row takes four characters or more, if it has
        # so many grids, and there are two parts
        status = os.fstat(self.f.fileno())
        least = 2 * ny * min(2 * nx, 4)
        if stat.S_ISREG(status.st_mode) and status.st_size < least:
            raise self.fail(f"the file is cut short: {nx} × {ny} grids take {least} bytes or more")
        if nx * ny > capacity:
            raise self.fail(f"the map has {nx * ny} grids, the memory has room for {capacity}")
        positions = {key: float(w[key]) for key in ("x0_m", "y0_m", "datum_m", "finest_grid_m")}
        fault = numbers_fault(float(w["grid_m"]), float(w["quantum_m"]), **positions)
        if fault:
            raise self.fail(fault)
        if not 1 <= int(w["gate_min_count"]) <= ml.FULL_COUNT or not 0 <= float(w["gate_m"]) < np.inf:
            raise self.fail("gate_m must be ≥ 0 and gate_min_count 1 … 255")

    def _grids(self, pairs: NDArray[Any], nx: int, ny: int, progress: Progress | None) -> int:
        crc = 0
        kinds: tuple[tuple[str, str, Any, int, int], ...] = (
            ("heights", "h", np.int16, ml.UNKNOWN, ml.MAX_HEIGHT),
            ("counts", "c", np.uint8, 0, ml.FULL_COUNT),
        )
        for part, (name, field, kind, low, high) in enumerate(kinds):
            if part and self.line() != name:
                raise self.fail(f"expected the line '{name}'")
            for first, last in access.row_blocks(ny, nx, 1 << 17):
                block = np.empty((last - first, nx), kind)
                for row in range(last - first):
                    block[row] = self._row(nx, low, high)
                crc = zlib.crc32(block.tobytes(), crc)
                index = np.arange(first * nx, last * nx)
                pairs[field][index >> 1, index & 1] = block.reshape(-1)
                report(progress, (part + last / ny) / 2)
        return crc

    def _row(self, nx: int, low: int, high: int) -> NDArray[np.int64]:
        text = self.line(_LONGEST_NUMBER * nx + _HEAD_LINE)
        try:
            if "*" not in text:
                values = np.array(text.split(), dtype=np.int64)
            else:
                values = self._runs(text, nx)
        except (ValueError, OverflowError) as e:
            raise self.fail("a row holds something that is not a whole number or value*times") from e
        if values.size != nx:
            raise self.fail(f"a row has {values.size} grids, nx is {nx}")
        if values.min() < low or values.max() > high:
            raise self.fail(f"a number is outside {low} … {high}")
        return values

    def _runs(self, text: str, nx: int) -> NDArray[np.int64]:
        values, times = [], []
        for token in text.split():
            value, star, n = token.partition("*")
            values.append(int(value))
            times.append(int(n) if star else 1)
        repeat = np.array(times, np.int64)
        if repeat.min() < 1 or repeat.max() > nx or int(repeat.sum()) != nx:
            raise self.fail(f"a row's runs do not add up to nx = {nx}")
        return np.repeat(np.array(values, np.int64), repeat)

    def _complete(self, w: Any, capacity: int) -> None:
        """Derived fields and defaults; the rest came from the file."""
        w["version"], w["header_bytes"], w["layout_hash"] = ml.VERSION, ml.HEADER_BYTES, ml.LAYOUT_HASH
        w["capacity_grids"] = capacity
        w["inv_grid_per_m"], w["inv_quantum_per_m"] = 1.0 / w["grid_m"], 1.0 / w["quantum_m"]
        w["finest_grid_m"] = w["finest_grid_m"] if w["finest_grid_m"] > 0 else w["grid_m"]
        if not w["region_m"].any():
            x0, y0, grid = float(w["x0_m"]), float(w["y0_m"]), float(w["grid_m"])
            w["region_m"] = [x0, y0, x0 + w["nx"] * grid, y0 + w["ny"] * grid]
        shift = tile_shift_of(int(w["nx"]), int(w["ny"]))
        w["tile_shift"], w["tiles_x"] = shift, ((w["nx"] - 1) >> shift) + 1
        w["state"], w["magic"] = ml.READY, ml.MAGIC
