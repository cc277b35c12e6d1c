"""Maps and envelopes: exact against brute force, planes kept, holes flagged, to HeightMap and back."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.ndimage import minimum_filter

import naive_scan as naive
from surffollow.errors import ScanInputError
from surffollow.map import HeightMap
from surffollow.scan.composing import compose_stations
from surffollow.scan.envelope import ball_envelope, envelope_of
from surffollow.scan.grid import FILLED, MEASURED, UNKNOWN, TerrainGrid
from surffollow.scan.holes import fill_holes
from surffollow.scan.offset_surface import disagreement, normal_offset
from surffollow.scan.terrain import _edges, terrain_map


def test_envelope_is_brute_force_to_the_last_bit():
    for seed in range(25):
        rng = np.random.default_rng(seed)
        z = naive.rough_ground(rng, int(rng.integers(20, 70)), 0.01)
        z = z[: rng.integers(1, len(z) + 1), : rng.integers(1, len(z) + 1)].copy()
        z[rng.random(z.shape) < rng.choice([0.0, 0.3, 0.97])] = np.nan
        gap = float(rng.uniform(0.3, 40)) * 0.01
        np.testing.assert_array_equal(
            ball_envelope(z, 0.01, gap), naive.ball(z, 0.01, gap), err_msg=f"seed {seed}"
        )


def test_envelope_is_exact_over_more_columns_than_a_tile():
    rng = np.random.default_rng(1)
    z = rng.normal(0, 0.1, (12, 700))
    np.testing.assert_array_equal(ball_envelope(z, 0.01, 0.11), naive.ball(z, 0.01, 0.11))


def test_rim_cells_belong_to_a_ball_of_a_whole_number_of_cells():
    z = np.full((1, 9), np.nan)
    z[0, 4] = 1.0
    e = ball_envelope(z, 0.1, 0.3)
    assert e[0, 1] == 1.0
    assert e[0, 0] == -np.inf


def test_unknown_ground_beneath_is_marked_within_the_gap():
    rng = np.random.default_rng(2)
    z = rng.normal(0, 1, (22, 26))
    z[rng.random(z.shape) < 0.01] = np.nan
    got = envelope_of(TerrainGrid.of(z, grid_m=0.01), 0.045).unknown_beneath
    np.testing.assert_array_equal(got, naive.unknown_within(z, 4.5))


@pytest.mark.parametrize(
    ("heights", "gap", "match"),
    [
        (np.zeros((0, 3)), 0.1, "at least one cell"),
        (np.full((3, 3), np.inf), 0.1, "infinite"),
        (np.zeros((3, 3)), -1.0, "above 0"),
        (np.zeros((3, 3)), np.nan, "finite"),
        (np.zeros((3, 3)), 1e3, "unit"),
    ],
)
def test_envelopes_that_cannot_be_are_refused(heights, gap, match):
    with pytest.raises(ScanInputError, match=match):
        ball_envelope(heights, 0.01, gap)


def test_offset_along_normals_is_the_envelope_on_gentle_ground():
    y, x = np.mgrid[0:120, 0:120] * 0.005
    z = 0.03 * np.sin(8 * x) * np.cos(7 * y)
    offset, envelope = normal_offset(z, 0.005, 0.08), ball_envelope(z, 0.005, 0.08)
    inner = np.s_[20:-20, 20:-20]
    assert np.abs(offset.heights_m - envelope)[inner].max() < 2e-4
    assert not offset.folded[inner].any()


def test_offset_folds_in_a_valley_and_its_highest_sheet_is_safe():
    z = np.tile(1.5 * np.abs(np.arange(100) * 0.005 - 0.25), (100, 1))
    offset, envelope = normal_offset(z, 0.005, 0.08), ball_envelope(z, 0.005, 0.08)
    inner = np.s_[20:-20, 20:-20]
    assert offset.folded.any()
    assert np.abs(offset.heights_m - envelope)[inner].max() < 5e-4
    assert not disagreement(offset, envelope, 0.005)[inner].any()
    spike = np.zeros((60, 60))
    spike[30, 30] = 0.2  # slopes over one cell know nothing of a needle's tip
    both = disagreement(normal_offset(spike, 0.005, 0.05), ball_envelope(spike, 0.005, 0.05), 0.005)
    assert both.any()


def test_map_of_scattered_points_keeps_a_plane():
    rng = np.random.default_rng(3)
    p = rng.uniform(0, 1, (5000, 3)) + (100.0, -50.0, 0.0)
    p[:, 2] = 0.3 * p[:, 0] - 0.2 * p[:, 1]
    got = terrain_map(p, 0.01, region=(100.1, -49.9, 100.9, -49.1))
    x, y = got.centres_m()
    assert np.abs(got.heights_m - (0.3 * x[None] - 0.2 * y[:, None])).max() < 1e-9
    assert set(np.unique(got.cells)) == {MEASURED, FILLED}


def test_a_measured_cell_is_where_a_point_is_and_wide_holes_stay_unknown():
    rng = np.random.default_rng(4)
    p = rng.uniform(0, 1, (20_000, 3))
    p = p[np.hypot(p[:, 0] - 0.5, p[:, 1] - 0.5) > 0.2]
    got = terrain_map(p, 0.02, region=(0, 0, 1, 1), fill_m=0.1)
    has = np.zeros(got.shape, bool)
    has[(p[:, 1] / 0.02).astype(int), (p[:, 0] / 0.02).astype(int)] = True
    np.testing.assert_array_equal(got.cells == MEASURED, has)
    assert got.cells[25, 25] == UNKNOWN
    assert np.isnan(got.heights_m[25, 25])
    assert np.isfinite(terrain_map(p, 0.02, region=(0, 0, 1, 1), fill_m=0.6).heights_m[25, 25])


def test_no_cell_inside_the_hull_is_forgotten():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        p = np.round(rng.uniform(0, 1, (60, 3)), int(rng.integers(1, 4)))  # many on lines and circles
        got = terrain_map(np.vstack([p, [[0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0]]]), 0.02, fill_m=9.0)
        inside = got.heights_m[1:49, 1:49]
        assert np.isfinite(inside).all(), f"seed {seed}"


def test_heavier_points_weigh_more_in_a_cell():
    p = np.array([[0.1, 0.1, 0.0], [0.4, 0.4, 1.0], [0.9, 0.1, 0.5]])
    got = terrain_map(p, 0.5, region=(0, 0, 1, 1), weights=[3.0, 1.0, 1.0])
    assert got.heights_m[0, 0] == pytest.approx(0.25, abs=0.06)  # moved from (0.175, 0.175) to the centre


@pytest.mark.parametrize("n", [1, 2, 5])
def test_few_points_or_points_on_a_line_make_a_map(n):
    p = np.column_stack([np.linspace(0, 0.1, n), np.zeros(n), np.ones(n)])
    got = terrain_map(p, 0.01)
    assert (got.cells == MEASURED).sum() == np.isfinite(got.heights_m).sum() == n


def test_points_that_cannot_be_are_refused():
    with pytest.raises(ScanInputError, match="finite"):
        terrain_map(np.full((4, 3), np.nan), 0.01)
    with pytest.raises(ScanInputError, match="metres"):
        terrain_map(np.array([[0.0, 0, 0], [5e4, 5e4, 0]]), 0.01)
    with pytest.raises(ScanInputError, match="no point"):
        terrain_map(np.zeros((3, 3)), 0.01, region=(5, 5, 6, 6))


def test_holes_of_a_plane_get_the_plane_up_to_the_given_width():
    y, x = np.mgrid[0:60, 0:80] * 0.01
    z = 0.4 * x - 0.1 * y
    holed = z.copy()
    holed[10:14, 10:40] = np.nan
    holed[30:50, 30:60] = np.nan
    got = fill_holes(TerrainGrid.of(holed, grid_m=0.01), 0.05)
    assert np.abs(got.heights_m - z)[10:14, 10:40].max() < 1e-12
    assert (got.cells[10:14, 10:40] == FILLED).all()
    assert np.isnan(got.heights_m[30:50, 30:60]).all()
    np.testing.assert_array_equal(got.heights_m[~np.isnan(holed)], holed[~np.isnan(holed)])


def test_a_map_goes_to_a_height_map_file_and_back_with_its_flags(tmp_path):
    z = np.random.default_rng(5).uniform(-0.1, 0.1, (30, 40))
    z[4, 5] = np.nan
    ground = fill_holes(TerrainGrid.of(z, origin_m=(1.0, -2.0), grid_m=0.02), 0.03)
    ground.heights_m[9, 9], ground.cells[9, 9] = np.nan, UNKNOWN
    ground.to_map().save(tmp_path / "g.npz")
    back = TerrainGrid.from_map(HeightMap.load(tmp_path / "g.npz"))
    np.testing.assert_allclose(back.heights_m, ground.heights_m, atol=2e-5)
    np.testing.assert_array_equal(back.cells, ground.cells)
    assert back.origin_m == ground.origin_m
    assert back.cells[4, 5] == FILLED


def test_stations_compose_into_one_map():
    def height(x, y):
        return 0.1 * x + 0.05 * np.sin(5 * y)

    grids = []
    for dx in (0.0, 0.8):
        y, x = np.mgrid[0:100, 0:100] * 0.01 + 0.005
        pose = np.eye(4)
        pose[:3, 3] = (dx, 0.0, 0.3)
        grids.append((TerrainGrid.of(height(x + dx, y) - 0.3, grid_m=0.01), pose))
    whole = compose_stations(grids, 0.01)
    x, y = whole.centres_m()
    assert whole.shape == (100, 180)
    assert np.nanmax(np.abs(whole.heights_m - height(x[None], y[:, None]))) < 1e-4


def test_a_map_takes_at_most_20_bytes_per_cell_beside_the_result() -> None:
    points = np.random.default_rng(5).random((30_000, 3)) * (1.0, 0.3, 0.3)
    region = (0.0, 0.0, 1.0, 0.3)
    terrain_map(points[:100], 0.05, region=region)  # what is loaded once does not count
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        ground = terrain_map(points, 0.001, region=region)
        peak = tracemalloc.get_traced_memory()[1] - before - ground.heights_m.nbytes - ground.cells.nbytes
    finally:
        tracemalloc.stop()
    assert peak / ground.cells.size < 20.0


@pytest.mark.parametrize("seed", range(20))
def test_edges_are_those_of_a_filter_over_the_grid(seed: int) -> None:
    random = np.random.default_rng(seed)
    shape = tuple(random.integers(1, 12, 2))
    places = random.choice(shape[0] * shape[1], random.integers(1, shape[0] * shape[1] + 1), replace=False)
    row, col = np.divmod(places, shape[1])
    height = random.normal(size=places.size)
    own = np.full(shape, np.inf)
    own[row, col] = height
    expected = height > minimum_filter(own, size=3)[row, col] + 0.3
    np.testing.assert_array_equal(_edges(row, col, height, shape[1], 0.3), expected, f"seed {seed}")
