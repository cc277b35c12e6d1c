"""Conditional planar filter: smooth a depth image where it is planar, spare it where it is not (paper §2.1).

All work is done on disparities (or, without a baseline, on inverse depths times the focal length): a plane
in space is a plane in them, and stereo noise is the same at every range, so that one threshold serves.
The support of the strongest smoothing is the window of the deviation: no kernel reaches over an edge that
the deviation did not see.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.errors import ScanInputError
from surffollow.scan.bands import in_bands
from surffollow.scan.camera import Camera, depth_image
from surffollow.scan.checks import Floats, positive, real_array
from surffollow.scan.deviation import MODES, deviations, half_width
from surffollow.scan.image_filters import gauss_weights, medians
from surffollow.scan.planar_kernels import filter_rows, finish_rows, prepare_rows

# deviation over that of noise alone → strength; between the knots linear
CURVE = ((2.0, 1.0), (4.0, 0.0))
NOISE_QUANTILE = 0.25  # deviations of the most planar quarter are noise
MIN_NOISE_PX = 1e-9  # in an image without noise only exact planes are planar


@dataclass(frozen=True)
class FilteredImage:
    """Result of the filter.

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

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import Camera, conditional_planar_filter
    >>> camera = Camera(60.0, 60.0, 31.5, 23.5, baseline_m=0.1)
    >>> filtered = conditional_planar_filter(np.full((48, 64), 1.2), camera, noise_px=0.1)
    >>> filtered.depth_m.shape, filtered.noise_px
    ((48, 64), 0.1)
    """

    depth_m: Floats
    disparity_px: Floats
    label: NDArray[np.uint8]
    deviation_px: Floats
    strength: Floats
    noise_px: float


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

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import Camera, conditional_planar_filter
    >>> camera = Camera(60.0, 60.0, 31.5, 23.5, baseline_m=0.1)
    >>> depth_m = 1.2 + np.random.default_rng(1).normal(0.0, 0.01, (48, 64))
    >>> filtered = conditional_planar_filter(depth_m, camera, window=9)
    >>> bool(filtered.depth_m[8:-8, 8:-8].std() < 0.5 * depth_m.std())
    True
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
    knots = np.stack([ratios * max(noise, MIN_NOISE_PX), strengths])
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
