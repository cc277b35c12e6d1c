"""Which patches are proven to float: other rays have met something far beneath them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surffollow.scan.checks import Floats

SEEN_PART = 0.5  # of a patch's inner cells, above which it is proven to float
COLUMN = 1 << 32  # numbers of cells of one column
AROUND = [dx * COLUMN + dy for dx in (-1, 0, 1) for dy in (-1, 0, 1) if dx or dy]


class LowestSeen:
    """Lowest height that any view has seen in every cell.

    Parameters
    ----------
    cell_m : float [m]
        side of a cell; a few points of a view, so that ground which is seen leaves no cell empty
    """

    def __init__(self, cell_m: float) -> None:
        self.cell_m = cell_m
        self._cells: NDArray[np.int64] = np.empty(0, np.int64)
        self._lowest: Floats = np.empty(0)

    def add(self, points: Floats) -> None:
        """Take (n, 3) finite points [m]."""
        cells, lowest = self._by_cell(points)
        self._cells, self._lowest = _least(np.r_[self._cells, cells], np.r_[self._lowest, lowest])

    def beneath(self, points: Floats, support_m: float) -> bool:
        """Whether most of a patch has something seen beneath it.

        Parameters
        ----------
        points : (n, 3) float64 [m]     of the patch
        support_m : float [m]           what is seen counts when it is farther below than this

        Notes
        -----
        Only inner cells count, whose eight neighbours belong to the patch as well: beside every object that
        stands on the ground, cells of its rim hold points of both.
        """
        cells, lowest = self._by_cell(points)
        inner = np.ones(len(cells), np.bool_)
        for step in AROUND:
            inner &= np.isin(cells + step, cells, assume_unique=True)
        cells, lowest = cells[inner], lowest[inner]
        if len(cells) == 0 or len(self._cells) == 0:
            return False
        at = np.minimum(np.searchsorted(self._cells, cells), len(self._cells) - 1)
        seen = (self._cells[at] == cells) & (self._lowest[at] < lowest - support_m)
        return float(seen.mean()) > SEEN_PART

    def beneath_patches(
        self, asked: NDArray[np.bool_], points: Floats, labels: NDArray[np.int32], support_m: float
    ) -> NDArray[np.bool_]:
        """(n,) bool: of the patches asked for, those for which `beneath` is true.

        Parameters
        ----------
        asked : (n,) bool
        points : (m, 3) float64 [m]
        labels : (m,) int32             patch of each point
        support_m : float [m]           as in `beneath`
        """
        out = np.zeros(len(asked), np.bool_)
        for k in np.flatnonzero(asked):
            out[k] = self.beneath(points[labels == k], support_m)
        return out

    def _by_cell(self, points: Floats) -> tuple[NDArray[np.int64], Floats]:
        return _least(cell_numbers(points, self.cell_m), points[:, 2])


def cell_numbers(points: Floats, cell_m: float) -> NDArray[np.int64]:
    """(n,) one whole number for each cell of side `cell_m` [m] that holds points (n, 3) [m]."""
    at = np.clip(np.floor(points[:, :2] / cell_m), -COLUMN // 4, COLUMN // 4).astype(np.int64)
    return np.asarray(at[:, 0] * COLUMN + at[:, 1], np.int64)


def hidden_points(
    points: Floats, raised: NDArray[np.bool_], cell_m: float, support_m: float
) -> NDArray[np.bool_]:
    """(n,) points that share a cell with a raised patch and lie farther than `support_m` below it.

    Parameters
    ----------
    points : (n, 3) float64 [m]
    raised : (n,) bool             points of patches that stay as obstacles
    cell_m, support_m : float [m]

    Notes
    -----
    A mean of an obstacle and of the ground beside it would be an obstacle that is too low.
    """
    out = np.zeros(len(points), np.bool_)
    if not raised.any():
        return out
    cells, lowest = _least(cell_numbers(points[raised], cell_m), points[raised, 2])
    own = cell_numbers(points, cell_m)
    at = np.minimum(np.searchsorted(cells, own), len(cells) - 1)
    out[(cells[at] == own) & (points[:, 2] < lowest[at] - support_m)] = True
    return out


def _least(cells: NDArray[np.int64], heights: Floats) -> tuple[NDArray[np.int64], Floats]:
    """The cells, ascending and each once, and the least height of each."""
    if len(cells) == 0:
        return cells, heights
    order = np.lexsort((heights, cells))
    first = order[np.r_[True, np.diff(cells[order]) != 0]]
    return cells[first], heights[first]
