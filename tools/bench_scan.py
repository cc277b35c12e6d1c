"""Accuracy, speed and real data of terrain scanning, beside slow twins and other programs.

    python tools/bench_scan.py [--only accuracy|speed|data] [--terrains 500] [--json]

Twins and oracles are in tests/naive_scan.py. Speeds are the best of several runs, side by side in one
process; on a busy machine read the ratios. Real data: SURFFOLLOW_DATA, left out where it is absent.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import grey_dilation
from scipy.spatial import cKDTree

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import naive_scan as naive  # noqa: E402
from report import criterion, finish, result, show_step  # noqa: E402
from scan_measured import data_folder, lidar, plans_on_measured_ground, stereo  # noqa: E402
from surffollow.scan.attitude_angles import wrist_angles  # noqa: E402
from surffollow.scan.body import disc  # noqa: E402
from surffollow.scan.camera import Camera, looking_down  # noqa: E402
from surffollow.scan.clearance import clear_ground, control_points  # noqa: E402
from surffollow.scan.deviation import planar_deviation  # noqa: E402
from surffollow.scan.envelope import ball_envelope, ball_heights, envelope_of  # noqa: E402
from surffollow.scan.following import advanced_terrain_following, reactionary, sample_terrain  # noqa: E402
from surffollow.scan.grid import TerrainGrid  # noqa: E402
from surffollow.scan.holes import fill_holes  # noqa: E402
from surffollow.scan.image_filters import gaussian_filter, median_filter  # noqa: E402
from surffollow.scan.limits import WristLimits  # noqa: E402
from surffollow.scan.patch_labels import label_patches  # noqa: E402
from surffollow.scan.plan import PlanSettings, plan_scan  # noqa: E402
from surffollow.scan.planar_filter import conditional_planar_filter  # noqa: E402
from surffollow.scan.schemes import arcs, lanes  # noqa: E402
from surffollow.scan.terrain import terrain_map  # noqa: E402

Criteria = list[dict[str, Any]]


def best_ms(work: Callable[[], object], runs: int = 7) -> tuple[float, float]:
    """Wall time and processor time of all threads [ms], each of the best run, after one to warm up."""
    work()
    times, used = [], []
    for _ in range(runs):
        start, processor = time.perf_counter(), time.process_time()
        work()
        times.append(time.perf_counter() - start)
        used.append(time.process_time() - processor)
    return 1e3 * min(times), 1e3 * min(used)


def took(name: str, work: Callable[[], object], limit_ms: float, runs: int = 7) -> dict[str, Any]:
    """A criterion of wall time, with the processor time as its note."""
    show_step(f"speed: {name}")
    wall, processor = best_ms(work, runs)
    return criterion(name, wall, limit_ms, "ms", f"processor {processor:.1f} ms")


def twins_of_images(rng: Any) -> Criteria:
    """Deviations, medians and labels against pixel-by-pixel twins."""
    exact = fast = med = 0.0
    wrong = 0
    for _ in range(25):
        z = 40.0 + rng.normal(0, 1, (22, 27)) * rng.choice([0.05, 1.0])
        z[rng.random(z.shape) < rng.choice([0.0, 0.1, 0.5])] = np.nan
        window = int(rng.choice([3, 5, 9]))
        mad, rms = naive.planar_deviation(z, window)
        exact = max(exact, _off(planar_deviation(z, window=window)[0], mad))
        fast = max(
            fast, _off(planar_deviation(z, window=window, mode="fast")[0], rms * math.sqrt(2 / math.pi))
        )
        med = max(med, _off(median_filter(z), naive.median(z)))
        jump = rng.uniform(0, 2, z.shape)
        got = np.empty(z.shape, np.int32)
        label_patches(z, jump, np.empty(z.size, np.int32), got)
        wrong += int((got != naive.labels(z, jump)).sum())
    noise = rng.normal(0, 1, (300, 300))
    ratio = planar_deviation(noise)[0] / planar_deviation(noise, mode="fast")[0]
    return [
        criterion("deviation exact − direct plane fits", exact, 1e-9, "px"),
        criterion("deviation fast − RMS of direct fits", fast, 1e-6, "px"),
        criterion("fast/exact on normal noise: mean off 1", abs(1 - float(ratio.mean())), 0.02, ""),
        criterion("median − direct median", med, 1e-12, "px"),
        criterion("patch labels unlike growing", wrong, 0, "px"),
    ]


def _off(a: Any, b: Any) -> float:
    """Largest difference; infinite where one is NaN and the other not."""
    if (np.isnan(a) != np.isnan(b)).any():
        return math.inf
    return float(np.nanmax(np.abs(a - b))) if np.isfinite(a).any() else 0.0


def terrains(count: int, rng: Any) -> Criteria:
    """Envelope, attitude and clearance over random terrains."""
    different = flags = inside = beyond = below = 0
    worst_lp = worst_search = -math.inf
    missed_lp = missed_search = gentle_lp = gentle = compared = 0
    lifts: list[tuple[float, float]] = []
    for k in range(count):
        if k % max(1, count // 20) == 0:
            show_step(f"accuracy: terrain {k} of {count}")
        n, grid = int(rng.integers(70, 100)), 0.01
        steepest = 1.0 if k % 2 else None
        z = naive.rough_ground(rng, n, grid, steepest=steepest)
        holes = z.copy()
        holes[rng.random(z.shape) < rng.choice([0.0, 0.05, 0.6])] = np.nan
        radius = float(rng.uniform(3, 40)) * grid
        if rng.random() < 0.2:
            radius = round(radius / grid) * grid
        different += int((ball_envelope(holes, grid, radius) != naive.ball(holes, grid, radius)).sum())
        if k < 40:
            small = holes[:24, :24]
            flags += int(
                (
                    envelope_of(TerrainGrid.of(small, grid_m=grid), 0.05).unknown_beneath
                    != naive.unknown_within(small, 5.0)
                ).sum()
            )
        gap, body, limit = 0.05, disc(0.1), math.radians(float(rng.choice([25, 45])))
        ground = TerrainGrid.of(z, grid_m=grid)
        envelope = envelope_of(ground, gap)
        e = envelope.grid.heights_m
        path = sample_terrain(
            lanes((0.25, 0.25, n * grid - 0.25, n * grid - 0.25), 0.1, step_m=0.02), envelope
        )
        got = advanced_terrain_following(path, body, envelope, WristLimits.symmetric(limit))
        lazy = reactionary(path, body, envelope, WristLimits.symmetric(limit))
        lifts.append((float(got.lift_m.mean()), float(lazy.lift_m.mean())))
        angles = wrist_angles(got.normal, got.azimuth_rad)
        beyond += int((np.abs(angles) > limit + 1e-9).any(axis=1).sum())
        points = control_points(got, body)
        below += int((naive.bilinear(e, grid, points[..., 0], points[..., 1]) - points[..., 2] > 1e-6).sum())
        for i in rng.choice(len(got), 2, replace=False):
            tip, lift = path.position_m[i], float(got.lift_m[i])
            pitch, _ = angles[i]
            slopes = (math.tan(limit), math.tan(limit) / math.cos(pitch))
            lp = naive.least_lift_lp(e, grid, tip, (points[i] - got.position_m[i])[:, :2], slopes)
            over = lift - 1.05 * lp - 5e-4
            worst_lp, missed_lp = max(worst_lp, over), missed_lp + (over > 0)
            if steepest is not None:
                gentle += 1
                gentle_lp += over > 0
            compared += 1
            if over > 0 or k % 10 == 0:
                search = naive.least_lift_search(e, grid, tip, body, limit)
                over = lift - 1.05 * search - 5e-4
                worst_search, missed_search = max(worst_search, over), missed_search + (over > 0)
        clear = clear_ground(got, body, ground, gap)
        y, x = np.indices(z.shape)
        tree = cKDTree(np.column_stack([(x.ravel() + 0.5) * grid, (y.ravel() + 0.5) * grid, z.ravel()]))
        inside += int((tree.query(control_points(clear, body).reshape(-1, 3))[0] < gap).sum())
    atf, lazy_mean = np.mean(lifts, axis=0)
    return [
        criterion(f"envelope unlike brute force, {count} terrains", different, 0, "cells"),
        criterion("unknown beneath unlike looking at each cell", flags, 0, "cells"),
        criterion("ATF: control points below the envelope", below, 0, ""),
        criterion("ATF: samples beyond the wrist limits", beyond, 0, ""),
        criterion("ATF lift − (1.05 LP + 0.5 mm), slopes ≤ 45°: missed", gentle_lp, 0, f"of {gentle}"),
        criterion(
            "  same on all grounds (to 68° and steps): missed",
            100 * missed_lp / compared,
            5.0,
            f"% of {compared}",
            "the LP keeps the footprint of one attitude",
        ),
        criterion(
            "  of these also over the best of 961 attitudes",
            100 * missed_search / compared,
            0.5,
            "%",
            f"worst by {1e3 * max(worst_search, 0.0):.2g} mm",
        ),
        criterion("ATF lift / reactionary lift, mean", float(atf / lazy_mean), 1.0, ""),
        criterion("control points inside the gap after the last lift", inside, 0, ""),
    ]


def coverage(count: int, rng: Any) -> Criteria:
    """Distance of points of random regions from the nearest pass, less half a swath."""
    worst = -math.inf
    show_step(f"accuracy: coverage of {count} regions")
    for k in range(count):
        region = (0.0, 0.0, *rng.uniform(0.3, 2.0, 2))
        swath = float(rng.uniform(0.02, 0.3))
        if k % 2:
            path = lanes(region, swath, step_m=0.005, angle_rad=float(rng.uniform(-4, 4)))
        else:
            path = arcs(region, swath, step_m=0.005, base_m=(rng.uniform(-3, -0.4), rng.uniform(-2, 2)))
        points = rng.uniform(0, 1, (2000, 2)) * region[2:]
        on = path.position_m[path.passes >= 0, :2]
        step = float(np.linalg.norm(np.diff(path.position_m[:, :2], axis=0), axis=1).max())
        d = cKDTree(on).query(points)[0]
        worst = max(worst, float(np.sqrt(np.maximum(d**2 - (step / 2) ** 2, 0)).max()) - swath / 2)
    return [criterion(f"coverage: farther than half a swath, {count} regions", max(worst, 0.0), 1e-9, "m")]


def filters_on_a_hump(rng: Any) -> Criteria:
    """Noise on the flat and height of a 70° hump after three filters, stereo noise of 0.1 px."""
    camera = Camera(400.0, 400.0, 159.5, 119.5, looking_down(0.0, 0.0, 1.5), baseline_m=0.12)
    top, flank = 0.15, math.tan(math.radians(70.0))

    def hump(x: Any, y: Any) -> Any:
        return np.clip((0.25 - np.abs(x)) * flank, 0.0, top) * (np.abs(y) < 0.35)

    truth = naive.render_depth(hump, camera, (240, 320))
    q = camera.disparity_px(truth) + rng.normal(0, 0.1, truth.shape)
    x, y = camera.points_m(truth)[..., 0], camera.points_m(truth)[..., 1]
    flat = np.isfinite(truth) & (np.abs(x) > 0.35) & (np.abs(y) < 0.3)
    edge = np.isfinite(truth) & (np.abs(x) > 0.17) & (np.abs(x) < 0.27) & (np.abs(y) < 0.3)
    errors = {}
    for name, made in (
        ("median", camera.depth_m(median_filter(q))),
        ("gaussian", camera.depth_m(gaussian_filter(q, sigma_px=2.25))),
        ("CPF", conditional_planar_filter(q, camera, kind="disparity").depth_m),
    ):
        d = made - truth
        errors[name] = (float(np.sqrt((d[flat] ** 2).mean())), float(np.sqrt((d[edge] ** 2).mean())))
    c, g, m = errors["CPF"], errors["gaussian"], errors["median"]
    note = ", ".join(f"{n} {1e3 * a:.2f}/{1e3 * b:.2f}" for n, (a, b) in errors.items()) + " mm flat/flank"
    return [
        criterion("CPF / Gaussian error on the flat", c[0] / g[0], 1.1, "", note),
        criterion("CPF / median error on the flat", c[0] / m[0], 0.6, ""),
        criterion("CPF / Gaussian error at the 70° flank", c[1] / g[1], 0.9, ""),
        criterion("CPF / median error at the 70° flank", c[1] / m[1], 1.0, ""),
    ]


def speed() -> Criteria:
    """Speeds side by side, and memory."""
    rng = np.random.default_rng(5)
    camera = Camera(500.0, 500.0, 320.0, 240.0, baseline_m=0.12)
    q = 30 + rng.normal(0, 0.1, (480, 640)) + np.arange(640) * 0.01
    criteria = [
        took("planar deviation 640×480, 9×9, exact", lambda: planar_deviation(q), 33),
        took("planar deviation 640×480, 9×9, fast", lambda: planar_deviation(q, mode="fast"), 16),
    ]
    for mode, limit in (("exact", 33), ("fast", 16)):
        criteria.append(
            took(
                f"whole filter 640×480, 9×9, {mode}",
                lambda mode=mode: conditional_planar_filter(q, camera, kind="disparity", mode=mode),
                limit,
            )
        )
    z = naive.rough_ground(rng, 1000, 0.005, steepest=1.5)
    for radius, limit in ((10, 300), (20, 600), (40, 1300)):
        show_step(f"speed: envelope of 1M cells, radius {radius}, beside scipy")
        wall, processor = best_ms(lambda radius=radius: ball_envelope(z, 0.005, radius * 0.005), 3)
        note = f"processor {processor:.1f} ms"
        criteria.append(criterion(f"envelope of 1M cells, radius {radius}", wall, limit, "ms", note))
        quarter = ball_heights(radius * 0.005, 0.005)
        full = np.block([[quarter[::-1, ::-1], quarter[::-1, 1:]], [quarter[1:, ::-1], quarter[1:, 1:]]])
        start, begin = time.perf_counter(), time.process_time()
        grey_dilation(z, footprint=full >= 0, structure=np.where(full >= 0, full, 0))
        other, used = 1e3 * (time.perf_counter() - start), 1e3 * (time.process_time() - begin)
        note = f"scipy {other:.0f} ms; of its processor time {processor / used:.3f}"
        criteria.append(
            criterion(f"  time / scipy grey_dilation, radius {radius}", wall / other, 1 / 1.5, "", note)
        )
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    made = ball_envelope(z, 0.005, 0.1)
    peak = tracemalloc.get_traced_memory()[1] - before - made.nbytes
    criteria.append(criterion("envelope: memory beyond input and output", peak / z.size, 20, "B/cell"))
    points = rng.random((100_000, 3))
    points[:, 2] = 0.3 * points[:, 0]
    tracemalloc.reset_peak()
    before = tracemalloc.get_traced_memory()[0]
    grid = terrain_map(points, 0.001, region=(0, 0, 1, 1))
    peak = tracemalloc.get_traced_memory()[1] - before - grid.heights_m.nbytes - grid.cells.nbytes
    tracemalloc.stop()
    criteria.append(
        criterion("terrain map: memory beyond input and output", peak / grid.cells.size, 20, "B/cell")
    )
    criteria.append(
        took("100k points to 1M cells", lambda: terrain_map(points, 0.001, region=(0, 0, 1, 1)), 1500, 3)
    )
    holes = TerrainGrid.of(np.where(rng.random(z.shape) < 0.02, np.nan, z), grid_m=0.005)
    criteria.append(took("fill holes of 1M cells", lambda: fill_holes(holes, 0.05), 100, 3))
    ground = TerrainGrid.of(naive.rough_ground(rng, 520, 0.005, steepest=1.0), grid_m=0.005)
    settings = PlanSettings((0.3, 0.3, 2.3, 2.3), 0.1, disc(0.1))
    criteria.append(
        took("plan of 2 × 2 m at 5 mm cells, end to end", lambda: plan_scan(ground, settings), 1000, 3)
    )
    return criteria


def main() -> int:
    """Run what was asked for, print it, and say by the exit code whether every criterion is met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", choices=("accuracy", "speed", "data"))
    parser.add_argument("--terrains", type=int, default=500)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rng = np.random.default_rng(17)
    criteria: Criteria = []
    notes = []
    if options.only in (None, "accuracy"):
        show_step("accuracy: images")
        criteria += twins_of_images(rng) + filters_on_a_hump(rng)
        criteria += terrains(options.terrains, rng) + coverage(options.terrains, rng)
    if options.only in (None, "speed"):
        criteria += speed()
    if options.only in (None, "data"):
        folder = data_folder()
        if (folder / "surfaces").is_dir():
            show_step("measured data")
            criteria += stereo(folder) + lidar(folder) + plans_on_measured_ground(folder)
        else:
            notes.append(f"real data left out: {folder} is not there (SURFFOLLOW_DATA)")
    return finish(result("terrain scanning", criteria, notes))


if __name__ == "__main__":
    sys.exit(main())
