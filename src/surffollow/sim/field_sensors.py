"""Sensors at the tip in the simulated field: laser, accelerometer, detector of a buried target."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.shm.jit import jit
from surffollow.sim.stereo_camera import cast
from surffollow.sim.surfaces import HeightField

Floats = NDArray[np.float64]
LASER_ABOVE_M = 0.1  # the beam starts this far above the underside, so that contact gives a range below 0
LASER_REACH_M = 1.0
TARGET_SIZE_M = 0.1  # of the detector's response to the target


@jit
def laser_rows(
    z: Any, frame: Any, tip: Any, normal: Any, above: Any, reach: Any, o: Any, d: Any, out: Any
) -> None:
    """Range from each tip along minus its normal to the ground, less `above`; NaN out of reach.

    Parameters
    ----------
    z : (ny, nx) float64 [m]      heights
    frame : (3,) float64 [m]      x0, y0 and grid of the field
    tip, normal : (n, 3) float64  places [m], and unit normals of the tool
    above, reach : float [m]      the rays begin that far along the normal; greatest length
    o, d : (3,) float64           scratch
    out : (n,) float64 [m]
    """
    for k in range(tip.shape[0]):
        for i in range(3):
            o[i] = tip[k, i] + above * normal[k, i]
            d[i] = -normal[k, i]
        out[k] = cast(z, frame[0], frame[1], frame[2], o, d, 0.0, reach, 0.005) - above


def laser_range(ground: HeightField, tip_m: Floats, normal: Floats, reach_m: float = LASER_REACH_M) -> Floats:
    """(n,) true range [m] from the tip's middle, the point of greatest sensitivity, along the body's -z.

    NaN beyond `reach_m`, which counts from `LASER_ABOVE_M` above the tip.
    """
    out = np.empty(len(tip_m))
    frame = np.array([ground.x0_m, ground.y0_m, ground.grid_m])
    laser_rows(
        ground.heights_m,
        frame,
        np.ascontiguousarray(tip_m),
        np.ascontiguousarray(normal),
        LASER_ABOVE_M,
        reach_m,
        np.empty(3),
        np.empty(3),
        out,
    )
    return out


def accelerometer(
    tip_m: Floats, rate_hz: float, rng: np.random.Generator, sigma_mps2: float = 0.02
) -> Floats:
    """(n, 3) acceleration of the tip in the ground frame, without gravity, with white noise [m/s²].

    Parameters
    ----------
    tip_m : (n, 3) float64 [m]  positions, ground frame
    rate_hz : float             samples per second
    rng : Generator             of the noise
    sigma_mps2 : float          standard deviation of the noise
    """
    true = np.gradient(np.gradient(tip_m, axis=0), axis=0) * rate_hz**2
    return np.asarray(true + rng.normal(0.0, sigma_mps2, true.shape))


def target_signal(
    tip_m: Floats,
    target_m: Floats,
    rng: np.random.Generator,
    *,
    size_m: float = TARGET_SIZE_M,
    sigma: float = 0.01,
) -> Floats:
    """(n,) response of a detector to a buried target: 1 at it, falling with the sixth power of distance.

    Parameters
    ----------
    tip_m : (n, 3) float64 [m]   positions
    target_m : (3,) float64 [m]  the target
    rng : Generator              of the noise
    size_m : float [m]           distance scale of the response
    sigma : float                standard deviation of the noise

    Notes
    -----
    (1 + (r / size)²)⁻³, as a coil's response to a small conductor, with white noise.
    """
    square = ((tip_m - target_m) ** 2).sum(axis=1)
    return np.asarray((1.0 + square / size_m**2) ** -3 + rng.normal(0.0, sigma, len(tip_m)))


def steepest(ground: HeightField) -> float:
    """Steepest slope between neighbouring nodes of a field [rad]."""
    dz = max(float(np.abs(np.diff(ground.heights_m, axis=k)).max()) for k in (0, 1))
    return math.atan(dz / ground.grid_m)
