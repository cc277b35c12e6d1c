"""Small maps for tests."""

from __future__ import annotations

import numpy as np

from surffollow.map import HeightMap


def small(**options):
    return HeightMap.over((0, 0, 1, 1), grids=100, finest_m=0.1, **options)


def scattered(seed=0, n=300):
    return np.random.default_rng(seed).random((n, 3)) * [1, 1, 0.1]
