"""Terrain scanning once more, slow and obvious: loops, direct least squares, brute force, a linear programme.

Written from the specification, not from the package. The bench and the tests compare with these.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import linprog


def planar_deviation(image, window):
    """(mean absolute, root mean square) residual of each window's least-squares plane, pixel by pixel."""
    r = window // 2
    rows, cols = image.shape
    mad, rms = np.full(image.shape, np.nan), np.full(image.shape, np.nan)
    for y in range(rows):
        for x in range(cols):
            if not np.isfinite(image[y, x]):
                continue
            points = [
                (j - x, i - y, image[i, j])
                for i in range(max(0, y - r), min(rows, y + r + 1))
                for j in range(max(0, x - r), min(cols, x + r + 1))
                if np.isfinite(image[i, j])
            ]
            p = np.array(points)
            a = np.column_stack([p[:, :2], np.ones(len(p))])
            plane, _, rank, _ = np.linalg.lstsq(a, p[:, 2], rcond=None)
            if rank == 3:
                left = p[:, 2] - a @ plane
                mad[y, x], rms[y, x] = np.abs(left).mean(), math.sqrt((left**2).mean())
    return mad, rms


def median(image):
    """Median of the valid pixels of 3 × 3, where the pixel itself is valid."""
    out = np.full(image.shape, np.nan)
    for y, x in zip(*np.nonzero(np.isfinite(image))):
        out[y, x] = np.nanmedian(image[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2])
    return out


def ball(z, grid, gap):
    """Grey dilation by a ball, offset by offset over the whole disc."""
    rows, cols = z.shape
    out = np.full(z.shape, -np.inf)
    known = np.where(np.isnan(z), -np.inf, z)
    r = int(gap / grid * (1 + 1e-12))
    for dy in range(-r, r + 1):
        for dx in range(-r, r + 1):
            left = gap * gap - ((dy * grid) ** 2 + (dx * grid) ** 2)
            if left < -1e-12 * gap * gap or abs(dy) >= rows or abs(dx) >= cols:
                continue
            h = math.sqrt(max(left, 0.0))
            to = (slice(max(0, -dy), rows - max(0, dy)), slice(max(0, -dx), cols - max(0, dx)))
            of = (slice(max(0, dy), rows - max(0, -dy)), slice(max(0, dx), cols - max(0, -dx)))
            out[to] = np.maximum(out[to], known[of] + h)
    return out


def bilinear(z, grid, x, y):
    """Height between cell centres of a grid whose outer corner is (0, 0)."""
    u, v = np.clip(x / grid - 0.5, 0, z.shape[1] - 1), np.clip(y / grid - 0.5, 0, z.shape[0] - 1)
    i, j = np.minimum(u.astype(int), z.shape[1] - 2), np.minimum(v.astype(int), z.shape[0] - 2)
    a, b = u - i, v - j
    low = z[j, i] * (1 - a) + z[j, i + 1] * a
    high = z[j + 1, i] * (1 - a) + z[j + 1, i + 1] * a
    return low * (1 - b) + high * b


def rotation(azimuth, pitch, roll):
    """R_z R_y R_x."""
    c, s = math.cos(azimuth), math.sin(azimuth)
    z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    c, s = math.cos(pitch), math.sin(pitch)
    y = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    c, s = math.cos(roll), math.sin(roll)
    return z @ y @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def lift_of(z, grid, tip, azimuth, pitch, roll, body):
    """Lift that makes a body clear at an attitude; negative when it is clear already."""
    p = tip + body @ rotation(azimuth, pitch, roll).T
    return float((bilinear(z, grid, p[:, 0], p[:, 1]) - p[:, 2]).max())


def least_lift_lp(z, grid, tip, offsets, slope_limits):
    """Least lift over all planes through control points whose places (m, 2) from the tip stay: an LP.

    min l  s.t.  z_tip + l + a u_i + b v_i ≥ E_i, l ≥ 0, |a|, |b| ≤ limits.
    """
    e = bilinear(z, grid, tip[0] + offsets[:, 0], tip[1] + offsets[:, 1]) - tip[2]
    a, b = slope_limits
    got = linprog(
        [1, 0, 0],
        A_ub=-np.column_stack([np.ones(len(offsets)), offsets]),
        b_ub=-e,
        bounds=[(0, None), (-a, a), (-b, b)],
        method="highs",
    )
    return float(got.fun)


def least_raise_lp(t, z, speed, acceleration):
    """Least sum [m] of raises of heights z at times t that keep a vertical speed and acceleration: an LP.

    The tool rests before the first and after the last row, each as far away as half a step.
    """
    n = len(t)
    a, b = [], []

    def within(row, most):
        for sign in (1.0, -1.0):
            a.append(sign * row)
            b.append(most - sign * float(row @ z))

    def climb(k):
        row = np.zeros(n)
        if 0 <= k < n - 1:
            row[k], row[k + 1] = -1.0 / (t[k + 1] - t[k]), 1.0 / (t[k + 1] - t[k])
        return row

    for k in range(n):
        if k < n - 1:
            within(climb(k), speed)
        before, behind = t[max(k - 1, 0)], t[min(k + 1, n - 1)]
        within(climb(k) - climb(k - 1), acceleration * 0.5 * (behind - before))
    got = linprog(np.ones(n), A_ub=np.array(a), b_ub=np.array(b), bounds=(0, None), method="highs")
    return float(got.fun)


def least_lift_search(z, grid, tip, body, limit, n=31):
    """Least lift over a raster of attitudes, each with its own footprint."""
    angles = np.linspace(-limit, limit, n)
    return max(0.0, min(lift_of(z, grid, tip, 0.0, p, r, body) for p in angles for r in angles))


def unknown_within(z, radius_cells):
    """Cells with an unknown cell or the outside within a radius, by looking at each."""
    rows, cols = z.shape
    out = np.zeros(z.shape, bool)
    r = int(radius_cells * (1 + 1e-12))
    for y in range(rows):
        for x in range(cols):
            for dy in range(-r, r + 1):
                for dx in range(-r, r + 1):
                    if dy * dy + dx * dx <= radius_cells**2 * (1 + 1e-12):
                        i, j = y + dy, x + dx
                        if not (0 <= i < rows and 0 <= j < cols) or not np.isfinite(z[i, j]):
                            out[y, x] = True
    return out


def labels(z, jump):
    """Connected pixels, grown one by one."""
    rows, cols = z.shape
    out = np.full(z.shape, -1)
    n = 0
    for y in range(rows):
        for x in range(cols):
            if not np.isfinite(z[y, x]) or out[y, x] >= 0:
                continue
            out[y, x], waiting = n, [(y, x)]
            while waiting:
                i, j = waiting.pop()
                for a, b in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
                    if not (0 <= a < rows and 0 <= b < cols) or out[a, b] >= 0 or not np.isfinite(z[a, b]):
                        continue
                    if abs(z[a, b] - z[i, j]) <= max(jump[a, b], jump[i, j]):
                        out[a, b] = n
                        waiting.append((a, b))
            n += 1
    return out


def rough_ground(rng, n, grid, *, steepest=None):
    """A random terrain (n, n) [m]: correlated noise, sometimes with steps and spikes."""
    from scipy.ndimage import gaussian_filter

    z = gaussian_filter(rng.normal(0, 1, (n, n)), rng.uniform(1.5, n / 8))
    slope = max(np.abs(np.diff(z, axis=0)).max(), np.abs(np.diff(z, axis=1)).max()) / grid
    z *= (rng.uniform(0.2, 2.5) if steepest is None else rng.uniform(0.1, steepest)) / slope
    if steepest is None and rng.random() < 0.3:
        z[:, n // 2 :] += rng.uniform(-0.3, 0.3)
    return z


def render_depth(height_at, camera, shape, *, near=0.2, far=6.0, steps=600):
    """Depth image [m] of a ground height_at(x, y) seen by a camera: march every ray, then bisect."""
    pose = camera.pose()
    rays = camera.rays(shape) @ pose[:3, :3].T
    depth = np.full(shape, np.nan)
    before = np.full(shape, near)
    for d in np.linspace(near, far, steps):
        p = pose[:3, 3] + rays * d
        hit = np.isnan(depth) & (p[..., 2] <= height_at(p[..., 0], p[..., 1]))
        if hit.any():
            low, high = before[hit], np.full(hit.sum(), d)
            for _ in range(20):
                middle = 0.5 * (low + high)
                q = pose[:3, 3] + rays[hit] * middle[:, None]
                under = q[:, 2] <= height_at(q[:, 0], q[:, 1])
                high, low = np.where(under, middle, high), np.where(under, low, middle)
            depth[hit] = 0.5 * (low + high)
        before[:] = d
    return depth
