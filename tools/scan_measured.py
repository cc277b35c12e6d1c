"""Terrain scanning on measured data: stereo depths, laser scans, and plans over measured grounds."""

from __future__ import annotations

import math
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from report import criterion
from surffollow.scan.body import disc
from surffollow.scan.camera import Camera, looking_down
from surffollow.scan.check import check_path
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.patches import coherent_patches
from surffollow.scan.patches_of_clouds import cloud_patches
from surffollow.scan.path_file import write_path
from surffollow.scan.plan import PlanSettings, plan_scan
from surffollow.scan.planar_filter import conditional_planar_filter
from surffollow.scan.planar_kernels import PLANAR

ROOT = Path(__file__).resolve().parents[1]
Criteria = list[dict[str, Any]]


def data_folder() -> Path:
    """Folder of the shared data."""
    return Path(os.environ.get("SURFFOLLOW_DATA", ROOT.parent / "shared" / "data"))


def stereo(folder: Path) -> Criteria:
    """Motorcycle: a real block matcher's depths before and after patches and filter.

    Jump, border, least size of a patch, and whether rough pixels (the filter's label) count, are chosen on
    one half of the image, the figures are of the other.
    """
    truth = np.load(folder / "motorcycle_stereo" / "motorcycle_disp.npz")["arr_0"].astype(float)
    given = np.load(folder / "motorcycle_stereo" / "sgbm_depth.npz")["disp_sgbm"].astype(float)
    rows, cols = given.shape
    camera = Camera(
        994.978,
        994.978,
        cols / 2,
        rows / 2,
        looking_down(0, 0, 3),
        baseline_m=0.193001,
        disparity_offset_px=31.086,
    )
    z = camera.depth_m(np.where(np.isfinite(truth), truth, np.nan))
    raw = camera.depth_m(given)
    left = np.arange(cols)[None, :] < cols // 2

    def filtered(jump_px: float, border_px: int, min_pixels: int, rough: bool) -> Any:
        patches = coherent_patches(
            raw,
            camera,
            jump_px=jump_px,
            min_pixels=min_pixels,
            border_px=border_px,
            support_m=1e3,
            steepest_rad=math.pi,
        )
        made = conditional_planar_filter(np.where(patches.terrain, raw, np.nan), camera)
        return made.depth_m if rough else np.where(made.label == PLANAR, made.depth_m, np.nan)

    def errors(d: Any, half: Any) -> tuple[float, float, float]:
        e = (d - z)[np.isfinite(d) & np.isfinite(z) & half]
        share = float((np.isfinite(d) & half).sum() / (half & np.ones(d.shape, bool)).sum())
        return float(np.sqrt((e**2).mean())), float(np.median(np.abs(e))), share

    made = {
        (jump, border, least, rough): filtered(jump, border, least, rough)
        for jump in (0.5, 1.0)
        for border in (0, 2, 4)
        for least in (50, 200)
        for rough in (True, False)
    }
    criteria = []
    for name, half, other in (("right", left, ~left), ("left", ~left, left)):
        start = errors(raw, half)
        good = {k: errors(d, half)[0] for k, d in made.items() if errors(d, half)[1] <= start[1]}
        chosen = min(good, key=lambda k: good[k])
        before, after = errors(raw, other), errors(made[chosen], other)
        note = (
            f"{1e3 * before[0]:.0f} → {1e3 * after[0]:.0f} mm, covers {before[2]:.3f} → {after[2]:.3f}; jump "
            f"{chosen[0]:g} px, border {chosen[1]} px, {chosen[2]} pixels, "
            f"{'all' if chosen[3] else 'planar'} pixels, chosen on the other half"
        )
        criteria += [
            criterion(
                f"motorcycle, {name} half: depth RMS after / before", after[0] / before[0], 0.5, "", note
            ),
            criterion(f"motorcycle, {name} half: median error after / before", after[1] / before[1], 1.0, ""),
        ]
    return criteria


def lidar(folder: Path) -> Criteria:
    """ISPRS samples: ground against objects; settings chosen on one sample, figures of the other."""
    data = np.load(folder / "surfaces" / "isprs_lidar.npz")
    names = ("samp11", "samp51")
    sizes, factors, supports, tolerances = (2.0, 3.0, 4.0), (0.5, 1.0, 1.5, 2.0), (1.0, 2.0), (0.5, 0.7)
    cases = [(c, f, u, t) for c in sizes for f in factors for u in supports for t in tolerances]
    wrong: dict[str, list[float]] = {}
    for name in names:
        points, ground = data[f"{name}_xyz"].astype(float), data[f"{name}_ground"]
        wrong[name] = [
            float(
                (
                    cloud_patches(points, cell_m=c, slope_factor=f, support_m=u, tolerance_m=t).ground
                    != ground
                ).mean()
            )
            for c, f, u, t in cases
        ]
    criteria = []
    for name, other in (names, names[::-1]):
        k = int(np.argmin(wrong[other]))
        choices = zip(("cell_m", "slope_factor", "support_m", "tolerance_m"), cases[k])
        note = ", ".join(f"{key} {value:g}" for key, value in choices) + f", chosen on {other}"
        criteria.append(criterion(f"ISPRS {name}: total error", 100 * wrong[name][k], 15, "%", note))
    return criteria


def measured_grounds(folder: Path) -> dict[str, TerrainGrid]:
    """Jacksboro and microscope maps, scaled to 2 m and 0.2 m of relief."""
    dem = np.load(folder / "surfaces" / "jacksboro_fault_dem.npz")["elevation"].astype(float)
    maps = np.load(folder / "surfaces" / "microscope_height_maps.npz")
    found = {"jacksboro": dem, "microscope sur": maps["st_sur-2_sur"], "microscope x3p": maps["st_x3p-2_x3p"]}
    out = {}
    for name, heights in found.items():
        z = heights.astype(float)
        z = (z - np.nanmean(z)) * (0.2 / (np.nanmax(z) - np.nanmin(z)))
        out[name] = TerrainGrid.of(z, grid_m=2.0 / max(z.shape))
    return out


def plans_on_measured_ground(folder: Path) -> Criteria:
    """Plan and check each measured ground, in lanes and arcs."""
    criteria = []
    for name, ground in measured_grounds(folder).items():
        x0, y0, x1, y1 = ground.extent_m
        region = (x0 + 0.3, y0 + 0.3, x1 - 0.3, y1 - 0.3)
        for scheme in ("lanes", "arcs"):
            settings = PlanSettings(
                region, 0.05, disc(0.08), scheme=scheme, base_m=(-0.5, 1.0, 0.0) if scheme == "arcs" else None
            )
            with tempfile.TemporaryDirectory() as place:
                file = Path(place, "path.csv")
                write_path(file, plan_scan(ground, settings))
                findings = check_path(ground.heights_m, ground.origin_m, ground.grid_m, file)
            failed = [f"{f.name}: {f.text}" for f in findings if not f.ok]
            least = next(f.value for f in findings if f.name == "clearance")
            note = "; ".join(failed) or f"least distance {1e3 * (least or 0):.3f} mm of 50"
            criteria.append(criterion(f"{name}, {scheme}: findings of the checker", len(failed), 0, "", note))
    return criteria
