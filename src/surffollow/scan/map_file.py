"""The ground of a map file, with the step of its heights, and whether that step is fine enough for a gap."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from surffollow.config.input_file import contents_are_read
from surffollow.errors import ScanInputError
from surffollow.scan.checks import positive
from surffollow.scan.grid import TerrainGrid

if TYPE_CHECKING:
    from surffollow.map import HeightMap

WARNED_PART = 0.01  # of the gap: half a step above it is warned of
REFUSED_PART = 0.1  # and above this refused


@contents_are_read()
def read_ground(path: str | os.PathLike[str]) -> tuple[TerrainGrid, HeightMap | None]:
    """A terrain grid of a map file; heights of a raster (.asc, .tif) in full precision.

    Parameters
    ----------
    path : path

    Returns
    -------
    TerrainGrid, HeightMap
        the map that the heights are of, with its quantum; None for a raster

    Raises
    ------
    MapFileError
        it cannot be read, or has a few heights far from all others
    """
    from surffollow.map import HeightMap
    from surffollow.map.files import load_raster

    raster = load_raster(path)
    if raster is None:
        m = HeightMap.load(path)
        return TerrainGrid.from_map(m), m
    heights, origin, grid = raster
    return TerrainGrid.of(heights, origin_m=origin, grid_m=grid), None


def step_note(quantum_m: float, gap_m: float, name: str) -> str:
    """Warning where a height may be half a step too low, and that is not small beside the gap; "" if it is.

    Parameters
    ----------
    quantum_m : float [m]    step of the heights; 0: none
    gap_m : float [m]
    name : str               of the map

    Raises
    ------
    ScanInputError
        half a step is more than a tenth of the gap, or there is no gap
    """
    part = 0.5 * quantum_m / positive("gap_m", gap_m)
    if part <= WARNED_PART:
        return ""
    text = (
        f"{name} has heights in steps of {1e3 * quantum_m:.3g} mm, and half a step is {100 * part:.2g} % of "
        f"the gap of {gap_m:g} m"
    )
    if part > REFUSED_PART:
        raise ScanInputError(
            f"{text}: the ground may be that much higher; give the heights as .asc or .tif, which are read "
            "in full precision, a map with less relief (a smaller region), or a larger gap"
        )
    return text
