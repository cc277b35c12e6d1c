"""A service for all tests of the live map, and maps to install into it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from running_service import Service, config_text
from surffollow.client import Client
from surffollow.map import HeightMap

GRIDS = 200_000
LEASE_S = 60.0
SHORT_S = 2.0  # of those who are to outlive it


@pytest.fixture(scope="module")
def map_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """No sensors, room for 200,000 grids, a lease longer than any test; alive for the whole module."""
    text = config_text(grids=GRIDS, map=f'access_lease = "{LEASE_S} s"')
    with Service(tmp_path_factory.mktemp("map_service"), text).running() as s:
        yield s


@pytest.fixture
def short_lease_service(make_service: Callable[..., Service]) -> Service:
    """As `map_service`, with a lease of two seconds."""
    return make_service(grids=GRIDS, map=f'access_lease = "{SHORT_S} s"').start()


@pytest.fixture
def client(map_service: Service) -> Iterator[Client]:
    with map_service.attach() as c:
        yield c


def some_map(
    ny: int, nx: int, seed: int = 5, level_m: float = 0.3, origin_m: tuple[float, float] = (-1.0, 2.0)
) -> HeightMap:
    """Rough ground with holes; a third of the known grids are priors."""
    rng = np.random.default_rng(seed)
    heights = level_m + 0.05 * rng.random((ny, nx))
    heights[rng.random((ny, nx)) < 0.2] = np.nan
    counts = np.where(rng.random((ny, nx)) < 0.33, 0, rng.integers(1, 256, (ny, nx)))
    return HeightMap.from_heights(heights, origin_m=origin_m, grid_m=0.01, counts=counts, datum_m=0.25)


@pytest.fixture
def map_file(tmp_path: Path) -> Path:
    """A map of 151,403 grids (an odd number of columns, 16 pieces) as a file."""
    path = tmp_path / "ground.txt"
    some_map(389, 389 + 0).save(path)
    return path
