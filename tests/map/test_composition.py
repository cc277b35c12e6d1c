"""Maps put together and compared."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from map.sampled_maps import sampled
from surffollow.cli.map import map_group
from surffollow.map import HeightMap
from surffollow.map.compose import compose, composition, difference


def test_halves_of_a_map_compose_to_the_whole_without_any_loss():
    whole = sampled(share=1.0)
    z, c = whole.heights_m, whole.counts
    x0, y0 = whole.origin_m
    k = whole.shape[1] // 2
    parts = [
        HeightMap.from_heights(
            z[:, a:b], origin_m=(x0 + a * whole.grid_m, y0), grid_m=whole.grid_m, counts=c[:, a:b],
            quantum_m=whole.quantum_m, datum_m=whole.datum_m,
        )
        for a, b in ((0, k), (k, whole.shape[1]))
    ]  # fmt: skip
    joined = compose(parts)
    np.testing.assert_allclose(joined.heights_m, z, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(joined.counts, c)
    np.testing.assert_allclose(joined.extent_m, whole.extent_m, atol=1e-12)


def test_a_composed_map_has_the_samples_of_all_maps(tmp_path):
    maps = [sampled(share=1.0), sampled(share=0.5)]
    of_counts = HeightMap.from_heights([[0.1, 0.2]], origin_m=(0, 0), grid_m=0.1, counts=[[255, 3]])
    prior = HeightMap.from_heights([[0.1, 0.2]], origin_m=(0, 0), grid_m=0.1)
    assert (of_counts.samples, prior.samples) == (258, 0)
    files = []
    for k, m in enumerate((*maps, of_counts, prior)):
        files.append(str(tmp_path / f"{k}.npz"))
        m.save(files[-1])
    words = ["compose", *files, "-o", str(tmp_path / "whole.npz"), "--json"]
    facts = json.loads(CliRunner().invoke(map_group, words, catch_exceptions=False).stdout)
    assert facts["samples"] == sum(m.samples for m in maps) + 258


def test_a_fine_map_and_one_with_more_relief_compose_to_heights_that_hold_both():
    fine = HeightMap.from_heights(np.full((2, 2), 0.1), origin_m=(0, 0), grid_m=1.0, quantum_m=25.4e-6)
    hilly = HeightMap.from_heights([[-20.0, 20.0]], origin_m=(2, 0), grid_m=1.0, quantum_m=2.54e-3)
    whole = compose([fine, hilly])
    np.testing.assert_allclose(whole.heights_m[0], [0.1, 0.1, -20.0, 20.0], atol=1.5 * whole.quantum_m)
    assert whole.quantum_m < hilly.quantum_m


def test_composing_weighs_by_counts_at_differing_resolution():
    fine = HeightMap.from_heights(
        np.full((4, 4), 1.0), origin_m=(0, 0), grid_m=0.5, counts=np.full((4, 4), 10), quantum_m=1e-4
    )
    coarse = HeightMap.from_heights(
        np.full((2, 2), 2.0), origin_m=(1, 0), grid_m=1.0, counts=np.full((2, 2), 120), quantum_m=1e-4
    )
    prior = HeightMap.from_heights(np.full((3, 6), 9.0), origin_m=(0, 0), grid_m=0.5, quantum_m=1e-3)
    both = compose([fine, coarse, prior])
    assert both.grid_m == 0.5
    # a quarter of the coarse grid's 120 samples fell on each fine grid: (10·1 + 30·2)/40
    assert both.height_at(1.25, 0.25) == pytest.approx(1.75, abs=1e-4)
    assert both.counts[0].tolist() == [10, 10, 40, 40, 30, 30]
    assert both.height_at(0.25, 0.25) == pytest.approx(1.0, abs=1e-4)
    assert both.height_at(2.75, 1.75) == pytest.approx(2.0, abs=1e-4)
    assert compose([fine, coarse], grids=4).shape in ((2, 2), (1, 3))


def test_difference_is_taken_on_the_first_maps_grids():
    one = HeightMap.from_heights(np.full((4, 4), 1.0), origin_m=(0, 0), grid_m=1.0)
    other = HeightMap.from_heights(np.full((3, 20), 1.01), origin_m=(0, 1), grid_m=0.4)
    d = difference(one, other)
    assert d.shape == (4, 4)
    assert np.isnan(d[0]).all()
    np.testing.assert_allclose(d[1], 0.01, atol=5e-5)


def test_grids_of_a_composed_map_are_at_most_those_asked_for(tmp_path):
    run = CliRunner()
    for name, x0 in (("a", 0.0), ("b", 0.5)):
        heights = np.zeros((10, 10)) + x0
        HeightMap.from_heights(heights, origin_m=(x0, 0.0), grid_m=0.05).save(tmp_path / f"{name}.txt")
    files = [str(tmp_path / "a.txt"), str(tmp_path / "b.txt"), "-o", str(tmp_path / "whole.txt"), "--json"]
    grids = {}
    for asked in ([], ["--grids", "50"], ["--grids", "1000"]):
        result = run.invoke(map_group, ["compose", *files, *asked])
        assert result.exit_code == 0, result.output
        facts = json.loads(result.output)
        grids[" ".join(asked)] = facts["grids"], facts["grid_m"] > 0.0501
    assert grids[""] == grids["--grids 1000"] == (200, False), "the finest map's grids where they fit"
    assert grids["--grids 50"][0] <= 50
    assert grids["--grids 50"][1]
    reported = " ".join(run.invoke(map_group, ["compose", "--help"]).output.split())
    assert "Most grids in the result: coarser ones where" in reported


def test_where_maps_differ_by_more_than_their_noise_the_higher_one_counts(tmp_path):
    """GIVEN a pole that one of two maps has WHEN they are composed THEN it keeps its height."""
    rng = np.random.default_rng(3)
    flat, options = np.zeros((30, 30)), {"origin_m": (0.0, 0.0), "grid_m": 0.05}
    seen, other = (flat + 1e-3 * rng.normal(size=flat.shape) for _ in range(2))
    seen[3:5, 7] += 0.5
    counts = np.full(flat.shape, 4)
    maps = [
        HeightMap.from_heights(seen, counts=counts, **options),
        HeightMap.from_heights(other, counts=3 * counts, **options),
    ]
    for pair in (maps, maps[::-1]):
        whole, disputed = composition(pair)
        assert disputed == 2
        np.testing.assert_allclose(whole.heights_m[3:5, 7], seen[3:5, 7], atol=2e-5)
        mean = (seen + 3 * other) / 4
        mean[3:5, 7] = whole.heights_m[3:5, 7]
        np.testing.assert_allclose(whole.heights_m, mean, atol=5e-5)
    files = [str(tmp_path / f"{k}.npz") for k in range(2)]
    for m, file in zip(maps, files):
        m.save(file)
    result = CliRunner().invoke(map_group, ["compose", *files, "-o", str(tmp_path / "all.npz"), "--json"])
    assert json.loads(result.output)["disputed"] == 2
    # an offset of a whole map is no obstacle
    lifted = HeightMap.from_heights(other + 0.02, counts=counts, **options)
    assert composition([maps[1], lifted]).disputed == 0
    # priors of two rasters follow the same rule
    priors = [HeightMap.from_heights(z, **options) for z in (seen, other)]
    assert composition(priors).disputed == 2
