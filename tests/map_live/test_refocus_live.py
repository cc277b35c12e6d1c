"""A refocus of a running service's map may choose its grids: the same ones change no height."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from surffollow.client import Client
from surffollow.errors import RefusedError, RegionError
from surffollow.map import HeightMap
from surffollow.shm import layout_board as lb

REGION = (-0.5, 2.4, 0.013, 3.017)  # no edge on the lattice


def uploaded(client: Client, folder: Path) -> HeightMap:
    return HeightMap.load(client.upload_map(folder / "now.txt"))


def test_the_grids_that_are_there_stay_with_every_height(
    client: Client, map_file: Path, tmp_path: Path
) -> None:
    # GIVEN a live map
    client.map_install(map_file)
    before = uploaded(client, tmp_path)
    # WHEN it is laid over another region with the grids that it has
    client.map_refocus(REGION, finest_m=before.grid_m)
    after = uploaded(client, tmp_path)
    # THEN grids lie on the old lattice, with the heights that they had
    assert after.grid_m == before.grid_m
    columns, rows = ((a - b) / before.grid_m for a, b in zip(after.origin_m, before.origin_m, strict=True))
    assert (columns, rows) == (pytest.approx(round(columns)), pytest.approx(round(rows)))
    shift_x, shift_y = round(columns), round(rows)
    ny, nx = after.shape
    old, known = np.full((ny, nx), np.nan), before.heights_m  # each reading of the property makes a copy
    for row in range(ny):
        for column in range(nx):
            y, x = row + shift_y, column + shift_x
            if 0 <= y < known.shape[0] and 0 <= x < known.shape[1]:
                old[row, column] = known[y, x]
    np.testing.assert_array_equal(after.heights_m, old)
    assert np.isfinite(old).sum() > 1000
    x0, y0, x1, y1 = after.extent_m
    # THEN they cover the region
    assert x0 <= REGION[0] and y0 <= REGION[1] and x1 >= REGION[2] and y1 >= REGION[3]  # noqa: PT018


def test_other_grids_are_as_fine_as_asked_for_and_the_choice_counts_once(
    client: Client, map_file: Path, tmp_path: Path
) -> None:
    # GIVEN a live map
    client.map_install(map_file)
    # WHEN a grid is asked for, THEN it is taken
    client.map_refocus(REGION, finest_m=0.005)
    assert uploaded(client, tmp_path).grid_m == 0.005
    # WHEN none is asked for, THEN the configured one is
    client.map_refocus(REGION)
    assert uploaded(client, tmp_path).grid_m == pytest.approx(2.54e-3)  # map.finest_grid
    # WHEN one is too fine for the memory, THEN the finest that fits is taken
    client.map_refocus(REGION, finest_m=1e-6)  # finer than memory allows
    assert uploaded(client, tmp_path).grid_m == pytest.approx(np.sqrt(0.513 * 0.617 / 200_000), rel=0.01)


def test_a_size_that_no_grid_has_is_refused_by_client_and_service(client: Client, map_file: Path) -> None:
    client.map_install(map_file)
    for wrong in (-1.0, 1e-7, 1e5, float("nan"), float("inf")):
        with pytest.raises(RegionError, match="the finest grid"):
            client.map_refocus(REGION, finest_m=wrong)
        with pytest.raises(RefusedError) as refused:
            client._ask(lb.RQ_MAP_REFOCUS, (*REGION, wrong), 30.0, True)
        assert refused.value.code == lb.ERR_BAD_VALUE
    assert (client.map_window().counts > 0).any()  # it is there still
