"""The best that any method could do: an offline quadratic programme over the whole path.

min ½·Σ(z − desired)² under the plant's speed and acceleration limits, everything known beforehand. The
figure returned is the value of the *dual* at the last iterate: a lower bound even if the solver stopped
early. The path is thinned in time; a thinned path of a feasible run is feasible in the thinned programme
(its differences are means of the run's), so the bound stands.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.benchmark.pentadiagonal import factorise, solve_factors
from surffollow.shm.jit import jit

TOLERANCE = 1e-4  # relative duality gap
FLOOR_M2 = 1e-12  # a mean square below (1 µm)² is as good as none
START_SHARE = 1e-2
MAX_ITERATIONS = 100
MAX_POINTS = 80_000  # coarser, the edges of rough ground are lost: 15 ms apart overestimates by 5 %


@jit
def _differences(z: NDArray[Any], d1: NDArray[Any], d2: NDArray[Any]) -> None:
    """First and second differences; d1 has n − 1 entries, d2 n − 2 (entry k belongs to point k + 1)."""
    for k in range(z.shape[0] - 1):
        d1[k] = z[k + 1] - z[k]
    for k in range(z.shape[0] - 2):
        d2[k] = d1[k + 1] - d1[k]


@jit
def _adjoint(y1: NDArray[Any], y2: NDArray[Any], out: NDArray[Any]) -> None:
    """out = D1ᵀ·y1 + D2ᵀ·y2."""
    n = out.shape[0]
    for k in range(n):
        out[k] = 0.0
    for k in range(n - 1):
        out[k] -= y1[k]
        out[k + 1] += y1[k]
    for k in range(n - 2):
        out[k] += y2[k]
        out[k + 1] -= 2.0 * y2[k]
        out[k + 2] += y2[k]


@jit
def _factor(w1: NDArray[Any], w2: NDArray[Any], band: NDArray[Any]) -> None:
    """LDLᵀ of I + D1ᵀ·W1·D1 + D2ᵀ·W2·D2 in place; band rows: diagonal, first, second subdiagonal."""
    n = band.shape[1]
    for k in range(n):
        band[0, k] = 1.0
        band[1, k] = 0.0
        band[2, k] = 0.0
    for k in range(n - 1):
        band[0, k] += w1[k]
        band[0, k + 1] += w1[k]
        band[1, k] -= w1[k]
    for k in range(n - 2):
        band[0, k] += w2[k]
        band[0, k + 1] += 4.0 * w2[k]
        band[0, k + 2] += w2[k]
        band[1, k] -= 2.0 * w2[k]
        band[1, k + 1] -= 2.0 * w2[k]
        band[2, k] += w2[k]
    factorise(band)


@jit
def _dual(r: NDArray[Any], lam: NDArray[Any], h: NDArray[Any], y: NDArray[Any], d: NDArray[Any]) -> float:
    """Value of the dual: λᵀ(G·r − h) − ½·|Gᵀλ|²."""
    n = r.shape[0]
    for k in range(n):
        y[0, k] = lam[0, k] - lam[1, k]
        y[1, k] = lam[2, k] - lam[3, k]
    _adjoint(y[0, : n - 1], y[1, : n - 2], d[0])
    total = 0.0
    for k in range(n):
        total -= 0.5 * d[0, k] * d[0, k]
    _differences(r, d[0], d[1])
    for k in range(n - 1):
        total += y[0, k] * d[0, k] - (lam[0, k] + lam[1, k]) * h[0]
    for k in range(n - 2):
        total += y[1, k] * d[1, k] - (lam[2, k] + lam[3, k]) * h[1]
    return total


@jit
def bounded_path(r: NDArray[Any], d1_max: float, d2_max: float, z: NDArray[Any]) -> tuple[float, int]:
    """Path nearest to r (least squares) with bounded first and second differences.

    Mehrotra's predictor-corrector; each iteration factors one pentadiagonal matrix.

    Parameters
    ----------
    r : (n,) float64, n ≥ 3
    d1_max, d2_max : float64, bounds of |z[k+1] − z[k]| and of |z[k+2] − 2z[k+1] + z[k]|
    z : (n,) float64, receives the path

    Returns
    -------
    (float64, int64)
        a lower bound of ½·Σ(z − r)², and the iterations used
    """
    n = r.shape[0]
    h = np.array([d1_max, d2_max])
    sign = np.array([1.0, -1.0, 1.0, -1.0])
    rows = np.array([n - 1, n - 1, n - 2, n - 2])
    lam, s, rp, g = np.zeros((4, n)), np.ones((4, n)), np.zeros((4, n)), np.zeros((4, n))
    dlam, ds, rc = np.zeros((4, n)), np.zeros((4, n)), np.zeros((4, n))
    d, y, w = np.zeros((2, n)), np.zeros((2, n)), np.zeros((2, n))
    band, rd, dz = np.zeros((3, n)), np.zeros(n), np.zeros(n)
    m = 4.0 * n - 6.0
    for k in range(n):
        z[k] = r[k]
    _differences(z, d[0], d[1])
    # every product λ·s starts at the same share of the signal's power: central, and of the answer's order
    mean = r.mean()
    start = 0.0
    for k in range(n):
        start += START_SHARE * (r[k] - mean) ** 2 / n
    start = max(start, FLOOR_M2)
    for c in range(4):
        for k in range(rows[c]):
            slack = h[c // 2] - sign[c] * d[c // 2, k]
            s[c, k] = max(slack, h[c // 2])
            lam[c, k] = start / s[c, k]
    best = 0.0
    for iteration in range(MAX_ITERATIONS):
        _differences(z, d[0], d[1])
        mu = 0.0
        primal = 0.0
        infeasible = 0.0
        for c in range(4):
            for k in range(rows[c]):
                rp[c, k] = sign[c] * d[c // 2, k] + s[c, k] - h[c // 2]
                infeasible = max(infeasible, abs(rp[c, k]) / h[c // 2])
                mu += s[c, k] * lam[c, k]
        mu /= m
        for k in range(n):
            y[0, k] = lam[0, k] - lam[1, k]
            y[1, k] = lam[2, k] - lam[3, k]
            primal += 0.5 * (z[k] - r[k]) ** 2
        _adjoint(y[0, : n - 1], y[1, : n - 2], rd)
        for k in range(n):
            rd[k] += z[k] - r[k]
        value = _dual(r, lam, h, y, d)
        best = max(best, value)
        if infeasible < 1e-3 and primal - best < TOLERANCE * primal + 0.5 * FLOOR_M2 * n:
            return best, iteration
        for k in range(n):
            w[0, k] = lam[0, k] / s[0, k] + lam[1, k] / s[1, k] if k < n - 1 else 0.0
            w[1, k] = lam[2, k] / s[2, k] + lam[3, k] / s[3, k] if k < n - 2 else 0.0
        _factor(w[0], w[1], band)
        sigma_mu = 0.0
        for corrector in range(2):
            for c in range(4):
                for k in range(rows[c]):
                    rc[c, k] = s[c, k] * lam[c, k] - sigma_mu
                    if corrector == 1:
                        rc[c, k] += ds[c, k] * dlam[c, k]
                    g[c, k] = sign[c] * (lam[c, k] * rp[c, k] - rc[c, k]) / s[c, k]
            for k in range(n):
                y[0, k] = g[0, k] + g[1, k]
                y[1, k] = g[2, k] + g[3, k]
            _adjoint(y[0, : n - 1], y[1, : n - 2], dz)
            for k in range(n):
                dz[k] = -rd[k] - dz[k]
            solve_factors(band, dz)
            _differences(dz, d[0], d[1])
            alpha = 1.0
            for c in range(4):
                for k in range(rows[c]):
                    gd = sign[c] * d[c // 2, k]
                    ds[c, k] = -rp[c, k] - gd
                    dlam[c, k] = (-rc[c, k] - lam[c, k] * ds[c, k]) / s[c, k]
                    if ds[c, k] < 0.0:
                        alpha = min(alpha, -s[c, k] / ds[c, k])
                    if dlam[c, k] < 0.0:
                        alpha = min(alpha, -lam[c, k] / dlam[c, k])
            if corrector == 0:
                after = 0.0
                for c in range(4):
                    for k in range(rows[c]):
                        after += (s[c, k] + alpha * ds[c, k]) * (lam[c, k] + alpha * dlam[c, k])
                sigma_mu = mu * (after / m / mu) ** 3
        alpha = min(1.0, 0.995 * alpha)
        for k in range(n):
            z[k] += alpha * dz[k]
        for c in range(4):
            for k in range(rows[c]):
                s[c, k] += alpha * ds[c, k]
                lam[c, k] += alpha * dlam[c, k]
    return best, MAX_ITERATIONS


def limit_path(
    desired_m: NDArray[np.float64], v_max_mps: float, a_max_mps2: float
) -> tuple[float, NDArray[np.float64], int]:
    """Smallest RMS error of any axis with these limits along a path known beforehand.

    Parameters
    ----------
    desired_m : (ms,) float64, where the tool should be at every millisecond of the scored part [m]
    v_max_mps, a_max_mps2 : limits of the axis

    Returns
    -------
    rms_m : lower bound of the RMS over the thinned path [m]
    path_m : (n,) the path that reaches it
    thinning : milliseconds between its points
    """
    thinning = max(1, -(-len(desired_m) // MAX_POINTS))
    r = np.ascontiguousarray(desired_m[::thinning], np.float64)
    r = r - r.mean()
    dt = thinning * 1e-3
    path = np.empty_like(r)
    bound, _ = bounded_path(r, v_max_mps * dt, a_max_mps2 * dt * dt, path)
    return float(np.sqrt(2.0 * max(bound, 0.0) / len(r))), path + desired_m[::thinning].mean(), thinning
