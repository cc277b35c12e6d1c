"""Symmetric positive definite systems with five diagonals: LDLᵀ factors and their solution, in place."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from surffollow.shm.jit import jit


@jit
def factorise(band: NDArray[Any]) -> None:
    """LDLᵀ in place.

    Parameters
    ----------
    band : (3, n) float64, rows: diagonal, first and second subdiagonal; receives D and L
    """
    n = band.shape[1]
    for k in range(n):
        d = band[0, k]
        l1, l2 = band[1, k] / d, band[2, k] / d
        if k + 1 < n:
            band[0, k + 1] -= l1 * band[1, k]
            if k + 2 < n:
                band[1, k + 1] -= l1 * band[2, k]
                band[0, k + 2] -= l2 * band[2, k]
        band[1, k], band[2, k] = l1, l2


@jit
def solve_factors(band: NDArray[Any], b: NDArray[Any]) -> None:
    """Solve with the factors of `factorise`, in place.

    Parameters
    ----------
    band : (3, n) float64
    b : (n,) float64, right-hand side; receives the solution
    """
    n = b.shape[0]
    for k in range(n - 1):
        b[k + 1] -= band[1, k] * b[k]
        if k + 2 < n:
            b[k + 2] -= band[2, k] * b[k]
    for k in range(n):
        b[k] /= band[0, k]
    for k in range(n - 2, -1, -1):
        b[k] -= band[1, k] * b[k + 1]
        if k + 2 < n:
            b[k] -= band[2, k] * b[k + 2]
