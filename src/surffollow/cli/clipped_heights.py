"""The note on heights that a map could not hold."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from surffollow.shm.map_layout import MAX_HEIGHT

if TYPE_CHECKING:
    import numpy as np


def clipped_note(clipped: int, datum_m: float, quantum_m: float) -> str:
    """Heights that did not fit into a map, its range and the remedy, as text; "" when all did.

    Parameters
    ----------
    clipped : int      samples beyond the range of heights
    datum_m : float    middle of the range [m]
    quantum_m : float  height of one count [m]
    """
    if not clipped:
        return ""
    reach_m = MAX_HEIGHT * quantum_m
    return (
        f"{clipped} samples were beyond the map's heights, {datum_m - reach_m:.6g} to "
        f"{datum_m + reach_m:.6g} m: their grids are unknown. A map.quantum above "
        f"{1e6 * quantum_m:.4g} µm in the service's configuration makes the range wider, from the next "
        "MapReset on (HeightMap: quantum_m)"
    )


def warn_of_clipped(header: np.ndarray[Any, Any]) -> None:
    """Print the note on the map of a header, if there is one, to standard error.

    Parameters
    ----------
    header : (1,) structured `MapHeader`
    """
    w = header[0]
    note = clipped_note(int(w["clipped"]), float(w["datum_m"]), float(w["quantum_m"]))
    if note:
        click.echo(note, err=True)
