"""Header and grid pairs of a map from an array of heights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.errors import UsageError
from surffollow.map import access
from surffollow.map.arguments import check_answer, real_numbers
from surffollow.map.header import init_header, numbers_fault
from surffollow.map.kernels.install import install_begin, install_end
from surffollow.map.outlying_heights import needed_quantum, refuse_outlying
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import zeros
from surffollow.units import real_number


def map_of_heights(
    heights_m: ArrayLike,
    *,
    origin_m: Sequence[float],
    grid_m: float,
    counts: ArrayLike | None = None,
    quantum_m: float | None = None,
    datum_m: float | None = None,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Make a map; arguments and errors are those of `HeightMap.from_heights`.

    Parameters
    ----------
    heights_m : (ny, nx) array_like  heights [m], rows ascend in y; not finite: unknown
    origin_m : 2 numbers          x, y of the outer corner [m]
    grid_m : float                side of a grid [m]
    counts : (ny, nx) array_like  samples per grid; default: 0
    quantum_m : float             resolution of the heights [m]; default: fine enough for all
    datum_m : float               height of quantum 0 [m]; default: in the middle of the heights

    Returns
    -------
    (header, pairs)
        (1,) `MapHeader`, (n,) `GridPair`, just large enough
    """
    z = real_numbers("heights_m", heights_m)
    if z.ndim != 2 or z.size == 0:
        raise UsageError(f"heights_m must have shape (ny, nx) and at least one grid, not {z.shape}")
    corner = real_numbers("origin_m", origin_m)
    if corner.shape != (2,):
        raise UsageError(f"origin_m is x, y; its shape is {corner.shape}")
    known = np.isfinite(z)
    low, high = (float(z[known].min()), float(z[known].max())) if known.any() else (0.0, 0.0)
    given = ml.DEFAULT_QUANTUM_M if quantum_m is None else real_number(quantum_m, "quantum_m")
    grid_m, middle_m = real_number(grid_m, "grid_m"), real_number(datum_m or 0.0, "datum_m")
    fault = numbers_fault(grid_m, given, datum_m=middle_m, lowest_m=low, highest_m=high)
    if fault:
        raise UsageError(fault)
    if quantum_m is None:
        quantum_m = needed_quantum(low, high)
        refuse_outlying(z, corner.tolist(), grid_m, quantum_m)
    if datum_m is None:
        datum_m = math.floor((low + high) / 2 / quantum_m + 0.5) * quantum_m
    scaled = np.floor((np.where(known, z, datum_m) - datum_m) / quantum_m + 0.5)
    if np.abs(scaled).max() > ml.MAX_HEIGHT:
        raise UsageError(
            f"heights of shape {z.shape} from {low} to {high} m do not fit ±{ml.MAX_HEIGHT} quanta of "
            f"{quantum_m} m around {datum_m} m; give a coarser quantum_m"
        )
    samples = None if counts is None else real_numbers("counts", counts)
    if samples is not None and samples.shape != z.shape:
        raise UsageError(f"counts have shape {samples.shape}, heights {z.shape}")
    if samples is not None and not np.isfinite(samples).all():
        raise UsageError("counts must be finite")
    header = zeros(ml.MapHeader)
    init_header(header, capacity_grids=z.size, quantum_m=quantum_m, finest_grid_m=grid_m)
    answer = install_begin(
        header,
        z.shape[1],
        z.shape[0],
        float(grid_m),
        float(corner[0]),
        float(corner[1]),
        float(datum_m),
        float(quantum_m),
    )
    check_answer(answer)
    pairs = zeros(ml.GridPair, ml.pairs_of(z.size))
    heights = np.where(known, scaled, ml.UNKNOWN).astype(np.int16).reshape(-1)
    flat = None if samples is None else np.clip(samples, 0, ml.FULL_COUNT).astype(np.uint8).reshape(-1)
    access.store(pairs, 0, heights, flat)
    header["journal_progress"] = z.size
    header["samples"] = 0 if flat is None else int(flat.sum(dtype=np.int64))
    check_answer(install_end(header))
    return header, pairs
