"""Median and Gaussian kernels over images with holes."""

from __future__ import annotations

from typing import Any

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
    """`gauss_row` for rows first … last - 1 of out (rows, cols).

    Parameters
    ----------
    zp : (rows + 2r, cols + 2r) float64  padded image
    weights : (2r + 1,) float64  of one direction, sum 1
    first, last : int
    s : (cols + 2r,) float64     scratch
    out : (rows, cols) float64
    """
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
