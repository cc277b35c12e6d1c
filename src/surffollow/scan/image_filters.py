"""Median and Gaussian kernels over images with holes; the two plain filters that the paper compares with."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from surffollow.errors import ScanInputError
from surffollow.scan.bands import in_bands
from surffollow.scan.checks import Floats, finite, real_array
from surffollow.scan.image_kernels import gauss_rows, median_rows


def gauss_weights(sigma_px: float, r: int) -> Floats:
    """(2r + 1,) weights of a Gaussian cut at ±r, sum 1."""
    k = np.arange(-r, r + 1)
    w: Floats = np.exp(-0.5 * (k / sigma_px) ** 2)
    return np.asarray(w / w.sum(), np.float64)


def pad(values: Floats, r: int) -> Floats:
    """Zeros r wide around an image."""
    rows, cols = values.shape
    made = np.zeros((rows + 2 * r, cols + 2 * r))
    made[r : r + rows, r : r + cols] = values
    return made


def medians(zp: Floats, mp: Floats, r: int) -> Floats:
    """`median_rows` over all rows, in bands; padded by r as its input."""
    out = np.zeros(zp.shape)

    def work(first: int, last: int) -> None:
        median_rows(zp, mp, r, first, last, np.empty((5, zp.shape[1] + 9)), out)

    in_bands(zp.shape[0] - 2 * r, work)
    return out


def median_filter(image: ArrayLike, *, passes: int = 1) -> Floats:
    """Median of 3 × 3 pixels, repeated: the paper's *minimal filtering*.

    Parameters
    ----------
    image : (rows, cols) float
        NaN invalid; stays invalid
    passes : int
        how often

    Returns
    -------
    (rows, cols) float64

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import median_filter
    >>> depth_m = np.ones((3, 3))
    >>> depth_m[1, 1] = 9.0                                   # an outlier
    >>> float(median_filter(depth_m)[1, 1])
    1.0
    """
    z = _image(image)
    mask = np.isfinite(z)
    zp, mp = pad(np.where(mask, z, 0.0), 1), pad(mask.astype(np.float64), 1)
    for _ in range(passes):
        zp = medians(zp, mp, 1)
    return np.where(mask, zp[1:-1, 1:-1], np.nan)


def gaussian_filter(image: ArrayLike, *, sigma_px: float = 2.0) -> Floats:
    """Gaussian smoothing, support ±2 sigma, over valid pixels only: the paper's *Gaussian smoothing*.

    Parameters
    ----------
    image : (rows, cols) float
        NaN invalid; stays invalid
    sigma_px : float [px]
        standard deviation

    Returns
    -------
    (rows, cols) float64

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import gaussian_filter
    >>> depth_m = np.ones((9, 9))
    >>> depth_m[4, 4] = 2.0
    >>> smooth_m = gaussian_filter(depth_m, sigma_px=2.0)
    >>> smooth_m.shape, bool(smooth_m.max() < 1.1)
    ((9, 9), True)
    """
    z = _image(image)
    if finite("sigma_px", sigma_px, "px") <= 0.0:
        raise ScanInputError(f"sigma_px is {sigma_px:g}; it must be above 0")
    r = max(1, round(2 * sigma_px))
    mask = np.isfinite(z)
    top = _smooth(pad(np.where(mask, z, 0.0), r), gauss_weights(sigma_px, r), z.shape)
    bottom = _smooth(pad(mask.astype(np.float64), r), gauss_weights(sigma_px, r), z.shape)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(mask, top / bottom, np.nan)


def _smooth(zp: Floats, weights: Floats, shape: tuple[int, ...]) -> Floats:
    out = np.empty(shape)
    in_bands(shape[0], lambda first, last: gauss_rows(zp, weights, first, last, np.empty(zp.shape[1]), out))
    return out


def _image(image: ArrayLike) -> Floats:
    z = real_array("image", image, (None, None))
    if z.size == 0:
        raise ScanInputError(f"the image has shape {z.shape}; it has no pixel")
    return np.where(np.isfinite(z), z, np.nan)
