"""`surffollow map fill`: holes become priors, known heights stay, and a region is cut out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from click.testing import CliRunner

from surffollow.cli.main import cli
from surffollow.map import HeightMap


def filled(file: Path, *more: str) -> tuple[HeightMap, dict[str, Any]]:
    out = file.parent / "filled.npz"
    done = CliRunner().invoke(cli, ["map", "fill", str(file), "-o", str(out), "--json", *more])
    assert done.exit_code == 0, done.output
    return HeightMap.load(out), json.loads(done.stdout)


def test_holes_up_to_the_width_become_priors_and_known_heights_stay(tmp_path: Path) -> None:
    # GIVEN a map with samples, a hole of two grids, and one of four
    z = np.tile(np.arange(12.0) * 0.01, (3, 1))
    counts = np.full(z.shape, 7, np.uint8)
    hole = np.zeros(z.shape, bool)
    hole[:, 2:4] = hole[:, 6:10] = True
    counts[hole] = 0
    made = HeightMap.from_heights(
        np.where(hole, np.nan, z), origin_m=(100.0, 200.0), grid_m=0.5, counts=counts, quantum_m=1e-4
    )
    made.save(tmp_path / "map.npz")
    # WHEN it is filled up to 1 m
    m, facts = filled(tmp_path / "map.npz", "--width", "1 m")
    # THEN the narrow hole has heights without samples, the wide one stays, and nothing else changes
    np.testing.assert_allclose(m.heights_m[:, :6], z[:, :6], atol=1e-4)
    assert np.isnan(m.heights_m[:, 6:10]).all()
    np.testing.assert_array_equal(m.heights_m[~hole], made.heights_m[~hole])
    np.testing.assert_array_equal(m.counts, counts)
    assert (facts["known_before"], facts["known"]) == (18, 24)


def test_a_raster_is_filled_and_cut_and_tells_its_own_heights_from_filled_ones(tmp_path: Path) -> None:
    (tmp_path / "dem.asc").write_text(
        "ncols 4\nnrows 3\nxllcorner 10\nyllcorner 20\ncellsize 2\nNODATA_value -1\n"
        "1 1 1 1\n1 -1 1 1\n1 1 1 1\n"
    )
    m, _ = filled(tmp_path / "dem.asc", "--width", "2", "--region", "10,22,16,26")
    assert m.extent_m == (10.0, 22.0, 16.0, 26.0)
    np.testing.assert_allclose(m.heights_m, 1.0, atol=1e-4)
    np.testing.assert_array_equal(m.counts, [[1, 0, 1], [1, 1, 1]])


def test_holes_are_filled_before_the_cut(tmp_path: Path) -> None:
    z = np.ones((3, 5))
    z[:, 1:3] = np.nan
    HeightMap.from_heights(z, origin_m=(0.0, 0.0), grid_m=1.0).save(tmp_path / "map.npz")
    m, _ = filled(tmp_path / "map.npz", "--width", "2", "--region", "1,0,5,3")
    assert np.isfinite(m.heights_m).all()


def test_the_output_is_not_the_input(tmp_path: Path) -> None:
    HeightMap.from_heights(np.ones((3, 3)), origin_m=(0.0, 0.0), grid_m=1.0).save(tmp_path / "m.npz")
    words = ["map", "fill", str(tmp_path / "m.npz"), "-o", str(tmp_path / "m.npz"), "--width", "1"]
    done = CliRunner().invoke(cli, words)
    assert done.exit_code == 2
