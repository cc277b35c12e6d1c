"""How far an image is from a plane around each pixel (paper §2.1).

The window of a pixel is fitted with a least-squares plane z = c + a dj + b di over its valid pixels; the
deviation is the mean absolute residual. `exact` sums the residuals; `fast` takes the root mean square of
them from window sums alone, times √(2/π), which is the same where residuals are normally distributed.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.errors import ScanInputError
from surffollow.scan.bands import in_bands
from surffollow.scan.checks import Floats, real_array
from surffollow.shm.jit import jit_arrays

MAD_PER_RMS = math.sqrt(2.0 / math.pi)  # of a normal distribution
MODES = ("exact", "fast")
SCRATCH_ROWS = 17


@jit_arrays
def deviation_rows(zp: Any, mp: Any, r: Any, first: Any, last: Any, exact: Any, s: Any, dev: Any) -> None:
    """Deviations of rows first … last - 1.

    Parameters
    ----------
    zp, mp : (rows + 2r, cols + 2r) float64
        image padded by r, 0 where invalid; 1 valid, 0 invalid
    r : int
        half width of the window
    exact : bool
        mean absolute residual, else RMS √(2/π)
    s : (SCRATCH_ROWS, cols + 2r) float64
        scratch
    dev : (4, rows, cols) float64
        out: deviation, a (per column), b (per row), c; NaN where
        the valid pixels of the window do not span a plane
    """
    wide = zp.shape[1]
    cols = wide - 2 * r
    for y in range(first, last):
        for k in range(SCRATCH_ROWS):
            row = s[k]
            for x in range(wide):
                row[x] = 0.0
        v0, v1, v2, z0, z1, zz = s[0], s[1], s[2], s[3], s[4], s[5]
        for di in range(2 * r + 1):
            zr, mr = zp[y + di], mp[y + di]
            f = float(di - r)
            for x in range(wide):
                v0[x] += mr[x]
                v1[x] += f * mr[x]
                v2[x] += f * f * mr[x]
                z0[x] += zr[x]
                z1[x] += f * zr[x]
                zz[x] += zr[x] * zr[x]
        n, sx, sy, sxx, sxy = s[6], s[7], s[8], s[9], s[10]
        syy, sz, sxz, syz, szz = s[11], s[12], s[13], s[14], s[15]
        for dj in range(2 * r + 1):
            g = float(dj - r)
            a0, a1, a2, a3, a4, a5 = v0[dj:], v1[dj:], v2[dj:], z0[dj:], z1[dj:], zz[dj:]
            for x in range(cols):
                n[x] += a0[x]
                sx[x] += g * a0[x]
                sxx[x] += g * g * a0[x]
                sy[x] += a1[x]
                sxy[x] += g * a1[x]
            for x in range(cols):
                syy[x] += a2[x]
                sz[x] += a3[x]
                sxz[x] += g * a3[x]
                syz[x] += a4[x]
                szz[x] += a5[x]
        d, a, b, c = dev[0, y], dev[1, y], dev[2, y], dev[3, y]
        for x in range(cols):
            m = n[x]
            cxx = sxx[x] - sx[x] * sx[x] / m
            cxy = sxy[x] - sx[x] * sy[x] / m
            cyy = syy[x] - sy[x] * sy[x] / m
            cxz = sxz[x] - sx[x] * sz[x] / m
            cyz = syz[x] - sy[x] * sz[x] / m
            det = cxx * cyy - cxy * cxy
            det = det if det > 1e-9 * m * m else math.nan
            a[x] = (cxz * cyy - cyz * cxy) / det
            b[x] = (cyz * cxx - cxz * cxy) / det
            c[x] = (sz[x] - a[x] * sx[x] - b[x] * sy[x]) / m
            left = szz[x] - sz[x] * sz[x] / m - a[x] * cxz - b[x] * cyz
            d[x] = math.sqrt(max(left, 0.0) / m) * MAD_PER_RMS if left == left else math.nan
        if exact:
            total, plane = s[16], s[0]
            for di in range(2 * r + 1):
                f = float(di - r)
                for x in range(cols):
                    plane[x] = c[x] + b[x] * f
                for dj in range(2 * r + 1):
                    g = float(dj - r)
                    zr, mr = zp[y + di, dj:], mp[y + di, dj:]
                    for x in range(cols):
                        total[x] += mr[x] * abs(zr[x] - (plane[x] + a[x] * g))
            for x in range(cols):
                d[x] = total[x] / n[x]


def padded(image: Floats, r: int) -> tuple[Floats, Floats, float]:
    """Image minus its median (0 where invalid) and mask, both padded by r, and that median."""
    valid = np.isfinite(image)
    middle = float(np.median(image[valid])) if valid.any() else 0.0
    rows, cols = image.shape
    zp, mp = np.zeros((rows + 2 * r, cols + 2 * r)), np.zeros((rows + 2 * r, cols + 2 * r))
    zp[r : r + rows, r : r + cols] = np.where(valid, image - middle, 0.0)
    mp[r : r + rows, r : r + cols] = valid
    return zp, mp, middle


def planar_deviation(
    image: ArrayLike, *, window: int = 9, mode: str = "exact"
) -> tuple[Floats, NDArray[np.float64]]:
    """Mean absolute deviation of each pixel's window from its least-squares plane.

    Parameters
    ----------
    image : (rows, cols) float
        NaN invalid; any unit (disparities keep a plane a plane)
    window : int
        odd side of the window [px], ≥ 3
    mode : str
        "exact", or "fast" (RMS × √(2/π))

    Returns
    -------
    deviation : (rows, cols) float64
        unit of the image; NaN at invalid pixels, and where the valid
        pixels of the window do not span a plane
    planes : (3, rows, cols) float64
        a (per column), b (per row), c (at the pixel)

    Raises
    ------
    ScanInputError

    Notes
    -----
    Paper §2.1. Cost: O(window) per pixel fast, O(window²) exact.

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import planar_deviation
    >>> ramp_px = np.tile(np.arange(12.0), (12, 1))           # a plane, in disparities
    >>> deviation_px, planes = planar_deviation(ramp_px, window=5)
    >>> bool(deviation_px.max() < 1e-9), np.round(planes[:, 6, 6], 6) + 0.0
    (True, array([1., 0., 6.]))
    """
    z = real_array("image", image, (None, None))
    r = half_width(window)
    if mode not in MODES:
        raise ScanInputError(f"mode is '{mode}'; expected one of {', '.join(MODES)}")
    if z.size == 0:
        raise ScanInputError(f"the image has shape {z.shape}; it has no pixel")
    zp, mp, middle = padded(z, r)
    made = np.empty((4, *z.shape))
    deviations(zp, mp, r, mode, made)
    made[3] += middle
    made[0][~np.isfinite(z)] = np.nan
    return made[0], made[1:]


def deviations(zp: Floats, mp: Floats, r: int, mode: str, out: Floats) -> None:
    """`deviation_rows` over all rows, in bands.

    Parameters
    ----------
    zp, mp : (rows + 2r, cols + 2r) float64  from `padded`: image, 0 where invalid; 1 valid, 0 invalid
    r : int                        half width of the window
    mode : str                     "exact" or "fast"
    out : (4, rows, cols) float64  deviation, a (per column), b (per row), c
    """

    def work(first: int, last: int) -> None:
        scratch = np.empty((SCRATCH_ROWS, zp.shape[1]))
        deviation_rows(zp, mp, r, first, last, mode == "exact", scratch, out)

    in_bands(out.shape[1], work)


def half_width(window: int) -> int:
    """Half of an odd window, or ScanInputError."""
    if window != int(window) or window < 3 or window % 2 == 0 or window > 63:
        raise ScanInputError(f"window is {window} px; expected an odd number from 3 to 63")
    return int(window) // 2
