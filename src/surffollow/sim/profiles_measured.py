"""Measured profiles: rows of the shared height maps, and any CSV with x_m,height_m."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surffollow.config.input_file import check_plain_file, contents_are_read
from surffollow.config.pose_limits import MAX_POSITION_M
from surffollow.errors import InputFileError, UsageError
from surffollow.sim.profiles import MARGIN_M, SPACING_M, Profile, grid_x, made

MAX_HEIGHT_M = 1e5  # beyond, a square of a height says nothing about millimetres
MAX_POINTS = 20_000_000  # 160 MB per column
PEAK_TO_PEAK_M = 0.03  # a measured row is scaled to the height of the FY91 field


def data_dir() -> Path | None:
    """Folder of measured data: SURFFOLLOW_DATA, else `../shared/data` beside the checkout; None if absent."""
    named = os.environ.get("SURFFOLLOW_DATA")
    path = Path(named) if named else Path(__file__).resolve().parents[4] / "shared" / "data"
    return path if path.is_dir() else None


def _row_profile(name: str, rows: NDArray[np.float64], seed: int) -> Profile:
    """Stretch a few neighbouring rows, laid end to end without a jump, over the path."""
    from scipy.signal import detrend  # a second that all that measures nothing saves

    x = grid_x()
    first = int(np.random.default_rng([seed, 53]).integers(len(rows)))
    row = detrend(rows[first])
    h = np.interp(np.linspace(0.0, len(row) - 1.0, len(x)), np.arange(len(row)), row)
    return made(name, x, h * (PEAK_TO_PEAK_M / np.ptp(h)))


def jacksboro(seed: int = 0) -> Profile:
    """A row of the Jacksboro fault elevation model (SRTM), scaled to the path and to 30 mm."""
    return _row_profile("jacksboro", _load("jacksboro_fault_dem.npz", "elevation"), seed)


def microscope(seed: int = 0) -> Profile:
    """A row of a measured machined surface, scaled to the path and to 30 mm."""
    return _row_profile("microscope", _load("microscope_height_maps.npz", "st_sur-2_sur"), seed)


def _load(file: str, key: str) -> NDArray[np.float64]:
    folder = data_dir()
    if folder is None:
        raise UsageError("measured surfaces need the data folder; set SURFFOLLOW_DATA to it")
    rows = np.load(folder / "surfaces" / file)[key].astype(np.float64)
    return np.asarray(rows[np.isfinite(rows).all(axis=1)])


MEASURED: dict[str, Callable[[int], Profile]] = {"jacksboro": jacksboro, "microscope": microscope}


@contents_are_read()
def read_csv(path: str | Path) -> Profile:
    """Read a profile from a CSV file whose columns are x_m and height_m (a header line is optional).

    Returns
    -------
    Profile on the usual spacing; the tool travels from the first x to the last.

    Raises
    ------
    InputFileError
        it cannot be read
    UsageError
        when the file has fewer than two rows, x does not grow from row to row, or a number is
        out of bounds
    """
    check_plain_file(path)
    try:
        with open(path, encoding="utf-8-sig") as stream:
            lines = [line.strip() for line in stream if line.strip() and not line.startswith("#")]
    except OSError as error:
        raise InputFileError(f"cannot read the surface '{path}': {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise UsageError(f"surface '{path}' is no text in UTF-8: {error}") from None
    columns = [0, 1]
    if lines and not _is_number(lines[0].split(",")[0]):
        header = [name.strip().strip('"') for name in lines.pop(0).split(",")]
        if "x_m" not in header or "height_m" not in header:
            raise UsageError(f"surface '{path}' has columns {header}, expected x_m and height_m")
        columns = [header.index("x_m"), header.index("height_m")]
    try:
        rows = np.array([[float(line.split(",")[c]) for c in columns] for line in lines], np.float64)
    except (ValueError, IndexError) as error:
        raise UsageError(f"surface '{path}' has a row that is not two numbers: {error}") from error
    if len(rows) < 2 or not np.isfinite(rows).all() or (np.diff(rows[:, 0]) <= 0.0).any():
        raise UsageError(f"surface '{path}' needs two or more finite rows with x_m growing from row to row")
    for column, values, most_m in (
        ("x_m", rows[:, 0], MAX_POSITION_M),
        ("height_m", rows[:, 1], MAX_HEIGHT_M),
    ):
        largest = float(values[np.abs(values).argmax()])
        if abs(largest) > most_m:
            raise UsageError(f"surface '{path}' has the {column} {largest:g}, expected at most ±{most_m:g} m")
    n, spacing_m, length_m = _grid_of(rows[:, 0])
    if n > MAX_POINTS:
        raise UsageError(
            f"surface '{path}' is {length_m:g} m long, expected at most {MAX_POINTS * spacing_m:g} m at the "
            f"spacing of {1e3 * spacing_m:g} mm; take a part of it"
        )
    return from_points(Path(path).stem, rows[:, 0], rows[:, 1])


def _grid_of(x_m: NDArray[np.float64]) -> tuple[int, float, float]:
    """Number of heights on a regular grid over points, its spacing [m], and the length of their path [m]."""
    length_m = float(x_m[-1] - x_m[0])
    spacing_m = min(SPACING_M, max(float(np.diff(x_m).min()), 0.1e-3))
    return int(np.ceil((length_m + 2 * MARGIN_M) / spacing_m)) + 1, spacing_m, length_m


def from_points(name: str, x_m: NDArray[np.float64], height_m: NDArray[np.float64]) -> Profile:
    """Put points (x growing) on a regular grid fine enough for them, at most 0.5 mm."""
    n, spacing, length = _grid_of(x_m)
    grid = x_m[0] - MARGIN_M + spacing * np.arange(n)
    heights = np.interp(grid, x_m, height_m)
    return Profile(name, float(grid[0]), spacing, heights, start_m=float(x_m[0]), length_m=length)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
