"""Commands read by content and write by suffix; points, pictures of what is known, whole-grid refocus."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from surffollow.cli.map import map_group
from surffollow.errors import MapFileError, UsageError
from surffollow.map import HeightMap
from surffollow.map.files import EXPORTS, export, load
from surffollow.map.formats.picture import known_bounds, known_part


def small(seed: int = 1) -> HeightMap:
    rng = np.random.default_rng(seed)
    heights = rng.normal(0.02, 0.003, (12, 17))
    heights[3:5, 2:9] = np.nan
    return HeightMap.from_heights(
        heights, origin_m=(-1.5, 700_000.25), grid_m=0.01, counts=rng.integers(1, 9, heights.shape)
    )


def call(*words: object) -> Result:
    return CliRunner().invoke(map_group, [str(w) for w in words])


@pytest.mark.parametrize("suffix", [".txt", ".npz", ".asc", ".tif"])
@pytest.mark.parametrize("name", ["map", "map.png", "map.npz", "map.txt"])
def test_a_map_is_read_by_what_it_holds_not_by_its_name(tmp_path: Path, suffix: str, name: str) -> None:
    m = small()
    made = tmp_path / f"made{suffix}"
    export(made, m.header, m.pairs)
    renamed = made.rename(tmp_path / name)
    assert HeightMap(*load(renamed)).shape == (12, 17)
    assert call("info", renamed, "--json").exit_code == 0
    assert call("compose", renamed, "-o", tmp_path / "whole.npz").exit_code == 0


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf", ".ply", ".las", ".xyz"])
def test_what_is_no_map_is_refused_by_what_it_is(tmp_path: Path, suffix: str) -> None:
    m = small()
    made = tmp_path / f"made{suffix}"
    export(made, m.header, m.pairs)
    with pytest.raises(MapFileError, match=r"is (a|an) .*maps are read from the map's text file"):
        load(made)


@pytest.mark.parametrize("verb", ["export", "compose", "refocus"])
def test_every_command_writes_the_same_formats_and_names_them_when_it_refuses(
    tmp_path: Path, verb: str
) -> None:
    small().save(tmp_path / "m.txt")
    for suffix in (*EXPORTS, ".doc", ""):
        target = tmp_path / f"out{suffix}"
        words = {
            "export": [tmp_path / "m.txt", target],
            "compose": [tmp_path / "m.txt", "-o", target],
            "refocus": ["-o", target, tmp_path / "m.txt", "--", -1.5, 700_000.25, -1.4, 700_000.3],
        }[verb]
        done = call(verb, *words)
        if suffix in EXPORTS:
            assert done.exit_code == 0, (suffix, done.output)
            assert target.stat().st_size > 0
        else:
            assert isinstance(done.exception, UsageError)
            assert ", ".join(EXPORTS) in str(done.exception)
            assert not target.exists()


@pytest.mark.parametrize("suffix", [".xyz", ".las"])
def test_points_lie_at_the_centres_of_known_grids(tmp_path: Path, suffix: str) -> None:
    m = small()
    path = tmp_path / f"m{suffix}"
    export(path, m.header, m.pairs)
    if suffix == ".las":
        laspy = pytest.importorskip("laspy")
        las = laspy.read(path)
        points = np.column_stack([las.x, las.y, las.z])
        np.testing.assert_array_equal(las.intensity, m.counts[np.isfinite(m.heights_m)])
    else:
        points = np.loadtxt(path)
    row, column = np.nonzero(np.isfinite(m.heights_m))
    np.testing.assert_allclose(points[:, 0], m.origin_m[0] + (column + 0.5) * m.grid_m, atol=1e-4)
    np.testing.assert_allclose(points[:, 1], m.origin_m[1] + (row + 0.5) * m.grid_m, atol=1e-4)
    np.testing.assert_allclose(points[:, 2], m.heights_m[row, column], atol=1e-6)


def test_a_picture_shows_what_is_known_and_no_lone_grid_gets_lost() -> None:
    m = HeightMap.over((0.0, 0.0, 10.0, 10.0), grids=4_000_000, finest_m=0.001)
    points = np.array([[2.0, 3.0, 0.01], [8.5, 3.2, 0.02], [5.0, 3.1, 0.03]])
    m.add(points)
    r0, r1, c0, c1, n = known_bounds(m.header, m.pairs) or (0,) * 5
    assert n == 3
    assert (r1 - r0) * m.grid_m == pytest.approx(0.2, abs=0.02)
    assert (c1 - c0) * m.grid_m == pytest.approx(6.5, abs=0.02)
    heights, (x0, y0, spacing) = known_part(m) or pytest.fail("nothing is shown")
    assert max(heights.shape) <= 801
    row, column = np.nonzero(np.isfinite(heights))
    found = np.column_stack([x0 + (column + 0.5) * spacing, y0 + (row + 0.5) * spacing, heights[row, column]])
    expected = points[np.lexsort((points[:, 0], points[:, 1]))]
    np.testing.assert_allclose(found, expected, atol=spacing)
    np.testing.assert_allclose(found[:, 2], expected[:, 2], atol=1e-4)


def scanned(rounding: str = "unbiased") -> HeightMap:
    m = HeightMap.over((0.0, 0.0, 2.0, 1.0), grids=1_000_000, rounding=rounding)
    x = np.linspace(0.1, 1.9, 4000)
    m.add(np.column_stack([x, 0.5 + 0.01 * np.sin(9 * x), 0.01 * np.cos(7 * x)]))
    return m


def heights_at_centres(m: HeightMap) -> dict[tuple[int, int], float]:
    """Known heights by place, in micrometres."""
    row, column = np.nonzero(np.isfinite(m.heights_m))
    x, y = m.origin_m[0] + (column + 0.5) * m.grid_m, m.origin_m[1] + (row + 0.5) * m.grid_m
    return {(round(a * 1e6), round(b * 1e6)): z for a, b, z in zip(x, y, m.heights_m[row, column].tolist())}


@pytest.mark.parametrize(
    "region", [(0.5, 0.45, 1.0, 0.55), (0.12345, 0.4, 1.87654, 0.6), (-0.3, 0.1, 1.1, 2.0)]
)
def test_a_refocus_that_keeps_the_grid_size_moves_whole_grids_and_changes_no_height(
    region: tuple[float, float, float, float],
) -> None:
    m = scanned()
    before, grid = heights_at_centres(m), m.grid_m
    m.refocus(region)
    after = heights_at_centres(m)
    assert m.grid_m == grid
    x0, y0, x1, y1 = m.extent_m
    assert x0 <= region[0] + 1e-9
    assert y0 <= region[1] + 1e-9
    assert x1 >= region[2] - 1e-9
    assert y1 >= region[3] - 1e-9
    for (x, y), z in after.items():
        near = [before[p] for p in ((x + i, y + j) for i in (-1, 0, 1) for j in (-1, 0, 1)) if p in before]
        assert near == [z]
    inside = [p for p in before if x0 * 1e6 < p[0] < x1 * 1e6 and y0 * 1e6 < p[1] < y1 * 1e6]
    assert len(after) == len(inside) > 0


def test_a_region_that_fills_the_memory_is_snapped_too() -> None:
    rng = np.random.default_rng(4)
    m = HeightMap.from_heights(rng.normal(0, 0.01, (100, 100)), origin_m=(0, 0), grid_m=0.01)
    before = heights_at_centres(m)
    m.refocus((0.0031, 0.0031, 1.0031, 1.0031))
    assert m.grid_m == 0.01
    assert set(heights_at_centres(m).values()) <= set(before.values())
    assert max(abs(a - b) for a, b in zip(m.extent_m, (0.0031, 0.0031, 1.0031, 1.0031))) <= 0.005 + 1e-9


def test_the_papers_rounding_keeps_the_papers_geometry() -> None:
    ours, paper = scanned(), scanned("paper")
    for m in (ours, paper):
        m.refocus((0.5, 0.4501, 1.0, 0.5501))
    x0, y0, x1, y1 = paper.extent_m
    assert ((x0 + x1) / 2, (y0 + y1) / 2) == (pytest.approx(0.75, abs=1e-9), pytest.approx(0.5001, abs=1e-9))
    assert np.isfinite(paper.heights_m).sum() > np.isfinite(ours.heights_m).sum()


def test_the_command_says_what_resolution_was_kept(tmp_path: Path) -> None:
    scanned().save(tmp_path / "m.txt")
    words = (tmp_path / "m.txt", 0.5, 0.45, 1.0, 0.55, "-o", tmp_path / "n.txt")
    kept = call("refocus", *words)
    assert "grids of 2.54 mm kept, heights as they were; --finest" in kept.stderr
    finer = call("refocus", *words, "--finest", "1mm")
    assert "became 1 mm" in finer.stderr
    facts = json.loads(call("refocus", *words, "--json").stdout)
    assert facts["grid_m"] == facts["grid_before_m"]
    assert facts["known"] == facts["known_before"]


@pytest.mark.parametrize(("count", "most"), [(0, 1), (3, 3)])
def test_the_counts_of_a_picture_are_whole_numbers_from_0(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int, most: int
) -> None:
    from matplotlib.figure import Figure

    drawn: list[Figure] = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda f, *a, **k: (drawn.append(f), save(f, *a, **k)))
    m = HeightMap.from_heights(
        np.ones((4, 5)), origin_m=(0.0, 0.0), grid_m=0.5, counts=np.full((4, 5), count, np.uint8)
    )
    export(tmp_path / "map.png", m.header, m.pairs)
    (bar,) = [axes for axes in drawn[0].axes if axes.get_ylabel() == "samples per grid"]
    assert bar.get_ylim() == (0.0, most)
    ticks = bar.get_yticks()
    assert ticks.min() >= 0.0
    assert (ticks == ticks.round()).all()
