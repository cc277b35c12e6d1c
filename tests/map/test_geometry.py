"""Where the grids lie, what a point reads there, and what a header may be trusted with."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surffollow.errors import MapFileError, UsageError
from surffollow.map import HeightMap, access
from surffollow.map.header import header_fault, init_header
from surffollow.map.kernels.geometry import fit_grids, margin_grids, open_journal, reset_begin, reset_step
from surffollow.map.kernels.install import (
    install_begin,
    install_end,
    install_grids,
    operation_progress,
    reject,
)
from surffollow.map.kernels.lookup import height_at, surface_at
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import zeros

SIDE = st.floats(1e-4, 1e6)


@given(SIDE, SIDE, st.integers(1, 10**9), st.floats(1e-6, 1e3))
@settings(max_examples=300, deadline=None)
def test_the_region_is_covered_at_the_finest_resolution_that_fits(width, height, capacity, finest):
    nx, ny, grid = fit_grids(width, height, capacity, finest)
    assert nx >= 1
    assert ny >= 1
    assert nx * ny <= capacity
    assert nx * grid >= width * (1 - 1e-9)
    assert ny * grid >= height * (1 - 1e-9)
    assert grid >= finest
    if grid > finest * (1 + 1e-9):
        finer = grid * (1 - 1e-6)
        # a grid one millionth finer no longer fits
        assert np.ceil(width / finer - 1e-5) * np.ceil(height / finer - 1e-5) >= capacity * (1 - 1e-4) or (
            np.ceil(width / finer) * np.ceil(height / finer) > capacity
        )


@given(st.integers(1, 40_000), st.integers(1, 40_000), st.integers(1, 10**9))
@settings(max_examples=300, deadline=None)
def test_spare_memory_grows_the_map_by_as_many_grids_as_fit_on_every_side(nx, ny, capacity):
    m = margin_grids(nx, ny, capacity)
    assert m >= 0
    assert m == 0 or (nx + 2 * m) * (ny + 2 * m) <= capacity
    assert (nx + 2 * m + 2) * (ny + 2 * m + 2) > capacity


def test_the_papers_million_grids_cover_seventy_square_feet():
    m = HeightMap.over((0, 0, 2.54, 2.54))
    assert m.shape == (1000, 1000)
    assert m.grid_m == pytest.approx(0.00254)
    assert m.pairs.nbytes == 3_000_000
    square_feet = 2.54**2 / 0.3048**2
    assert square_feet == pytest.approx(70, rel=0.01)


def test_a_small_region_stays_in_the_middle_of_the_grown_map():
    m = HeightMap.over((1.0, 2.0, 1.5, 2.25), finest_m=0.0025)
    x0, y0, x1, y1 = m.extent_m
    assert (x0 + x1) / 2 == pytest.approx(1.25)
    assert (y0 + y1) / 2 == pytest.approx(2.125)
    assert (1.0 - x0) == pytest.approx(2.0 - y0)
    assert m.grid_m == 0.0025
    ny, nx = m.shape
    assert (nx + 2) * (ny + 2) > 1_000_000


@pytest.mark.parametrize("grids", [1, 2, 3, 7, 1000])
def test_maps_of_a_few_grids_work(grids):
    m = HeightMap.over((-1, -1, 1, 1), grids=grids)
    assert np.isnan(m.heights_m).all()
    m.add([[0.0, 0.0, 0.25]])
    assert np.nanmax(m.heights_m) == pytest.approx(0.25, abs=m.quantum_m)
    m.refocus((-0.5, -0.5, 0.5, 0.5))
    assert np.nanmax(m.heights_m) == pytest.approx(0.25, abs=m.quantum_m)


def test_wrong_settings_are_refused_with_what_was_expected():
    for bad in (
        {"grids": 0},
        {"grids": 2_000_000_000},
        {"finest_m": 0.0},
        {"quantum_m": float("nan")},
        {"rounding": "up"},
        {"gate_m": -1.0},
        {"gate_min_count": 0},
        {"datum_m": float("inf")},
    ):
        with pytest.raises(
            UsageError, match=next(iter(bad)).replace("grids", "capacity_grids").split("_m")[0]
        ):
            HeightMap.over((0, 0, 1, 1), **{"grids": 10, **bad})


def test_look_up_reads_heights_and_slopes_of_a_plane():
    y, x = np.mgrid[0:50, 0:80]
    plane = 0.1 + 0.02 * (x + 0.5) * 0.01 - 0.05 * (y + 0.5) * 0.01
    m = HeightMap.from_heights(plane, origin_m=(-0.3, 0.2), grid_m=0.01)
    rng = np.random.default_rng(2)
    for px, py in rng.uniform((-0.29, 0.21), (0.49, 0.69), (200, 2)):
        expected = 0.1 + 0.02 * (px + 0.3) - 0.05 * (py - 0.2)
        assert m.height_at(px, py) == pytest.approx(expected, abs=m.quantum_m)
        sx, sy = m.slope_at(px, py)
        assert (sx, sy) == (pytest.approx(0.02, abs=0.003), pytest.approx(-0.05, abs=0.003))
        nearest, known = height_at(m.header, m.pairs, px, py)
        assert known
        assert nearest == pytest.approx(expected, abs=0.0006)


def test_look_up_beside_the_map_and_in_holes_is_unknown():
    m = HeightMap.from_heights([[1.0, np.nan, 3.0]], origin_m=(0, 0), grid_m=1.0)
    assert np.isnan(m.height_at(1.5, 0.5))
    assert np.isnan(m.height_at(-0.1, 0.5))
    assert np.isnan(m.height_at(0.5, 1.0))
    assert np.isnan(m.height_at(float("nan"), 0.5))
    assert m.height_at(0.9, 0.5) == pytest.approx(1.0, abs=1e-4)
    assert np.isnan(m.slope_at(0.5, 0.5)).all()


def test_a_reader_whom_a_change_overtakes_gets_unknown_at_once():
    m = HeightMap.from_heights(np.ones((10, 10)), origin_m=(0, 0), grid_m=1.0)
    assert height_at(m.header, m.pairs, 5.0, 5.0)[1]
    assert reset_begin(m.header, 0.0, 0.0, 5.0, 5.0) == ml.OK
    assert not height_at(m.header, m.pairs, 5.0, 5.0)[1]
    assert not surface_at(m.header, m.pairs, 5.0, 5.0)[3]
    with pytest.raises(MapFileError, match="resetting"):
        _ = m.heights_m
    while not reset_step(m.header, m.pairs, 3):
        assert 0 <= operation_progress(m.header) <= 1
    assert not height_at(m.header, m.pairs, 2.0, 2.0)[1]
    assert np.isnan(m.heights_m).all()


def test_look_up_needs_no_write_permission():
    m = HeightMap.from_heights(np.ones((10, 10)), origin_m=(0, 0), grid_m=1.0)
    m.header.flags.writeable = m.pairs.flags.writeable = False
    assert height_at(m.header, m.pairs, 5.0, 5.0)[0] == pytest.approx(1.0, abs=1e-5)


def test_a_reset_cut_off_anywhere_is_completed():
    m = HeightMap.from_heights(np.ones((30, 30)), origin_m=(0, 0), grid_m=1.0)
    assert reset_begin(m.header, 0.0, 0.0, 4.0, 5.0) == ml.OK
    reset_step(m.header, m.pairs, 100)
    again = m.copy()
    assert header_fault(again.header, len(again.pairs)) == ""
    while not reset_step(again.header, again.pairs, 7):
        pass
    assert np.isnan(again.heights_m).all()
    assert again.region_m == (0.0, 0.0, 4.0, 5.0)


def test_only_one_operation_runs_at_a_time():
    m = HeightMap.from_heights(np.ones((30, 30)), origin_m=(0, 0), grid_m=1.0)
    assert reset_begin(m.header, 0.0, 0.0, 4.0, 5.0) == ml.OK
    assert reset_begin(m.header, 0.0, 0.0, 4.0, 5.0) == ml.BUSY
    assert install_begin(m.header, 2, 2, 1.0, 0.0, 0.0, 0.0, 1e-5) == ml.BUSY


def test_a_map_installed_in_pieces_is_the_map_that_was_sent():
    rng = np.random.default_rng(6)
    source = HeightMap.from_heights(
        rng.random((31, 17)), origin_m=(2, 3), grid_m=0.5, counts=rng.integers(0, 256, (31, 17))
    )
    target = HeightMap.over((0, 0, 9, 9), grids=600)
    w, n = source.header[0], 31 * 17
    answer = install_begin(
        target.header, w["nx"], w["ny"], w["grid_m"], w["x0_m"], w["y0_m"], w["datum_m"], w["quantum_m"]
    )
    assert answer == ml.OK
    for start in range(0, n, 50):
        stop = min(n, start + 50)
        piece = access.quanta(source.pairs, start, stop), access.counts(source.pairs, start, stop)
        assert install_end(target.header) == ml.BAD_MAP
        assert install_grids(target.header, target.pairs, start + 1, *piece) == ml.BAD_MAP
        assert install_grids(target.header, target.pairs, start, *piece) == ml.OK
    assert install_end(target.header) == ml.OK
    np.testing.assert_array_equal(target.heights_m, source.heights_m)
    np.testing.assert_array_equal(target.counts, source.counts)
    assert target.extent_m == source.extent_m


def test_an_installation_that_was_cut_off_is_rejected_not_shown():
    target = HeightMap.from_heights(np.ones((10, 10)), origin_m=(0, 0), grid_m=1.0)
    assert install_begin(target.header, 20, 6, 1.0, 0.0, 0.0, 0.0, 1e-5) == ml.TOO_SMALL
    assert install_begin(target.header, 2**62, 4, 1.0, 0.0, 0.0, 0.0, 1e-5) == ml.TOO_SMALL
    assert install_begin(target.header, 2, 6, -1.0, 0.0, 0.0, 0.0, 1e-5) == ml.BAD_MAP
    assert target.heights_m.min() == pytest.approx(1.0, abs=1e-5)
    assert install_begin(target.header, 10, 6, 1.0, 0.0, 0.0, 0.0, 1e-5) == ml.OK
    piece = np.full(7, 3, np.int16), np.ones(7, np.uint8)
    assert install_grids(target.header, target.pairs, 0, *piece) == ml.OK
    assert not height_at(target.header, target.pairs, 0.5, 0.5)[1]
    assert reject(target.header) == 1
    while not reset_step(target.header, target.pairs, 10):
        pass
    assert np.isnan(target.heights_m).all()
    assert int(target.header[0]["rejected"]) == 1


def test_a_header_that_is_not_ours_is_recognised():
    good = HeightMap.over((0, 0, 1, 1), grids=100)
    assert header_fault(good.header, len(good.pairs)) == ""
    for field, value, word in (
        ("magic", 1, "magic"),
        ("version", 9, "version"),
        ("layout_hash", 5, "layout"),
        ("capacity_grids", 10**9, "room"),
        ("state", 17, "state"),
        ("nx", 10**12, "geometry"),
        ("grid_m", -1.0, "geometry"),
        ("x0_m", float("nan"), "position"),
        ("quantum_m", 0.0, "quantum"),
    ):
        bad = good.header.copy()
        bad[field] = value
        assert word in header_fault(bad, len(good.pairs)), field


def test_a_fresh_header_has_no_map_and_takes_no_samples():
    header, pairs = zeros(ml.MapHeader), zeros(ml.GridPair, 5)
    init_header(header, capacity_grids=10)
    m = HeightMap(header, pairs)
    assert m.add([[0, 0, 0]]) == 0
    assert "no_map" in repr(m)
    assert not height_at(header, pairs, 0.0, 0.0)[1]
    open_journal(header, ml.RESETTING)
    assert int(header[0]["generation"]) == 1
