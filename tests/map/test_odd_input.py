"""Odd points, arrays and regions: each gets a plain answer, and the map stays right."""

from __future__ import annotations

import numpy as np
import pytest

from map.small_maps import scattered, small
from surffollow.errors import RegionError, UsageError
from surffollow.map import HeightMap
from surffollow.map import compose as composing


@pytest.mark.parametrize("nothing", [[], np.zeros((0, 3)), np.zeros((0, 3), np.float32)])
def test_no_points_change_nothing(nothing):
    assert small().add(nothing) == 0


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((5, 2)),
        np.zeros(6),
        np.zeros((2, 3, 3)),
        3.0,
        None,
        [["a", "b", "c"]],
        np.zeros((2, 3), complex),
        [[1, 2, 3], [1, 2]],
    ],
)
def test_what_is_no_list_of_points_is_refused(points):
    with pytest.raises(UsageError, match="points_m"):
        small().add(points)


def test_points_of_any_real_type_and_memory_order_give_the_same_map():
    points = scattered().astype(np.float32)
    plain = small()
    plain.add(points.astype(np.float64))
    wide = np.zeros((600, 6), np.float32)
    wide[::2, ::2] = points
    for form in (points, np.asfortranarray(points), wide[::2, ::2], points.tolist()):
        m = small()
        assert m.add(form) == len(points)
        assert m.pairs.tobytes() == plain.pairs.tobytes()


def test_points_that_are_not_finite_are_counted_and_dropped():
    m = small()
    assert m.add([[np.nan, 0.5, 0], [0.5, 0.5, np.inf], [0.5, -np.inf, 0], [0.5, 0.5, 1]]) == 1
    assert m.invalid == 3
    assert np.isfinite(m.heights_m).sum() == 1


def test_a_first_sample_beyond_all_heights_does_not_take_the_datum_with_it():
    m = small()
    m.add([[0.5, 0.5, 1e308], [0.1, 0.1, 0.25]])
    assert m.clipped == 1
    assert m.height_at(0.1, 0.1) == pytest.approx(0.25, abs=1e-4)


@pytest.mark.parametrize(
    "options",
    [
        {"quantum_m": -1e-3},
        {"quantum_m": 0.0},
        {"quantum_m": float("nan")},
        {"quantum_m": 1e-320},
        {"datum_m": float("nan")},
        {"datum_m": 1e308},
        {"rounding": "up"},
        {"gate_m": -1.0},
        {"gate_min_count": 256},
        {"seed": -1},
        {"seed": 2**64},
    ],
)
def test_options_that_no_map_can_have_are_refused(options):
    with pytest.raises(UsageError):
        small(**options)


@pytest.mark.parametrize("region", [(0, 0, 1), (0, 0, 1, "x"), None, "abcd", (1e300, 0, 2e300, 1)])
def test_what_is_no_region_is_refused(region):
    with pytest.raises(RegionError):
        HeightMap.over(region)
    with pytest.raises(RegionError):
        small().refocus(region)


@pytest.mark.parametrize(
    ("heights", "options"),
    [
        ([], {}),
        (np.zeros((2, 2, 2)), {}),
        ([["x"]], {}),
        ([[1.7e308, -1.7e308]], {}),
        ([[1, 2]], {"quantum_m": 0.0}),
        ([[1, 2]], {"quantum_m": float("nan")}),
        ([[1, 2]], {"counts": [[1]]}),
        ([[1, 2]], {"counts": [[np.nan, 1]]}),
        ([[1, 2]], {"origin_m": (0.0,)}),
        ([[1, 2]], {"origin_m": (np.nan, 0.0)}),
        ([[1, 2]], {"grid_m": 0.0}),
    ],
)
def test_arrays_that_make_no_map_are_refused(heights, options):
    with pytest.raises(UsageError):
        HeightMap.from_heights(heights, **{"origin_m": (0.0, 0.0), "grid_m": 0.1, **options})


def test_a_map_of_one_grid_does_everything():
    m = HeightMap.over((0, 0, 1, 1), grids=1)
    m.add([[0.5, 0.5, 2.0]])
    m.refocus((0, 0, 0.5, 0.5))
    assert m.shape == (1, 1)
    assert m.heights_m[0, 0] == pytest.approx(2.0, abs=1e-4)
    assert not m.counts.any()


def test_masked_points_and_heights_are_not_taken_for_data():
    points = np.ma.masked_array(np.ones((2, 3)), mask=True)
    for form in (points, [points[0], points[1]], points.astype(np.int32)):
        m = small()
        assert m.add(form) == 0
        assert m.invalid == 2
    m = small()
    assert m.add(np.ma.masked_array([[0.5, 0.5, 7.0], [0.1, 0.1, 0.5]], mask=[[0, 0, 1], [0, 0, 0]])) == 1
    heights = np.ma.masked_array([[1, 99], [1, 1]], mask=[[0, 1], [0, 0]])
    made = HeightMap.from_heights(heights, origin_m=(0, 0), grid_m=1.0)
    np.testing.assert_allclose(made.heights_m, [[1, np.nan], [1, 1]], atol=1e-4)


# --- composing ---------------------------------------------------------------------------------


def flat(x, y, n=20, grid=0.02):
    return HeightMap.from_heights(np.ones((n, n)), origin_m=(x, y), grid_m=grid)


def test_maps_too_far_apart_are_refused_before_memory_is_taken(monkeypatch):
    apart = [flat(0, 0), flat(100, 1e6)]
    with pytest.raises(UsageError, match=r"1e\+06 m.*GB.*--grids"):
        composing.compose(apart)
    assert np.isfinite(composing.compose(apart, grids=1000).heights_m).sum() >= 1
    monkeypatch.setattr(composing, "_bytes_available", lambda: 1e6)
    with pytest.raises(UsageError, match=r"0\.001 GB are free"):
        composing.compose([flat(0, 0), flat(1, 1)])


def test_the_estimate_of_memory_for_composing_holds():
    import tracemalloc

    for maps in (
        [flat(0, 0), flat(15, 15)],
        [flat(0, 0), flat(900, 0, 1)],
        [flat(0, 0), flat(0, 900, 1)],
    ):
        nx, ny, *_ = composing._size(maps, None)
        tracemalloc.start()
        composing.compose(maps)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak <= composing._bytes_needed(nx, ny, len(maps)), (nx, ny, peak)


@pytest.mark.parametrize("odd", ["a", None, [1.0], 1j, b"x", True])
@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("x_m", lambda odd: small().height_at(odd, 0.5)),
        ("y_m", lambda odd: small().slope_at(0.5, odd)),
        ("finest_m", lambda odd: small().refocus((0.0, 0.0, 0.5, 0.5), finest_m=odd)),
        ("grid_m", lambda odd: HeightMap.from_heights([[0.0]], origin_m=(0.0, 0.0), grid_m=odd)),
        ("quantum_m", lambda odd: HeightMap.over((0.0, 0.0, 1.0, 1.0), quantum_m=odd)),
        ("capacity_grids", lambda odd: HeightMap.over((0.0, 0.0, 1.0, 1.0), grids=odd)),
        ("gate_m", lambda odd: HeightMap.over((0.0, 0.0, 1.0, 1.0), gate_m=odd)),
    ],
)
def test_an_argument_that_is_no_number_is_named(name, call, odd):
    with pytest.raises(UsageError, match=rf"^{name} is .*; it must be a number$"):
        call(odd)


@pytest.mark.parametrize("argument", ["grids", "gate_min_count", "seed"])
def test_a_number_that_must_be_whole_is_named(argument):
    with pytest.raises(UsageError, match=r"must be a whole number, not 8\.5"):
        HeightMap.over((0, 0, 1, 1), **{argument: 8.5})
