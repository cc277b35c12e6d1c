"""Maps of random samples for tests."""

from __future__ import annotations

import numpy as np

from surffollow.map import HeightMap


def sampled(region=(-0.3, 0.2, 0.5, 0.6), grids=3000, seed=3, share=0.6, **kwargs):
    rng = np.random.default_rng(seed)
    m = HeightMap.over(region, grids=grids, **kwargs)
    x0, y0, x1, y1 = m.extent_m
    p = rng.uniform((x0, y0, 0), (x0 + share * (x1 - x0), y1, 0), (5 * grids, 3))
    p[:, 2] = 1.5 + 0.01 * np.sin(9 * p[:, 0]) * np.cos(7 * p[:, 1]) + rng.normal(0, 2e-4, len(p))
    m.add(p)
    return m
