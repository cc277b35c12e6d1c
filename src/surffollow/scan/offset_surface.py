"""The paper's expansion of the terrain along its normals (eqs 1-4), laid onto the grid again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.scan.checks import Floats, positive, real_array
from surffollow.scan.triangles import lay_triangles

AGREE_CELLS = 0.5  # heights that differ by less than this part of a cell agree


@dataclass(frozen=True)
class OffsetSurface:
    """The expanded terrain.

    Attributes
    ----------
    heights_m : (rows, cols) float64 [m]
        highest sheet at each cell; -inf where there is none
    folded : (rows, cols) bool
        cells whose image is turned over: the surface folds there
    """

    heights_m: Floats
    folded: NDArray[np.bool_]


def slopes(heights_m: Floats, grid_m: float) -> tuple[Floats, Floats]:
    """(df/dx, df/dy) by central differences, one-sided at edges and beside unknown cells; NaN if neither."""
    return _slope(heights_m, grid_m, 1), _slope(heights_m, grid_m, 0)


def _slope(z: Floats, grid_m: float, axis: int) -> Floats:
    step = np.full(z.shape, np.nan)
    a = np.moveaxis(z, axis, 0)
    ahead, behind = np.moveaxis(step.copy(), axis, 0), np.moveaxis(step, axis, 0)
    with np.errstate(invalid="ignore"):
        ahead[:-1] = a[1:] - a[:-1]
        behind[1:] = a[1:] - a[:-1]
        both = np.where(np.isnan(ahead), behind, np.where(np.isnan(behind), ahead, 0.5 * (ahead + behind)))
    return np.ascontiguousarray(np.moveaxis(both, 0, axis) / grid_m)


def normal_offset(heights_m: ArrayLike, grid_m: float, gap_m: float) -> OffsetSurface:
    """Move every cell along its normal by the gap, and keep the highest sheet at every cell.

    Parameters
    ----------
    heights_m, grid_m
        as for `ball_envelope`
    gap_m : float [m]
        d

    Returns
    -------
    OffsetSurface

    Notes
    -----
    x_e = x - λ f_x (1), y_e = y - λ f_y (2), z_e = f + λ (3), λ = d / √(1 + f_x² + f_y²) (4). On ground
    whose radius of curvature is below d, and concave, the surface folds and the highest sheet is the safe
    one. Slopes over one cell and chords between cells make it differ from `ball_envelope` at edges.

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import normal_offset
    >>> offset = normal_offset(np.zeros((5, 5)), grid_m=0.1, gap_m=0.05)
    >>> float(offset.heights_m[2, 2])
    0.05
    """
    z = real_array("heights_m", heights_m, (None, None))
    g, d = positive("grid_m", grid_m), positive("gap_m", gap_m)
    fx, fy = slopes(z, g)
    # a row or column alone has no slope across
    fx, fy = (np.where(np.isfinite(z) & np.isnan(s), 0.0, s) for s in (fx, fy))
    lam = d / np.sqrt(1.0 + fx * fx + fy * fy)
    rows, cols = z.shape
    row, col = np.indices(z.shape, dtype=np.float64)
    points = np.stack([col - lam * fx / g, row - lam * fy / g, z + lam], axis=-1).reshape(-1, 3)
    number = np.arange(rows * cols).reshape(rows, cols)
    a, b, c, e = (v.reshape(-1) for v in (number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]))
    triangles = np.concatenate([np.stack([a, b, e], axis=1), np.stack([a, e, c], axis=1)])
    out = np.full(z.shape, -np.inf)
    lay_triangles(points, triangles, np.inf, True, np.ones(z.shape, np.bool_), out)
    return OffsetSurface(out, _folds(points, triangles, a, z.shape))


def _folds(
    points: Floats, triangles: NDArray[np.int64], first: NDArray[np.int64], shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    p, q, r = (points[triangles[:, k], :2] for k in range(3))
    with np.errstate(invalid="ignore"):
        area = (q[:, 0] - p[:, 0]) * (r[:, 1] - p[:, 1]) - (r[:, 0] - p[:, 0]) * (q[:, 1] - p[:, 1])
        turned = area < 0.0
    folded = np.zeros(shape, np.bool_).reshape(-1)
    folded[np.concatenate([first, first])[turned]] = True
    return folded.reshape(shape)


def disagreement(
    offset: OffsetSurface, envelope_m: Floats, grid_m: float, *, tolerance_m: float | None = None
) -> NDArray[np.bool_]:
    """Cells where the expanded terrain and the ball's envelope differ by more than half a cell.

    Cells that only one of the two knows are not counted.

    Parameters
    ----------
    offset : OffsetSurface
        the expanded terrain, see `normal_offset`
    envelope_m : (rows, cols) float [m]
        the envelope, see `ball_envelope`
    grid_m : float [m]
        side of a cell
    tolerance_m : float [m], optional
        allowed difference; None: half a cell

    Returns
    -------
    (rows, cols) bool
        True: both are known and differ

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import ball_envelope, disagreement, normal_offset
    >>> ground_m = np.zeros((5, 9))
    >>> ground_m[:, 5:] = 0.3                                 # a step
    >>> offset = normal_offset(ground_m, 0.1, 0.15)
    >>> differs = disagreement(offset, ball_envelope(ground_m, 0.1, 0.15), 0.1, tolerance_m=0.01)
    >>> bool(differs[2, 0]), bool(differs[2].any())           # flat ground, and the step
    (False, True)
    """
    limit = AGREE_CELLS * grid_m if tolerance_m is None else tolerance_m
    both = np.isfinite(offset.heights_m) & np.isfinite(envelope_m)
    with np.errstate(invalid="ignore"):
        return np.asarray(both & (np.abs(offset.heights_m - envelope_m) > limit))
