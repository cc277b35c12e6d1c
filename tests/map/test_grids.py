"""The running mean in a grid: the paper's weights, rounding without bias, counts, clipping, the gate."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naive_map import NaiveMap, averaged, paper_mean, paper_weights
from surffollow.errors import UsageError
from surffollow.map import HeightMap
from surffollow.map.kernels.grids import blended, update_map
from surffollow.shm import map_layout as ml

QUANTUM = 25.4e-6


def one_grid(**kwargs):
    return HeightMap.over((0, 0, 1, 1), grids=1, finest_m=1.0, datum_m=kwargs.pop("datum_m", 0.0), **kwargs)


def add_quanta(m, quanta):
    z = np.asarray(quanta, dtype=float) * QUANTUM
    m.add(np.stack([np.full(z.size, 0.5), np.full(z.size, 0.5), z], axis=1))


@given(st.lists(st.integers(-32767, 32767), min_size=1, max_size=600))
@settings(max_examples=60, deadline=None)
def test_the_running_mean_is_the_weighted_sum_of_the_three_case_equation(heights):
    mean, count = Fraction(0), 0
    for z in heights:
        mean, count = averaged(mean, count, Fraction(z))
    weights = paper_weights(len(heights))
    assert sum(weights) == 1
    assert mean == sum(w * z for w, z in zip(weights, heights))


@given(st.integers(0, 2**32), st.integers(1, 700))
@settings(max_examples=60, deadline=None)
def test_the_stored_mean_follows_the_weight_equation_within_its_rounding(seed, n):
    """Each update rounds by less than one quantum; it fades as later samples arrive."""
    heights = np.random.default_rng(seed).integers(-32767, 32768, n)
    exact = float(sum(w * int(z) for w, z in zip(paper_weights(n), heights)))
    weighs = np.ones(n)
    for i in range(n - 2, -1, -1):
        count = min(i + 1, 255)
        weighs[i] = weighs[i + 1] * count / (count + 1)
    for rounding, worst in (("unbiased", 1.0), ("paper", 0.5)):
        m = one_grid(rounding=rounding)
        add_quanta(m, heights)
        error = abs(m.heights_m[0, 0] / QUANTUM - exact)
        assert error <= worst * weighs.sum() + 1e-6
        # errors of either sign add up like a random walk, far below that bound
        assert error <= 6.0 * worst * np.sqrt((weighs**2).sum()) + 1e-6 or rounding == "paper"
    assert m.counts[0, 0] == min(n, 255)


@given(st.integers(-32767, 32767), st.integers(0, 255), st.floats(-32767, 32767))
@settings(max_examples=300, deadline=None)
def test_paper_rounding_is_exactly_to_nearest(mean, count, z):
    assert blended(mean, count, z, True, 0.0) == paper_mean(mean, count, z)[0]


@given(
    st.integers(-32767, 32767),
    st.integers(0, 255),
    st.floats(-32767, 32767),
    st.integers(0, 2**32 - 1).map(lambda k: k * 2.0**-32),
)
@settings(max_examples=300, deadline=None)
def test_the_mean_never_leaves_its_range_nor_becomes_unknown(mean, count, z, u):
    for paper in (False, True):
        got = blended(mean, count, z, paper, u)
        assert -32767 <= got <= 32767
        low, high = (min(mean, z), max(mean, z)) if count else (z, z)
        assert low - 1 - 1e-9 <= got <= high + 1 + 1e-9


@pytest.mark.parametrize("paper", [False, True])
@pytest.mark.parametrize("gate", [0.0, 0.004])
def test_kernels_equal_the_slow_twin_bit_for_bit(paper, gate):
    rng = np.random.default_rng(7)
    m = HeightMap.over(
        (-0.4, 0.1, 0.3, 0.5),
        grids=300,
        finest_m=0.02,
        datum_m=0.01,
        rounding="paper" if paper else "unbiased",
        gate_m=gate,
    )
    ny, nx = m.shape
    naive = NaiveMap(nx, ny, m.grid_m, *m.origin_m, 0.01, QUANTUM, paper, gate)
    points = rng.uniform((-0.5, 0.0, -0.02), (0.4, 0.6, 0.02), (40_000, 3))
    points[::50, 2] += rng.choice([-0.9, 0.9], 800)
    points[rng.integers(0, 40_000, 60), rng.integers(0, 3, 60)] = np.nan
    for p in points:
        naive.add(*p.tolist())
    m.add(points[:10_000])
    for x, y, z in points[10_000:20_000]:
        update_map(m.header, m.pairs, x, y, z)
    m.add(points[20_000:])
    quanta = np.full((ny, nx), np.nan)
    counts = np.zeros((ny, nx))
    for (iy, ix), (mean, count) in naive.grids.items():
        quanta[iy, ix], counts[iy, ix] = mean, count
    np.testing.assert_array_equal(np.rint((m.heights_m - 0.01) / QUANTUM), quanta)
    np.testing.assert_array_equal(m.counts, counts)
    for name, value in naive.counters.items():
        assert getattr(m, name) == value, name
    assert int(m.header["dirty"].sum()) >= m.samples


def test_a_slow_change_after_255_samples_is_followed_without_bias():
    target = 100 + 2.5e-3 / QUANTUM
    ends = []
    for seed in range(20):
        m = one_grid(seed=seed)
        add_quanta(m, np.full(255, 100.0))
        add_quanta(m, np.full(4000, target))
        ends.append(m.heights_m[0, 0] - target * QUANTUM)
    assert np.abs(ends).max() < 0.1e-3
    assert abs(np.mean(ends)) < 0.02e-3


def test_paper_rounding_freezes_within_127_quanta():
    m = one_grid(rounding="paper")
    add_quanta(m, np.full(255, 100.0))
    add_quanta(m, np.full(4000, 227.0))
    assert m.heights_m[0, 0] == pytest.approx(100 * QUANTUM)
    add_quanta(m, [228.0])
    assert m.heights_m[0, 0] == pytest.approx(101 * QUANTUM)


def test_mean_error_over_many_grids_is_below_a_fiftieth_of_a_quantum():
    """40,000 grids, each with its own height and 300 noisy samples, visited in turn and in runs."""
    rng = np.random.default_rng(4)
    for run in (1, 3, 300):
        m = HeightMap.over((0, 0, 200, 200), grids=40_000, finest_m=1.0, datum_m=0.0)
        heights = rng.uniform(-2000, 2000, 40_000)
        y, x = np.divmod(np.arange(40_000), 200)
        exact = np.zeros(40_000)
        samples = np.arange(300)
        for start in range(0, 300, run):
            n = len(samples[start : start + run])
            z = heights[:, None] + rng.normal(0, 10, (40_000, n))
            for i in range(n):
                count = min(start + i, 255)
                exact += (z[:, i] - exact) / (count + 1)
            points = np.empty((40_000 * n, 3))
            points[:, 0], points[:, 1] = np.repeat(x + 0.5, n), np.repeat(y + 0.5, n)
            points[:, 2] = z.reshape(-1) * QUANTUM
            m.add(points)
        error = m.heights_m.reshape(-1) / QUANTUM - exact
        assert abs(error.mean()) <= 0.02, f"runs of {run}"
        assert error.std() < 3.0


def test_a_prior_is_replaced_by_the_first_sample():
    m = HeightMap.from_heights([[0.5, np.nan]], origin_m=(0, 0), grid_m=1.0, datum_m=0.5, quantum_m=QUANTUM)
    m.add([[0.5, 0.5, 0.4]])
    assert m.heights_m[0, 0] == pytest.approx(0.4, abs=QUANTUM)
    assert m.counts.tolist() == [[1, 0]]
    assert np.isnan(m.heights_m[0, 1])


def add_one(m, z_m):
    """By the kernel for one point."""
    update_map(m.header, m.pairs, 0.5, 0.5, z_m)


def add_list(m, z_m):
    """By the kernel for many points."""
    m.add([[0.5, 0.5, z_m]])


@pytest.mark.parametrize("add", [add_one, add_list])
@pytest.mark.parametrize("rounding", ["unbiased", "paper"])
@pytest.mark.parametrize("beyond_m", [5.0, -5.0, 1e300, 0.8324])
def test_a_height_beyond_the_range_is_no_height_and_its_grid_becomes_unknown(add, rounding, beyond_m):
    m = one_grid(rounding=rounding)
    # GIVEN an unknown grid, WHEN such a height comes, THEN it stays unknown, and the sample is counted
    add(m, beyond_m)
    assert (m.clipped, m.samples, m.counts[0, 0]) == (1, 0, 0)
    assert np.isnan(m.heights_m[0, 0])
    # GIVEN a known grid, THEN its mean is not shown any more, and a viewer of its tile sees that
    for _ in range(3):
        add(m, 0.1)
    seen = int(m.header["dirty"].sum())
    add(m, beyond_m)
    assert (m.clipped, m.samples, m.counts[0, 0]) == (2, 3, 0)
    assert np.isnan(m.heights_m[0, 0])
    assert np.isnan(m.height_at(0.5, 0.5))
    assert int(m.header["dirty"].sum()) == seen + 1
    # the next height within the range makes it known; nothing of the mean before is in it
    add(m, 0.3)
    assert (m.heights_m[0, 0], m.counts[0, 0]) == (pytest.approx(0.3, abs=QUANTUM), 1)
    add(m, -np.inf)
    assert (m.invalid, m.clipped) == (1, 2)


def test_every_known_height_of_ground_beyond_the_range_is_right():
    x = np.linspace(0, 100, 20_001)
    points = np.c_[x, 0 * x + 0.5, -3000 + 3 * np.sin(x / 5)]
    m = HeightMap.over((0, 0, 100, 1))
    m.add(points)
    known = np.isfinite(m.heights_m)
    centres = m.origin_m[0] + (np.arange(m.shape[1]) + 0.5) * m.grid_m
    error = np.abs(m.heights_m + 3000 - 3 * np.sin(centres / 5))[known]
    assert error.max() < 5e-3  # the ground's change across a grid
    assert m.clipped + m.samples == len(points) - m.outside
    assert m.clipped > 10_000


def test_the_gate_protects_a_mean_from_a_single_height_beyond_the_range():
    m = one_grid(gate_m=0.005)
    add_quanta(m, np.full(200, 100.0))
    m.add([[0.5, 0.5, 5.0]])
    assert (m.gated, m.clipped) == (1, 0)
    assert m.heights_m[0, 0] == pytest.approx(100 * QUANTUM)
    m.add(np.tile([[0.5, 0.5, 5.0]], (40, 1)))
    assert np.isnan(m.heights_m[0, 0])


def test_a_map_that_is_laid_anew_has_clipped_nothing():
    m = one_grid()
    m.add([[0.5, 0.5, 5.0]])
    m.refocus((0, 0, 1, 1))
    assert m.clipped == 1
    m.reset((0, 0, 1, 1))
    assert m.clipped == 0


def test_the_datum_is_the_first_sample_so_that_the_range_is_centred_on_the_ground():
    m = HeightMap.over((0, 0, 1, 1), grids=4, finest_m=0.5)
    m.add([[0.5, 0.5, 812.3456], [0.6, 0.6, 812.3456 + 0.8], [0.1, 0.1, 812.3456 - 0.8]])
    assert abs(m.datum_m - 812.3456) <= QUANTUM
    assert m.clipped == 0
    m.reset((0, 0, 1, 1))
    m.add([[0.5, 0.5, -3.0]])
    assert abs(m.datum_m + 3.0) <= QUANTUM
    assert m.heights_m[-1, -1] == pytest.approx(-3.0, abs=QUANTUM)


def test_the_gate_refuses_an_outlier_but_yields_to_ground_that_changed():
    m = one_grid(gate_m=0.005)
    add_quanta(m, np.full(200, 100.0))
    m.add([[0.5, 0.5, 0.05]])
    assert m.gated == 1
    assert m.heights_m[0, 0] == pytest.approx(100 * QUANTUM)
    n = 0
    while m.heights_m[0, 0] < 0.045 and n < 60:
        m.add([[0.5, 0.5, 0.05]])
        n += 1
    assert n < 40
    without = one_grid()
    add_quanta(without, np.full(200, 100.0))
    without.add(np.tile([[0.5, 0.5, 0.05]], (n, 1)))
    assert without.heights_m[0, 0] < 0.01


def test_five_percent_spikes_do_not_poison_a_gated_map():
    rng = np.random.default_rng(12)
    points = rng.uniform((0, 0, 0), (1, 1, 0), (200_000, 3))
    truth = 0.01 * np.sin(5 * points[:, 0])
    points[:, 2] = truth + rng.normal(0, 0.0002, len(points))
    spikes = rng.random(len(points)) < 0.05
    points[spikes, 2] += rng.uniform(0.02, 0.1, spikes.sum())
    worst = {}
    for gate in (0.0, 0.004):
        m = HeightMap.over(
            (0, 0, 1, 1), grids=2500, datum_m=0.0, finest_m=0.02, gate_m=gate, gate_min_count=4
        )
        m.add(points)
        x = m.origin_m[0] + (np.arange(m.shape[1]) + 0.5) * m.grid_m
        worst[gate] = np.nanmean(np.abs(m.heights_m - 0.01 * np.sin(5 * x)))
    assert worst[0.004] < 0.25 * worst[0.0]


def test_the_same_points_give_the_same_bits_however_they_are_split():
    points = np.random.default_rng(1).random((5000, 3))
    maps = []
    for parts in (1, 7, 5000):
        m = HeightMap.over((0, 0, 1, 1), grids=64, finest_m=1e-3, quantum_m=1e-4)
        for chunk in np.array_split(points, parts):
            m.add(chunk)
        maps.append((m.pairs.tobytes(), m.header.tobytes()))
    assert maps[0] == maps[1] == maps[2]


def test_only_tiles_that_changed_count_up():
    m = HeightMap.over((0, 0, 100, 100), grids=10_000, finest_m=1.0)
    before = m.header[0]["dirty"].copy()
    m.add([[0.5, 0.5, 0.0], [99.5, 99.5, 0.0], [99.5, 98.5, 0.0]])
    changed = m.header[0]["dirty"] - before
    shift, tiles_x = int(m.header[0]["tile_shift"]), int(m.header[0]["tiles_x"])
    assert changed[0] == 1
    assert changed[(99 >> shift) * tiles_x + (99 >> shift)] == 2
    assert changed.sum() == 3


def test_points_of_a_wrong_shape_are_refused():
    with pytest.raises(UsageError):
        one_grid().add(np.zeros((3, 2)))


def test_layout_is_the_papers_six_bytes_and_one_header_page():
    assert ml.GridPair.SIZE == 6
    assert ml.MapHeader.SIZE <= ml.HEADER_BYTES
    assert ml.map_object_size(10**6) < 4_500_000
    for grids in (1, 2, 999, 10**6, 10**9):
        assert ml.scratch_offset(grids) >= ml.pairs_offset() + 6 * ml.pairs_of(grids)
