"""Known fields for the map's accuracy criteria: scans of them as a robot would bring them, and the truth."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from surffollow.hw.simulation.led_config import LedConfig
from surffollow.map import HeightMap
from surffollow.sim.robot_config import RobotConfig


def scan(
    field: NDArray[Any], spacing_m: float, region: tuple[float, float, float, float], seed: int
) -> NDArray[np.float64]:
    """Target points of a raster over a field: 50 mm/s, 250 Hz, lines a grid apart, default noise.

    field : (ny, nx) heights [m] every `spacing_m` from the region's lower corner on.
    The range has the sensor's noise and the converter's steps, the pose the robot's noise, and the
    point is where the tool was 1 ms before or after (what latency calibration leaves).
    """
    rng = np.random.default_rng(seed)
    x0, y0, x1, y1 = region
    lines = np.arange(y0 + 1.27e-3, y1, 2.54e-3)
    along = np.arange(x0, x1, 0.05 / 250)
    sensor, sigma = LedConfig(), RobotConfig().report_sigma_m
    parts = []
    for y in lines:
        n = along.size
        truth = map_coordinates(
            field, [np.full(n, (y - y0) / spacing_m), (along - x0) / spacing_m], order=1, mode="nearest"
        )
        step = 4 * 0.0254 / 4096  # 12 bits over the range of 2 to 6 in
        standoff = 0.1 + rng.normal(0, 1e-3, n)
        seen = standoff + rng.normal(0, sensor.noise_m, n)
        seen += sensor.nonlinearity_m * np.sin(2 * np.pi * standoff / (4 * 0.0254))
        seen = np.rint(seen / step) * step
        tool = truth + standoff + rng.normal(0, sigma, n)
        x = along + rng.normal(0, sigma, n) + 0.05e-3 * rng.choice([-1, 1])
        parts.append(np.stack([x, y + rng.normal(0, sigma, n), tool - seen], axis=1))
    return np.concatenate(parts)


def area_means(
    field: NDArray[Any], spacing_m: float, m: HeightMap, x0_m: float, y0_m: float
) -> NDArray[np.float64]:
    """True mean height of the ground in every grid of a map, from 5 × 5 points of each.

    field : (ny, nx) heights [m] every `spacing_m` from (x0_m, y0_m) on.
    """
    ny, nx = m.shape
    total = np.zeros((ny, nx))
    for dy in (np.arange(5) + 0.5) / 5:
        for dx in (np.arange(5) + 0.5) / 5:
            y = (m.origin_m[1] + (np.arange(ny) + dy) * m.grid_m - y0_m) / spacing_m
            x = (m.origin_m[0] + (np.arange(nx) + dx) * m.grid_m - x0_m) / spacing_m
            total += map_coordinates(field, np.meshgrid(y, x, indexing="ij"), order=1, mode="nearest")
    return total / 25


def measured_surfaces() -> dict[str, NDArray[np.float64]]:
    """Surfaces of shared/data as measured, holes filled with the median; empty where the data is absent."""
    shared = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("SURFFOLLOW_DATA", shared)) / "surfaces"
    if not folder.is_dir():
        return {}
    surfaces = {"fault DEM": np.load(folder / "jacksboro_fault_dem.npz")["elevation"]}
    microscope = np.load(folder / "microscope_height_maps.npz")
    for key in ("st_sur-2_sur", "st_x3p-2_x3p"):
        surfaces[f"microscope {key}"] = microscope[key]
    filled = {name: np.asarray(z, np.float64) for name, z in surfaces.items()}
    return {name: np.where(np.isfinite(z), z, np.nanmedian(z)) for name, z in filled.items()}
