"""Random ground for tests of scan paths."""

from __future__ import annotations

import numpy as np

import naive_scan as naive
from surffollow.scan import TerrainGrid

GRID = 0.01


def ground_of(seed, n=90, **options):
    return TerrainGrid.of(naive.rough_ground(np.random.default_rng(seed), n, GRID, **options), grid_m=GRID)
