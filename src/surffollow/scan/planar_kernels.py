"""Kernels of the conditional planar filter (paper §2.1)."""

from __future__ import annotations

import math
from typing import Any

from surffollow.scan.image_kernels import gauss_row, moments_row
from surffollow.shm.jit import jit_arrays

NO_DATA, ROUGH, PLANAR = 0, 1, 2
PLANAR_STRENGTH = 0.5  # labelled planar from here


@jit_arrays
def prepare_rows(q: Any, middle: Any, r: Any, first: Any, last: Any, zp: Any, mp: Any) -> None:
    """Image minus `middle` and its mask into padded arrays; q is finite where valid, else NaN.

    Parameters
    ----------
    q : (rows, cols) float64  disparities; NaN invalid
    middle : float            subtracted from each
    r : int                   half width of the window
    first, last : int         rows first … last - 1
    zp, mp : (rows + 2r, cols + 2r) float64  out: image, 0 where invalid; 1 valid, 0 invalid
    """
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
    """Depths k / (disparity + offset) and labels of the result; NaN where the input had no data.

    Parameters
    ----------
    mp : (rows + 2r, cols + 2r) float64  1 valid, 0 invalid
    middle : float                 added to each disparity
    k : float                      depth times disparity
    offset : float                 added to each disparity before the division
    r : int                        half width of the window
    first, last : int              rows first … last - 1
    out : (2, rows, cols) float64  filtered disparities less `middle`, planar strength; updated
    dev : (4, rows, cols) float64  deviations, of which the first are updated
    depth : (rows, cols) float64 [m]  out
    label : (rows, cols) uint8     out: NO_DATA, ROUGH, PLANAR
    """
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
