"""From depth images and point clouds to a terrain grid: patches, filter, points, map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from surffollow.errors import ScanInputError
from surffollow.scan.checks import Floats
from surffollow.scan.grid import CELL_NAMES, TerrainGrid
from surffollow.scan.image_files import DepthImage
from surffollow.scan.image_filters import gaussian_filter, median_filter
from surffollow.scan.patches import coherent_patches
from surffollow.scan.planar_filter import conditional_planar_filter
from surffollow.scan.planar_kernels import PLANAR, ROUGH
from surffollow.scan.terrain import terrain_map

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
    TerrainGrid, and a report: per image the patches and pixels kept and dropped by criterion

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
    (0.05, ['cells', 'images', 'points'])
    """
    if not images and not clouds:
        raise ScanInputError("no image and no cloud; give at least one")
    points, weights, per_image = [], [], []
    for k, image in enumerate(images):
        p, w, report = terrain_points(image, settings)
        points.append(p)
        weights.append(w)
        per_image.append(report)
        if progress is not None:
            progress(0.8 * (k + 1) / len(images))
    for cloud in clouds:
        points.append(cloud)
        weights.append(np.ones(len(cloud)))
    if not points or not sum(map(len, points)):
        raise ScanInputError("no pixel of the images can be terrain; see the counts of dropped patches")
    ground = terrain_map(
        np.vstack(points),
        settings.grid_m,
        region=settings.region,
        weights=np.concatenate(weights),
        average_m=settings.average_m,
        fill_m=settings.fill_m,
    )
    counts = {name: int(np.count_nonzero(ground.cells == k)) for k, name in enumerate(CELL_NAMES)}
    return ground, {"images": per_image, "points": int(sum(map(len, points))), "cells": counts}


def terrain_points(image: DepthImage, settings: SurveySettings) -> tuple[Floats, Floats, dict[str, Any]]:
    """(n, 3) points of an image that can be terrain, their weights 1 / variance (∝ z⁻⁴), and a report."""
    camera = image.camera
    depth = camera.depth_m(image.values) if image.kind == "disparity" else image.values
    patches = coherent_patches(
        depth,
        camera,
        min_pixels=settings.min_pixels,
        support_m=settings.support_m,
        region=settings.region,
        border_px=settings.border_px,
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
    return points[good], (1.0 / np.maximum(kept[good], 1e-6) ** 4), report


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
