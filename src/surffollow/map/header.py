"""Make, check and recover the header of a map: what a daemon or a notebook does before the first sample."""

from __future__ import annotations

import math
import numbers
from typing import Any

import numpy as np

from surffollow.errors import UsageError
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import zeros
from surffollow.units import real_number

_FINEST_M, _FARTHEST_M = 1e-12, 1e12


def numbers_fault(grid_m: float, quantum_m: float, **positions_m: float) -> str:
    """Reason why these numbers are no map's, or "".

    Parameters
    ----------
    grid_m, quantum_m : float
        side of a grid, height of a count [m]: 1e-12 … 1e6
    **positions_m : float
        by name; at most 1e12 m from the origin
    """
    for name, value in (("grid_m", grid_m), ("quantum_m", quantum_m)):
        if not _FINEST_M <= value <= ml.MAX_REGION_M:
            return f"{name} must be within {_FINEST_M:g} … {ml.MAX_REGION_M:g}, not {value!r}"
    for name, value in positions_m.items():
        if not abs(value) <= _FARTHEST_M:
            return f"{name} must be finite and at most {_FARTHEST_M:g}, not {value!r}"
    return ""


def init_header(
    header: np.ndarray[Any, Any],
    *,
    capacity_grids: int,
    scratch_bytes: int | None = None,
    finest_grid_m: float = ml.DEFAULT_FINEST_GRID_M,
    quantum_m: float = ml.DEFAULT_QUANTUM_M,
    rounding: str = "unbiased",
    datum_m: float | None = None,
    gate_m: float = 0.0,
    gate_min_count: int = 8,
    seed: int = 91,
) -> None:
    """Fill in the header of a map without grids (state NO_MAP); the magic is stored last.

    Parameters
    ----------
    header : (1,) structured `MapHeader`
    capacity_grids : int
        grids that the pairs have room for, 1 … 1e9
    scratch_bytes : int
        room for a refocus; default: that of the map object
    finest_grid_m : float
        finest grid that position accuracy allows [m]
    quantum_m : float
        height of one count [m]
    rounding : str
        "unbiased" or "paper"
    datum_m : float
        height of quantum 0 [m]; None: the first sample after each reset
    gate_m : float
        outlier gate [m], 0: none
    gate_min_count : int
        samples of history that the gate needs, 1 … 255
    seed : int
        of the rounding sequence

    Raises
    ------
    UsageError
        a value out of its range
    """
    for name, value in (
        ("seed", seed),
        ("capacity_grids", capacity_grids),
        ("finest_grid_m", finest_grid_m),
        ("quantum_m", quantum_m),
        ("datum_m", 0.0 if datum_m is None else datum_m),
        ("gate_m", gate_m),
        ("gate_min_count", gate_min_count),
    ):
        real_number(value, name)
    whole = {"seed": seed, "capacity_grids": capacity_grids, "gate_min_count": gate_min_count}
    for name, value in whole.items():
        if not isinstance(value, numbers.Integral):
            raise UsageError(f"{name} must be a whole number, not {value!r}")
    if not 0 <= seed < 2**64:
        raise UsageError(f"seed must be 0 … 2^64-1, not {seed!r}")
    if not 1 <= capacity_grids <= 1_000_000_000:
        raise UsageError(f"capacity_grids must be 1 … 1e9, not {capacity_grids!r}")
    fault = numbers_fault(finest_grid_m, quantum_m, datum_m=0.0 if datum_m is None else datum_m)
    if fault:
        raise UsageError(fault.replace("grid_m", "finest_grid_m", 1))
    if rounding not in ml.ROUNDING_NAMES:
        raise UsageError(f"rounding must be one of {', '.join(ml.ROUNDING_NAMES)}, not {rounding!r}")
    if not (math.isfinite(gate_m) and gate_m >= 0) or not 1 <= gate_min_count <= ml.FULL_COUNT:
        raise UsageError(f"gate_m must be ≥ 0 and gate_min_count 1 … 255, not {gate_m!r}, {gate_min_count!r}")
    if scratch_bytes is None:
        scratch_bytes = ml.scratch_bytes(ml.default_scratch_columns(capacity_grids))
    header[...] = zeros(ml.MapHeader)
    w = header[0]
    w["version"], w["header_bytes"], w["layout_hash"] = ml.VERSION, ml.HEADER_BYTES, ml.LAYOUT_HASH
    w["capacity_grids"], w["scratch_bytes"] = capacity_grids, scratch_bytes
    w["finest_grid_m"] = finest_grid_m
    w["quantum_m"], w["inv_quantum_per_m"] = quantum_m, 1.0 / quantum_m
    w["datum_m"], w["datum_set"] = (0.0, 0) if datum_m is None else (datum_m, 1)
    w["datum_auto"] = int(datum_m is None)
    w["rounding"] = ml.ROUNDING_NAMES.index(rounding)
    w["gate_m"], w["gate_min_count"] = gate_m, gate_min_count
    w["dither_seed"] = seed
    w["state"] = ml.NO_MAP
    w["magic"] = ml.MAGIC


def tile_shift_of(nx: int, ny: int) -> int:
    """`geometry.tile_shift_for` for programs without the kernels."""
    shift = 4
    while (((nx - 1) >> shift) + 1) * (((ny - 1) >> shift) + 1) > ml.DIRTY_TILES:
        shift += 1
    return shift


def header_fault(header: np.ndarray[Any, Any], n_pairs: int) -> str:
    """Reason why this header is unusable, or "".

    Parameters
    ----------
    header : (1,) structured `MapHeader`
        as found in a kept map object
    n_pairs : int
        grid pairs behind it
    """
    w = header[0]
    if int(w["magic"]) != ml.MAGIC:
        return "it is not a map (wrong magic)"
    if int(w["version"]) != ml.VERSION or int(w["layout_hash"]) != ml.LAYOUT_HASH:
        return (
            f"it has layout {int(w['layout_hash']):016x} version {int(w['version'])}, this program expects "
            f"{ml.LAYOUT_HASH:016x} version {ml.VERSION}"
        )
    if not 1 <= int(w["capacity_grids"]) <= 2 * n_pairs:
        return f"it claims {int(w['capacity_grids'])} grids where {2 * n_pairs} have room"
    if int(w["state"]) not in range(len(ml.STATE_NAMES)) or int(w["journal_op"]) not in range(5):
        return f"its state {int(w['state'])} or journal {int(w['journal_op'])} is not one of ours"
    prefixes = (("journal_",) if w["journal_op"] else ()) + (("",) if w["state"] == ml.READY else ())
    for prefix in prefixes:
        nx, ny, grid = int(w[prefix + "nx"]), int(w[prefix + "ny"]), float(w[prefix + "grid_m"])
        if nx < 1 or ny < 1 or nx * ny > int(w["capacity_grids"]) or not (0 < grid < math.inf):
            return f"its geometry is impossible: {nx} × {ny} grids of {grid} m"
        if not all(math.isfinite(w[prefix + k]) for k in ("x0_m", "y0_m", "datum_m")):
            return "its position is not finite"
        if not 0 < float(w[prefix + "quantum_m"]) < math.inf:
            return "its quantum is not positive"
    return ""
