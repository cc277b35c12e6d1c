"""From depth images and point clouds to a terrain grid: patches, filter, points, map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import ScanInputError
from surffollow.scan.cell_obstacles import cell_obstacles
from surffollow.scan.checks import Floats
from surffollow.scan.grid import CELL_NAMES, UNKNOWN, TerrainGrid
from surffollow.scan.image_files import DepthImage
from surffollow.scan.image_filters import gaussian_filter, median_filter
from surffollow.scan.patches import (
    FLOATING,
    OVERHANGING,
    RAISED,
    TOO_SMALL,
    coherent_patches,
    seen_points,
)
from surffollow.scan.planar_filter import conditional_planar_filter
from surffollow.scan.planar_kernels import PLANAR, ROUGH
from surffollow.scan.seen_beneath import LowestSeen, hidden_points
from surffollow.scan.terrain import corner_of, terrain_map

FILTERS = ("cpf", "cpf-fast", "gaussian", "median", "none")


@dataclass(frozen=True)
class SurveySettings:
    """How images become a map.

    Attributes
    ----------
    grid_m : float [m]
    region : (x_min, y_min, x_max, y_max) [m] or None
    filter : str
        one of FILTERS
    window : int [px]
        of the conditional planar filter; the Gaussian has sigma window / 4
    min_pixels, support_m, border_px
        of `coherent_patches`
    fill_m, average_m
        of `terrain_map`

    Examples
    --------
    >>> from surffollow.scan import SurveySettings
    >>> settings = SurveySettings(grid_m=0.02, region=(0.0, 0.0, 1.0, 1.0), filter="median")
    >>> settings.support_m, settings.min_pixels
    (0.1, 50)
    """

    grid_m: float
    region: Sequence[float] | None = None
    filter: str = "cpf"
    window: int = 9
    min_pixels: int = 50
    support_m: float = 0.1
    border_px: int = 0
    fill_m: float | None = None
    average_m: float | None = None


def survey(
    images: Sequence[DepthImage],
    clouds: Sequence[Floats],
    settings: SurveySettings,
    progress: Callable[[float], Any] | None = None,
) -> tuple[TerrainGrid, dict[str, Any]]:
    """Map the ground that images and clouds show.

    Parameters
    ----------
    images : sequence of DepthImage
        with their cameras
    clouds : sequence of (n, 3) float [m]
        points in the ground frame
    settings : SurveySettings
        filters and grid
    progress : callable, optional
        gets the finished fraction

    Returns
    -------
    TerrainGrid, and a report: per image the patches and pixels kept and dropped by criterion, and the unknown
    cells beneath dropped ones (`covered`); points that were left out, by reason

    Raises
    ------
    ScanInputError

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import SurveySettings, survey
    >>> x_m, y_m = np.meshgrid(np.arange(0.0, 1.0, 0.02), np.arange(0.0, 1.0, 0.02))
    >>> cloud_m = np.column_stack([x_m.ravel(), y_m.ravel(), 0.1 * x_m.ravel()])
    >>> ground, report = survey([], [cloud_m], SurveySettings(grid_m=0.05))
    >>> round(float(ground.heights_m[10, 10]), 2), sorted(report)
    (0.05, ['cells', 'covered', 'images', 'left_out', 'points'])
    """
    if not images and not clouds:
        raise ScanInputError("no image and no cloud; give at least one")
    finite = [np.asarray(c)[np.isfinite(c).all(axis=1)] for c in clouds]
    lost, clouds = sum(map(len, clouds)) - sum(map(len, finite)), finite
    if lost and not images and not sum(map(len, clouds)):
        raise ScanInputError(f"none of the {lost} points is finite; a terrain map needs at least one")
    seen = _seen(images, clouds, settings)
    points, weights, raised, above, per_image = [], [], [], [], []
    for k, image in enumerate(images):
        found = terrain_points(image, settings, seen)
        points.append(found.points)
        weights.append(found.weights)
        raised.append(found.raised)
        above.append(found.above)
        per_image.append(found.report)
        if progress is not None:
            progress(0.8 * (k + 1) / len(images))
    for cloud in clouds:
        points.append(cloud)
        weights.append(np.ones(len(cloud)))
        raised.append(np.zeros(len(cloud), np.bool_))
    if not points or not sum(map(len, points)):
        raise ScanInputError("no pixel of the images can be terrain; see the counts of dropped patches")
    merged = np.vstack(points)
    corner = corner_of(merged, settings.grid_m, settings.region)
    levels = cell_obstacles(merged, corner, settings.grid_m, settings.support_m)
    obstacle = (np.concatenate(raised) | levels.upper) & ~levels.specks
    beneath = levels.hidden | hidden_points(merged, obstacle, settings.grid_m, settings.support_m)
    use = ~(beneath | levels.specks)
    ground = terrain_map(
        merged[use],
        settings.grid_m,
        region=settings.region,
        weights=np.concatenate(weights)[use],
        average_m=settings.average_m,
        fill_m=settings.fill_m,
        above_m=np.vstack(above) if above else None,
        raised_m=merged[obstacle & use],
    )
    counts = {name: int(np.count_nonzero(ground.cells == k)) for k, name in enumerate(CELL_NAMES)}
    covered = _unknown_beneath(ground, np.vstack(above)) if above else 0
    report = {"images": per_image, "points": int(sum(map(len, points))), "cells": counts}
    left_out = {
        "not_finite": lost,
        "specks": int(levels.specks.sum()),
        "beneath_obstacles": int(beneath.sum()),
    }
    return ground, report | {"left_out": left_out, "covered": covered}


@dataclass(frozen=True)
class SurveyPoints:
    """Points of an image for a map.

    Attributes
    ----------
    points : (n, 3) float64 [m]     that can be terrain, or stay as obstacles
    weights : (n,) float64          1 / variance (∝ z⁻⁴)
    raised : (n,) bool              of patches that stay as obstacles
    above : (k, 3) float64 [m]      of patches that were dropped
    report : dict                   ready for JSON
    """

    points: Floats
    weights: Floats
    raised: NDArray[np.bool_]
    above: Floats
    report: dict[str, Any]


def terrain_points(
    image: DepthImage, settings: SurveySettings, seen: LowestSeen | None = None
) -> SurveyPoints:
    """Points of an image that can be terrain, and what else it shows.

    Parameters
    ----------
    image : DepthImage
    settings : SurveySettings
    seen : LowestSeen       what all images show; None: what this one shows
    """
    camera, depth = image.camera, _depths(image)
    patches = coherent_patches(
        depth,
        camera,
        min_pixels=settings.min_pixels,
        support_m=settings.support_m,
        region=settings.region,
        border_px=settings.border_px,
        seen=seen,
    )
    kept = np.where(patches.terrain, depth, np.nan)
    report: dict[str, Any] = {
        "name": camera.name,
        "patches": patches.counts(),
        "pixels": patches.pixel_counts(),
    }
    if patches.terrain.any():
        kept, labels = filtered(kept, image, settings)
        report |= labels
    points = camera.points_m(kept)
    good = np.isfinite(points).all(axis=-1)
    dropped = patches.having(TOO_SMALL, OVERHANGING, FLOATING)
    return SurveyPoints(
        points[good],
        1.0 / np.maximum(kept[good], 1e-6) ** 4,
        patches.having(RAISED)[good],
        camera.points_m(np.where(dropped, depth, np.nan))[dropped],
        report,
    )


def _depths(image: DepthImage) -> Floats:
    return image.camera.depth_m(image.values) if image.kind == "disparity" else image.values


def _unknown_beneath(ground: TerrainGrid, points: Floats) -> int:
    """Number of unknown cells that hold some of the points (n, 3) [m]."""
    at = np.floor((points[:, :2] - np.array(ground.origin_m)) / ground.grid_m).astype(np.int64)
    at = at[((at >= 0) & (at < np.array(ground.shape[::-1]))).all(axis=1)]
    return len(np.unique(at[ground.cells[at[:, 1], at[:, 0]] == UNKNOWN], axis=0))


def _seen(images: Sequence[DepthImage], clouds: Sequence[Floats], settings: SurveySettings) -> LowestSeen:
    """Lowest heights of all images and clouds, in cells that none of the images leaves empty."""
    parts = [seen_points(_depths(i), i.camera, min_pixels=settings.min_pixels) for i in images]
    seen = LowestSeen(max([settings.grid_m, *(cell for _, cell in parts)]))
    for points in (*(p for p, _ in parts), *clouds):
        seen.add(points)
    return seen


def filtered(depth: Floats, image: DepthImage, settings: SurveySettings) -> tuple[Floats, dict[str, Any]]:
    """Depths after the filter of the settings, and what it says about the image."""
    camera = image.camera
    if settings.filter in ("cpf", "cpf-fast"):
        mode = "exact" if settings.filter == "cpf" else "fast"
        made = conditional_planar_filter(depth, camera, window=settings.window, mode=mode)
        planar = {"planar": int((made.label == PLANAR).sum()), "rough": int((made.label == ROUGH).sum())}
        return made.depth_m, planar | {"noise_px": made.noise_px}
    if settings.filter == "none":
        return depth, {}
    # plain filters work on disparities as well, where stereo noise is the same everywhere
    q = camera.disparity_px(depth) if camera.baseline_m > 0.0 else camera.fx_px / depth
    if settings.filter == "median":
        q = median_filter(q)
    elif settings.filter == "gaussian":
        q = gaussian_filter(q, sigma_px=settings.window / 4.0)
    else:
        raise ScanInputError(f"filter is '{settings.filter}'; expected one of {', '.join(FILTERS)}")
    return (camera.depth_m(q) if camera.baseline_m > 0.0 else camera.fx_px / q), {}
