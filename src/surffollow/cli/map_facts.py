"""Facts of a map that commands print."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surffollow.map import HeightMap


def map_facts(m: HeightMap) -> dict[str, Any]:
    """Sizes, heights [m] and counters of a map, under the names that `map info --json` prints."""
    import numpy as np

    ny, nx = m.shape
    heights, counts = m.heights_m, m.counts
    known = np.isfinite(heights)
    z = heights[known]
    return {
        "nx": nx,
        "ny": ny,
        "grid_m": m.grid_m,
        "extent_m": list(m.extent_m),
        "region_m": list(m.region_m),
        "datum_m": m.datum_m,
        "quantum_m": m.quantum_m,
        "grids": nx * ny,
        "known": int(known.sum()),
        "sampled": int((counts > 0).sum()),
        "priors": int((known & (counts == 0)).sum()),
        "saturated": int((counts == 255).sum()),
        "height_min_m": float(z.min()) if z.size else None,
        "height_mean_m": float(z.mean()) if z.size else None,
        "height_max_m": float(z.max()) if z.size else None,
        "samples": m.samples,
        "outside": m.outside,
        "clipped": m.clipped,
        "gated": m.gated,
        "invalid": m.invalid,
    }
