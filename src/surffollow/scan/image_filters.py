"""Median and Gaussian kernels over images with holes; the two plain filters that the paper compares with."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from surffollow.errors import ScanInputError
from surffollow.scan.bands import in_bands
from surffollow.scan.checks import Floats, finite, real_array
from surffollow.shm.jit import jit_arrays


@jit_arrays
def median_rows(zp: Any, mp: Any, r: Any, first: Any, last: Any, s: Any, out: Any) -> None:
    """3 × 3 medians of rows first … last - 1; even counts give the mean of the middle two.

    Parameters
    ----------
    zp, mp : (rows + 2r, cols + 2r) float64
        image padded by r ≥ 1, 0 where invalid; 1 valid, 0 invalid
    s : (5, cols + 2) float64
        scratch
    out : (rows + 2r, cols + 2r) float64
        padded likewise, 0 where invalid; its margin is left alone

    Notes
    -----
    Three sorted columns: the median of nine is the median of (the largest least, the median middle, the
    least largest).
    """
    wide = zp.shape[1] - 2 * r + 2
    cols = wide - 2
    low, mid, high, seen, nine = s[0], s[1], s[2], s[3], s[4]
    l1, l2, c1, c2, h1, h2, s1, s2 = (
        low[1:],
        low[2:],
        mid[1:],
        mid[2:],
        high[1:],
        high[2:],
        seen[1:],
        seen[2:],
    )
    for y in range(first, last):
        at = y + r - 1
        p, q, t = zp[at, r - 1 :], zp[at + 1, r - 1 :], zp[at + 2, r - 1 :]
        m0, m1, m2 = mp[at, r - 1 :], mp[at + 1, r - 1 :], mp[at + 2, r - 1 :]
        for x in range(wide):
            a = min(p[x], q[x])
            b = max(p[x], q[x])
            c = min(b, t[x])
            low[x] = min(a, c)
            mid[x] = max(a, c)
            high[x] = max(b, t[x])
            seen[x] = m0[x] + m1[x] + m2[x]
        row, own = out[at + 1, r:], m1[1:]
        for x in range(cols):
            a = max(low[x], max(l1[x], l2[x]))
            b = max(min(mid[x], c1[x]), min(max(mid[x], c1[x]), c2[x]))
            c = min(high[x], min(h1[x], h2[x]))
            row[x] = max(min(a, b), min(max(a, b), c))
        for x in range(cols):
            if seen[x] + s1[x] + s2[x] < 9.0:
                if own[x] == 0.0:
                    row[x] = 0.0
                    continue
                n = 0
                for di in range(3):
                    for dj in range(3):
                        if mp[at + di, x + r - 1 + dj] > 0.0:
                            v = zp[at + di, x + r - 1 + dj]
                            k = n
                            while k > 0 and nine[k - 1] > v:
                                nine[k] = nine[k - 1]
                                k -= 1
                            nine[k] = v
                            n += 1
                row[x] = 0.5 * (nine[(n - 1) // 2] + nine[n // 2])


@jit_arrays
def gauss_row(zp: Any, weights: Any, y: Any, s: Any, to: Any) -> None:
    """Separable weighted sums of one row.

    Parameters
    ----------
    zp : (rows + 2r, cols + 2r) float64
        padded image
    weights : (2r + 1,) float64
        of one direction, sum 1
    s : (cols + 2r,) float64
        scratch
    to : (cols,) float64
        out
    """
    wide, taps = zp.shape[1], weights.shape[0]
    cols = wide - taps + 1
    for x in range(wide):
        s[x] = 0.0
    for k in range(taps):
        row, w = zp[y + k], weights[k]
        for x in range(wide):
            s[x] += w * row[x]
    for x in range(cols):
        to[x] = 0.0
    for k in range(taps):
        part, w = s[k:], weights[k]
        for x in range(cols):
            to[x] += w * part[x]


@jit_arrays
def gauss_rows(zp: Any, weights: Any, first: Any, last: Any, s: Any, out: Any) -> None:
    """`gauss_row` for rows first … last - 1 of out (rows, cols)."""
    for y in range(first, last):
        gauss_row(zp, weights, y, s, out[y])


@jit_arrays
def moments_row(zp: Any, mp: Any, g: Any, y: Any, a: Any, b: Any, s: Any, to: Any) -> None:
    """Weighted means of one row over valid pixels, each moved along its plane's slopes.

    The mean of a window with holes belongs to the middle of what is there; the slopes a (per column) and
    b (per row) bring it back to the pixel.

    Parameters
    ----------
    zp, mp : (rows + 2r, cols + 2r) float64
        padded image and mask
    g : (2r + 1,) float64
        weights of one direction
    a, b : (cols,) float64
        slopes; NaN: none
    s : (6, cols + 2r) float64
        scratch
    to : (cols,) float64
        out; NaN where nothing is valid
    """
    wide, taps = zp.shape[1], g.shape[0]
    cols, r = wide - taps + 1, taps // 2
    z, m, my, w, wx, wy = s[0], s[1], s[2], s[3], s[4], s[5]
    for x in range(wide):
        z[x] = 0.0
        m[x] = 0.0
        my[x] = 0.0
    for k in range(taps):
        zr, mr, f, fk = zp[y + k], mp[y + k], g[k], g[k] * (k - r)
        for x in range(wide):
            z[x] += f * zr[x]
            m[x] += f * mr[x]
            my[x] += fk * mr[x]
    for x in range(cols):
        to[x] = 0.0
        w[x] = 0.0
        wx[x] = 0.0
        wy[x] = 0.0
    for k in range(taps):
        zk, mk, yk, f, fk = z[k:], m[k:], my[k:], g[k], g[k] * (k - r)
        for x in range(cols):
            to[x] += f * zk[x]
            w[x] += f * mk[x]
        for x in range(cols):
            wx[x] += fk * mk[x]
            wy[x] += f * yk[x]
    for x in range(cols):
        moved = to[x] - a[x] * wx[x] - b[x] * wy[x]
        to[x] = (moved if moved == moved else to[x]) / w[x]


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
