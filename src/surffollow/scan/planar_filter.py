"""Conditional planar filter: smooth a depth image where it is planar, spare it where it is not (paper §2.1).

All work is done on disparities (or, without a baseline, on inverse depths times the focal length): a plane
in space is a plane in them, and stereo noise is the same at every range, so that one threshold serves.
The support of the strongest smoothing is the window of the deviation: no kernel reaches over an edge that
the deviation did not see.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.errors import ScanInputError
from surffollow.scan.bands import in_bands
from surffollow.scan.camera import Camera, depth_image
from surffollow.scan.checks import Floats, positive, real_array
from surffollow.scan.deviation import MODES, deviations, half_width
from surffollow.scan.image_filters import gauss_row, gauss_weights, medians, moments_row
from surffollow.shm.jit import jit_arrays

NO_DATA, ROUGH, PLANAR = 0, 1, 2
# deviation over that of noise alone → strength; between the knots linear
CURVE = ((2.0, 1.0), (4.0, 0.0))
NOISE_QUANTILE = 0.25  # deviations of the most planar quarter are noise
PLANAR_STRENGTH = 0.5  # labelled planar from here
LEAST_NOISE_PX = 1e-9  # in an image without noise only exact planes are planar


@dataclass(frozen=True)
class FilteredImage:
    """What the filter made.

    Attributes
    ----------
    depth_m : (rows, cols) float64 [m]
        NaN where the input had none
    disparity_px : (rows, cols) float64 [px]
    label : (rows, cols) uint8
        NO_DATA, ROUGH or PLANAR
    deviation_px : (rows, cols) float64 [px]
        from the local plane, after the weak median
    strength : (rows, cols) float64
        0 weak … 1 strong
    noise_px : float [px]
        deviation that counts as noise
    """

    depth_m: Floats
    disparity_px: Floats
    label: NDArray[np.uint8]
    deviation_px: Floats
    strength: Floats
    noise_px: float


@jit_arrays
def prepare_rows(q: Any, middle: Any, r: Any, first: Any, last: Any, zp: Any, mp: Any) -> None:
    """Image minus `middle` and its mask into padded arrays; q is finite where valid, else NaN."""
    for y in range(first, last):
        row, z, m = q[y], zp[y + r, r:], mp[y + r, r:]
        for x in range(q.shape[1]):
            valid = row[x] == row[x]
            z[x] = row[x] - middle if valid else 0.0
            m[x] = 1.0 if valid else 0.0


@jit_arrays
def filter_rows(
    strong: Any,
    weak: Any,
    mp: Any,
    dev: Any,
    knots: Any,
    weights: Any,
    first: Any,
    last: Any,
    s: Any,
    out: Any,
) -> None:
    """Mix the weak median, half and full smoothing of the strong median, by strength.

    Parameters
    ----------
    strong, weak, mp : (rows + 2r, cols + 2r) float64
        medians and mask, padded by r, 0 where invalid
    dev : (4, rows, cols) float64
        deviations and planes of `deviation_rows`
    knots : (2, n) float64
        deviations, ascending, and strengths there
    weights : (2, 2r + 1) float64
        of half and full smoothing
    s : (9, cols + 2r) float64
        scratch
    out : (2, rows, cols) float64
        the result, and the strength
    """
    taps, n = weights.shape[1], knots.shape[1]
    r, wide = taps // 2, mp.shape[1]
    cols = wide - 2 * r
    half, full, seen = s[6], s[7], s[8]
    for y in range(first, last):
        d, a, b, w, to, thin = dev[0, y], dev[1, y], dev[2, y], out[1, y], out[0, y], weak[y + r, r:]
        for x in range(cols):
            w[x] = knots[1, 0]
        for k in range(n - 1):
            low, first_value = knots[0, k], knots[1, k]
            width, rise = knots[0, k + 1] - low, knots[1, k + 1] - knots[1, k]
            for x in range(cols):
                part = first_value + rise * min((d[x] - low) / width, 1.0)
                w[x] = part if d[x] >= low else w[x]
        for x in range(wide):
            seen[x] = 0.0
        for k in range(taps):
            row = mp[y + k]
            for x in range(wide):
                seen[x] += row[x]
        holes = 0
        for x in range(r, wide - r):
            holes += 1 if seen[x] < taps else 0
        if holes == 0 and r <= y < mp.shape[0] - 3 * r:
            gauss_row(strong, weights[0], y, s[0], half)
            gauss_row(strong, weights[1], y, s[0], full)
            e = wide - 3 * r
            for k in range(2):
                to_k = half if k == 0 else full
                moments_row(strong[:, : 3 * r], mp[:, : 3 * r], weights[k], y, a[:r], b[:r], s, to_k[:r])
                moments_row(
                    strong[:, e:], mp[:, e:], weights[k], y, a[cols - r :], b[cols - r :], s, to_k[cols - r :]
                )
        else:
            moments_row(strong, mp, weights[0], y, a, b, s, half)
            moments_row(strong, mp, weights[1], y, a, b, s, full)
        for x in range(cols):
            q = w[x] if d[x] == d[x] else 0.0
            w[x] = q
            lower = thin[x] + (half[x] - thin[x]) * (2.0 * q)
            upper = half[x] + (full[x] - half[x]) * (2.0 * q - 1.0)
            mixed = lower if q <= 0.5 else upper
            to[x] = mixed if q > 0.0 else thin[x]


@jit_arrays
def finish_rows(
    mp: Any,
    middle: Any,
    k: Any,
    offset: Any,
    r: Any,
    first: Any,
    last: Any,
    out: Any,
    dev: Any,
    depth: Any,
    label: Any,
) -> None:
    """Depths k / (disparity + offset) and labels of the result; NaN where the input had no data."""
    for y in range(first, last):
        m, to, w, d, z, kind = mp[y + r, r:], out[0, y], out[1, y], dev[0, y], depth[y], label[y]
        for x in range(z.shape[0]):
            valid = m[x] > 0.0
            q = to[x] + middle
            at = k / (q + offset)
            z[x] = at if valid and at > 0.0 else math.nan
            to[x] = q if valid else math.nan
            d[x] = d[x] if valid else math.nan
            w[x] = w[x] if valid else 0.0
            kind[x] = (PLANAR if w[x] >= PLANAR_STRENGTH else ROUGH) if valid else NO_DATA


def conditional_planar_filter(
    image: ArrayLike,
    camera: Camera,
    *,
    kind: str = "depth",
    window: int = 9,
    mode: str = "exact",
    curve: tuple[tuple[float, float], ...] = CURVE,
    noise_px: float | None = None,
) -> FilteredImage:
    """Filter a depth or disparity image by how planar each pixel's window is.

    Parameters
    ----------
    image : (rows, cols) float
        depths [m] or disparities [px]; NaN, 0 or infinite: none
    camera : Camera
        focal length and, for disparities, baseline
    kind : str
        "depth" or "disparity"
    window : int
        odd side of the window [px]; the strongest Gaussian has sigma window / 4
    mode : str
        "exact" or "fast" deviation
    curve : ((ratio, strength), …)
        knots of strength over deviation / noise, ratios ascending
    noise_px : float [px]
        deviation of flat ground; None: from the most planar quarter of the image

    Returns
    -------
    FilteredImage
        pixels without data stay without

    Raises
    ------
    ScanInputError
        no pixel, depths that cannot be, a curve that is none

    Notes
    -----
    Paper §2.1. Weak filter: 3 × 3 median. Strong filter: a second 3 × 3 median and the Gaussian. Where the
    window has holes, the weighted mean is moved along the local plane, so that a slope keeps its height.
    """
    r = half_width(window)
    if mode not in MODES:
        raise ScanInputError(f"mode is '{mode}'; expected one of {', '.join(MODES)}")
    ratios, strengths = _curve(curve)
    q, factor = _as_disparity(image, camera, kind)
    rows, cols = q.shape
    zp, mp = np.zeros((rows + 2 * r, cols + 2 * r)), np.zeros((rows + 2 * r, cols + 2 * r))
    middle = _level(q)
    in_bands(rows, lambda first, last: prepare_rows(q, middle, r, first, last, zp, mp))
    weak = medians(zp, mp, r)
    dev = np.empty((4, rows, cols))
    deviations(weak, mp, r, mode, dev)
    noise = _noise(dev[0]) if noise_px is None else positive("noise_px", noise_px, "px")
    knots = np.stack([ratios * max(noise, LEAST_NOISE_PX), strengths])
    strong = medians(weak, mp, r)
    weights = np.stack([gauss_weights(window / 8.0, r), gauss_weights(window / 4.0, r)])
    out = np.empty((2, rows, cols))

    def work(first: int, last: int) -> None:
        filter_rows(strong, weak, mp, dev, knots, weights, first, last, np.empty((9, zp.shape[1])), out)

    in_bands(rows, work)
    depth, label = np.empty((rows, cols)), np.empty((rows, cols), np.uint8)
    k = camera.stereo_factor_m_px() if factor is None else factor
    offset = camera.disparity_offset_px if factor is None else 0.0
    in_bands(
        rows, lambda first, last: finish_rows(mp, middle, k, offset, r, first, last, out, dev, depth, label)
    )
    return FilteredImage(depth, out[0], label, dev[0], out[1], noise)


def _as_disparity(image: ArrayLike, camera: Camera, kind: str) -> tuple[Floats, float | None]:
    """Disparities [px] and None; or focal length / depth [px] and that length, without a baseline."""
    if kind == "disparity":
        q = real_array("disparity_px", image, (None, None))
        if q.size == 0:
            raise ScanInputError(f"the disparity image of {camera.name} has shape {q.shape}; it has no pixel")
        seen = depth_image(camera.depth_m(q), camera)
        q = q.copy()
        q[np.isnan(seen)] = np.nan
        return q, None
    if kind != "depth":
        raise ScanInputError(f"kind is '{kind}'; expected depth or disparity")
    z = depth_image(image, camera)
    if camera.baseline_m > 0.0:
        return camera.disparity_px(z), None
    return camera.fx_px / z, camera.fx_px


def _level(q: Floats) -> float:
    """A value amid the image, to be taken off before sums are formed."""
    part = q[:: max(1, q.shape[0] // 16)]
    known = part[np.isfinite(part)]
    return float(known.mean()) if known.size else 0.0


def _noise(deviation: Floats) -> float:
    part = deviation[:: max(1, deviation.shape[0] // 64)]
    known = part[np.isfinite(part)]
    return float(np.quantile(known, NOISE_QUANTILE)) if known.size else 0.0


def _curve(curve: tuple[tuple[float, float], ...]) -> tuple[Floats, Floats]:
    knots = real_array("curve", np.asarray(curve, np.float64), (None, 2))
    ratios, strengths = knots[:, 0], knots[:, 1]
    if len(knots) == 0 or not np.isfinite(knots).all() or (np.diff(ratios) <= 0.0).any():
        raise ScanInputError("curve needs finite knots (deviation / noise, strength) with ascending ratios")
    if strengths.min() < 0.0 or strengths.max() > 1.0:
        raise ScanInputError("strengths of the curve must lie in 0 … 1")
    return np.ascontiguousarray(ratios), np.ascontiguousarray(strengths)
