"""Coherent patches of a point cloud seen from above (§2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.errors import ScanInputError
from surffollow.scan.checks import Floats, near, positive, real_array
from surffollow.scan.patches import SLOPE_BLOCK, SLOPE_FACTOR, STEEPEST_RAD, Patches, classify


@dataclass(frozen=True)
class CloudPatches:
    """Which points of a cloud can be terrain.

    Attributes
    ----------
    ground : (n,) bool
        per point
    patches : Patches
        of the image of lowest points
    """

    ground: NDArray[np.bool_]
    patches: Patches


def cloud_patches(
    points_m: ArrayLike,
    *,
    cell_m: float,
    slope: float | None = None,
    slope_factor: float = SLOPE_FACTOR,
    min_points: int = 20,
    support_m: float = 1.0,
    tolerance_m: float = 0.7,
) -> CloudPatches:
    """The same test for a point cloud seen from above.

    Parameters
    ----------
    points_m : (n, 3) float [m]
    cell_m : float [m]
        side of the cells whose lowest points form the image
    slope : float
        neighbours may differ by this times their distance, plus support_m / 3; None: the cloud's own slope,
        `cloud_terrain.general_slope` over blocks of 5 cells, times slope_factor
    slope_factor : float
    min_points, support_m
        as `coherent_patches`, in cells
    tolerance_m : float [m]
        points this close to the terrain of the kept patches are ground

    Returns
    -------
    CloudPatches

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import cloud_patches
    >>> x_m, y_m = np.meshgrid(np.arange(0.0, 20.0, 0.5), np.arange(0.0, 20.0, 0.5))
    >>> points_m = np.column_stack([x_m.ravel(), y_m.ravel(), np.zeros(x_m.size)])
    >>> roof = (abs(points_m[:, 0] - 10.0) < 3.0) & (abs(points_m[:, 1] - 10.0) < 3.0)
    >>> points_m[roof, 2] = 5.0
    >>> found = cloud_patches(points_m, cell_m=0.5, slope=0.5)
    >>> bool(found.ground[roof].any()), bool(found.ground[~roof].all())
    (False, True)
    """
    from surffollow.scan.cloud_terrain import general_slope, terrain_heights_at

    points = real_array("points_m", points_m, (None, 3))
    if len(points) == 0 or not np.isfinite(points).all():
        raise ScanInputError("points_m needs at least one point, all finite")
    near("points_m", points)
    cell = positive("cell_m", cell_m)
    image, lowest = _lowest(points, cell)
    if slope is None:
        block = SLOPE_BLOCK * cell
        slope = positive("slope_factor", slope_factor, "1") * general_slope(_lowest(points, block)[1], block)
    jump = np.full(image.shape[:2], slope * cell + support_m / 3.0)
    above = np.array([image[..., 0].mean(), image[..., 1].mean(), 1e9])
    patches = classify(
        lowest,
        image,
        jump,
        above,
        min_pixels=min_points,
        support_m=support_m,
        cell_m=cell,
        steepest_rad=STEEPEST_RAD,
        region=None,
    )
    heights, local_slope = terrain_heights_at(image[patches.terrain], points)
    with np.errstate(invalid="ignore"):
        ground = np.abs(points[:, 2] - heights) <= tolerance_m * (1.0 + local_slope)
    return CloudPatches(ground, patches)


def _lowest(points: Floats, cell: float) -> tuple[Floats, Floats]:
    """(rows, cols, 3) lowest point of every cell, its cell's middle where there is none, and its height."""
    low = points[:, :2].min(axis=0)
    at: NDArray[Any] = np.floor((points[:, :2] - low) / cell).astype(np.int64)
    cols, rows = (int(v) + 1 for v in at.max(axis=0))
    order = np.lexsort((points[:, 2], at[:, 0], at[:, 1]))
    number = at[order, 1] * cols + at[order, 0]
    first = order[np.r_[True, np.diff(number) != 0]]
    image = np.full((rows, cols, 3), np.nan)
    row, col = np.indices((rows, cols))
    image[..., 0] = low[0] + (col + 0.5) * cell
    image[..., 1] = low[1] + (row + 0.5) * cell
    image[at[first, 1], at[first, 0]] = points[first]
    return image, np.ascontiguousarray(image[..., 2])
