"""A stereo camera over a height field: rays, occlusion in the second view, disparity noise, lost texture."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.shm.jit import jit
from surffollow.sim.surfaces import HeightField, field_height

REFINE = 24  # halvings of the last step: far below a micrometre
Floats = NDArray[np.float64]


@jit
def cast(z: Any, x0: Any, y0: Any, g: Any, o: Any, d: Any, nearest: Any, farthest: Any, step: Any) -> float:
    """Length along the unit ray o + s d to the ground between two lengths [m]; NaN: none.

    Parameters
    ----------
    z : (ny, nx) float64 [m]  heights
    x0, y0, g : float [m]     position of z[0, 0] and spacing
    o, d : (3,) float64       begin of the ray [m], and unit direction
    nearest, farthest, step : float [m]  lengths looked at

    Notes
    -----
    Marches by `step` until the ray is below the ground, then halves that step. Ridges thinner than the
    step can be missed.
    """
    s = nearest
    before = s
    while s <= farthest:
        if o[2] + s * d[2] <= field_height(z, x0, y0, g, o[0] + s * d[0], o[1] + s * d[1]):
            low, high = before, s
            for _ in range(REFINE):
                middle = 0.5 * (low + high)
                at = field_height(z, x0, y0, g, o[0] + middle * d[0], o[1] + middle * d[1])
                if o[2] + middle * d[2] <= at:
                    high = middle
                else:
                    low = middle
            return 0.5 * (low + high)  # type: ignore[no-any-return]
        before = s
        s += step
    return math.nan


@jit
def render_rows(
    z: Any, frame: Any, pose: Any, lens: Any, baseline: Any, reach: Any, ray: Any, back: Any, depth: Any
) -> None:
    """Depth of every pixel; NaN where nothing is in reach or the second camera does not see the place.

    Parameters
    ----------
    z, frame : heights, and x0, y0, grid and highest ground [m]
    pose : (4, 4) float64        ground_from_camera
    lens : (4,) float64          fx, fy, cx, cy [px]
    baseline : float [m]         the second camera is that far along the camera's x
    reach : (3,) float64         nearest, farthest, step [m]
    ray, back : (3,) float64     scratch
    depth : (rows, cols) float64 out
    """
    rows, cols = depth.shape
    o = pose[:3, 3]
    x0, y0, g, top = frame[0], frame[1], frame[2], frame[3]
    for v in range(rows):
        b = (v - lens[3]) / lens[1]
        for u in range(cols):
            a = (u - lens[2]) / lens[0]
            long = math.sqrt(a * a + b * b + 1.0)
            for k in range(3):
                ray[k] = (pose[k, 0] * a + pose[k, 1] * b + pose[k, 2]) / long
            # nothing to be met above the highest ground
            first = (top - o[2]) / ray[2] - reach[2] if ray[2] < 0.0 else reach[1]
            s = cast(z, x0, y0, g, o, ray, max(reach[0], first), reach[1], reach[2])
            depth[v, u] = s / long
            if s != s or baseline == 0.0:
                continue
            far = 0.0
            for k in range(3):
                ray[k] = o[k] + s * ray[k]  # the place itself
                back[k] = o[k] + baseline * pose[k, 0] - ray[k]
                far += back[k] * back[k]
            far = math.sqrt(far)
            for k in range(3):
                back[k] /= far
            far = min(far, (top - ray[2]) / back[2] if back[2] > 0.0 else far)
            if not math.isnan(cast(z, x0, y0, g, ray, back, 0.02, far, reach[2])):
                depth[v, u] = math.nan


def render_depth(
    ground: HeightField,
    ground_from_camera: Floats,
    lens_px: tuple[float, float, float, float],
    shape: tuple[int, int],
    *,
    baseline_m: float = 0.0,
    farthest_m: float = 4.0,
    step_m: float = 0.01,
) -> Floats:
    """(rows, cols) true depths [m]; NaN out of reach, or occluded from the second camera.

    Parameters
    ----------
    ground : HeightField
    ground_from_camera : (4, 4) float64
    lens_px : 4 × float     fx, fy, cx, cy
    shape : (rows, cols)
    baseline_m : float [m]  the second camera is that far along the camera's x
    farthest_m : float [m]  reach along the ray
    step_m : float [m]      of the search, as in `cast`
    """
    depth = np.empty(shape)
    frame = np.array([ground.x0_m, ground.y0_m, ground.grid_m, ground.heights_m.max()])
    reach = np.array([0.2, farthest_m, step_m])
    pose = np.ascontiguousarray(ground_from_camera)
    render_rows(
        ground.heights_m, frame, pose, np.array(lens_px), baseline_m, reach, np.empty(3), np.empty(3), depth
    )
    return depth


def stereo_disparity(
    depth_m: Floats,
    factor_m_px: float,
    rng: np.random.Generator,
    *,
    noise_px: float = 0.15,
    shots: float = 0.002,
    untextured: int = 6,
    patch_px: float = 5.0,
) -> Floats:
    """Disparities [px] of true depths as a block matcher gives them; NaN without.

    Parameters
    ----------
    factor_m_px : float [m px]     fx × baseline
    noise_px : float [px]          deviation of a disparity; neighbours are correlated over 3 pixels
    shots : float                  part of the pixels that are matched wrongly
    untextured : int               patches without texture: no disparity there
    patch_px : float [px]          their mean radius
    """
    rows, cols = depth_m.shape
    white = rng.normal(0.0, 1.0, (rows + 2, cols + 2))
    noise = sum(white[i : i + rows, j : j + cols] for i in range(3) for j in range(3)) / 3.0
    q = factor_m_px / depth_m + noise_px * noise
    wrong = rng.random((rows, cols)) < shots
    q[wrong] += rng.uniform(-8.0, 8.0, int(wrong.sum()))
    v, u = np.indices((rows, cols))
    for _ in range(untextured):
        y, x, r = rng.uniform(0, rows), rng.uniform(0, cols), rng.uniform(0.5, 1.5) * patch_px
        q[(v - y) ** 2 + (u - x) ** 2 < r * r] = np.nan
    return np.where(q > 0.0, q, np.nan)
