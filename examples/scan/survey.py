"""Render a small survey for `surffollow scan`: disparity images of bumpy ground with a steep hump.

    python examples/scan/survey.py FOLDER [--seed 1]

Writes view0.npz … view3.npz and cameras.toml. Two of the views show a board that hangs over the ground.
true.npz is the ground itself, and service.toml lets a service's simulated sensor see it.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np

from surffollow.map import HeightMap
from surffollow.scan import Camera, looking_down

SHAPE, FOCAL_PX, BASELINE_M, NOISE_PX = (240, 320), 260.0, 0.12, 0.08
FLANK = math.tan(math.radians(70.0))
GRID_M, SIZE_M = 0.005, (1.4, 1.2)
HIGHEST_M = 0.6  # of the ground and the board
SERVICE = """[driver]
kind = "simulated"
[driver.world]
file = "true.npz"
[driver.led]
window_m = [0.015, 0.25]
[follow]
offset = 0.05
range_min = 0.0155
range_max = 0.245
too_close = 0.016
too_close_exit = 0.018
max_demand = 0.2
"""


def ground(x, y):
    """Height of the ground [m]: bumps of 3 cm, and a hump of 12 cm with flanks of 70°."""
    bumps = 0.015 * np.sin(5.0 * x + 1.0) * np.cos(4.0 * y) + 0.01 * np.sin(9.0 * y)
    return bumps + np.clip((0.18 - np.hypot(x - 0.9, y - 0.6)) * FLANK, 0.0, 0.12)


def render(camera, board):
    """Depth image [m]: march along every ray until it is below the ground or hits the board."""
    pose = camera.pose()
    rays = (camera.rays(SHAPE) @ pose[:3, :3].T).reshape(-1, 3)
    depth, before = np.full(len(rays), np.nan), 0.0
    left = np.arange(len(rays))  # rays that have met nothing yet, and their vertical parts
    down = rays[:, 2].copy()
    for d in np.linspace(0.5, 3.5, 500):
        near = left[pose[2, 3] + down * d <= HIGHEST_M]
        p = pose[:3, 3] + rays[near] * d
        over = (np.abs(p[:, :2] - (0.3, 0.8)) < 0.1).all(axis=1) & (np.abs(p[:, 2] - 0.57) < 0.03) & board
        hit = over | (p[:, 2] <= ground(p[:, 0], p[:, 1]))
        met, over = near[hit], over[hit]
        low, high = np.full(len(met), before), np.full(len(met), d)
        for _ in range(16 if len(met) else 0):
            middle = 0.5 * (low + high)
            q = pose[:3, 3] + rays[met] * middle[:, None]
            below = (q[:, 2] <= ground(q[:, 0], q[:, 1])) | (over & (q[:, 2] < 0.6))
            low, high = np.where(below, low, middle), np.where(below, middle, high)
        depth[met] = 0.5 * (low + high)
        before = d
        if len(met):
            left = np.flatnonzero(np.isnan(depth))
            down = rays[left, 2]
        if not len(left):  # every ray has met something
            break
    return depth.reshape(SHAPE)


def main():
    """Render the views and write their cameras."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(options.seed)
    lines = [
        "[default]",
        f"fx_px = {FOCAL_PX}",
        f"fy_px = {FOCAL_PX}",
        f"cx_px = {(SHAPE[1] - 1) / 2}",
        f"cy_px = {(SHAPE[0] - 1) / 2}",
        f"baseline_m = {BASELINE_M}",
        'kind = "disparity"',
    ]
    for k, (x, y, heading) in enumerate(
        ((0.2, 0.2, 0.6), (1.2, 0.2, 2.4), (1.2, 1.0, -2.4), (0.2, 1.0, -0.6))
    ):
        pose = looking_down(x, y, 1.6, tilt_rad=0.25, heading_rad=heading)
        camera = Camera(FOCAL_PX, FOCAL_PX, (SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2, pose, BASELINE_M)
        q = camera.disparity_px(render(camera, board=k in (0, 3)))
        q += rng.normal(0.0, NOISE_PX, SHAPE)
        q[rng.random(SHAPE) < 0.02] = np.nan  # pixels without texture
        np.savez_compressed(options.folder / f"view{k}.npz", disparity_px=q.astype(np.float32))
        lines += ["", f'[images."view{k}.npz"]', f"ground_from_camera = {pose.round(12).tolist()}"]
    (options.folder / "cameras.toml").write_text("\n".join(lines) + "\n")
    x, y = (np.arange(round(side / GRID_M)) * GRID_M + 0.5 * GRID_M for side in SIZE_M)
    true = HeightMap.from_heights(ground(x[None], y[:, None]), origin_m=(0.0, 0.0), grid_m=GRID_M)
    true.save(options.folder / "true.npz")
    (options.folder / "service.toml").write_text(SERVICE)


if __name__ == "__main__":
    main()
