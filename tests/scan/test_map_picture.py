"""The picture of a terrain map: kinds of cells are discrete, and the legend names those that there are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from surffollow.scan import pictures
from surffollow.scan.grid import FILLED, MEASURED, UNKNOWN, TerrainGrid


def drawn(cells: Any, path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The figure of a map with those kinds of cells."""
    made = []

    def keep(figure: Any, path: Any) -> None:
        made.append(figure)

    monkeypatch.setattr(pictures, "save_figure", keep)
    heights = np.where(cells == UNKNOWN, np.nan, 0.01 * np.arange(cells.size).reshape(cells.shape))
    ground = TerrainGrid.of(heights, origin_m=(0.0, 0.0), grid_m=0.01, cells=cells)
    pictures.draw_map(path, ground)
    return made[0]


def test_the_legend_of_kinds_has_one_colour_for_each_kind_and_its_share(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cells = np.full((10, 10), MEASURED, np.uint8)
    cells[0, :3], cells[1, :5] = UNKNOWN, FILLED
    figure = drawn(cells, tmp_path / "map.png", monkeypatch)
    _, kinds, bar = figure.axes  # one colour bar: that of the heights
    assert bar.get_ylabel().startswith("height")
    legend = kinds.get_legend()
    assert [t.get_text() for t in legend.get_texts()] == ["unknown (3 %)", "measured (92 %)", "filled (5 %)"]
    image = kinds.images[0].get_array()
    for patch, (row, col) in zip(legend.get_patches(), ((0, 0), (5, 5), (1, 0))):
        assert to_rgb(patch.get_facecolor()) == pytest.approx(tuple(image[row, col]))


def test_the_legend_leaves_out_kinds_that_no_cell_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figure = drawn(np.full((10, 10), MEASURED, np.uint8), tmp_path / "map.png", monkeypatch)
    assert [t.get_text() for t in figure.axes[1].get_legend().get_texts()] == ["measured (100 %)"]
