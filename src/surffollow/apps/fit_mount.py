"""Fit where a sensor sits on the tool to moves over a flat plate, by least squares with covariance.

A distance r puts the point R·(p + r·b) + t on the plate n·x = d, where R and t are the tool's attitude and
position, p the sensor's place and b its beam in the tool's frame. Unknown are p (3), b (2), n (2) and d.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
from numpy.typing import NDArray

from surffollow.errors import ConfigError
from surffollow.hw.driver import Mount

FEWEST = 24
NORM_TOLERANCE = 0.01  # of a unit quaternion that was written with three digits
MAX_POSITION_M, MAX_ANGLE_RAD = 2e-3, math.radians(1.0)  # greatest uncertainty of an identified mount


class MountFit(msgspec.Struct, frozen=True):
    """A mount and how well it is known.

    Attributes
    ----------
    mount : tool from sensor, x y z [m] and unit quaternion; the roll about the beam is the smallest possible
    covariance : (5, 5) of x, y, z [m] and of the beam's two angles about the tool's x and y [rad]
    plate : normal (3) and distance d [m] of the plate
    scatter_m : of the distances about the fit [m]
    """

    mount: Mount
    covariance: tuple[tuple[float, ...], ...]
    plate: tuple[float, float, float, float]
    scatter_m: float


def beam_of(a: float, b: float) -> NDArray[np.float64]:
    """The beam −z turned by the angle a about x, then b about y [rad]."""
    return np.array([-math.cos(a) * math.sin(b), math.sin(a), -math.cos(a) * math.cos(b)])


def matrices(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3, 3) rotations of (n, 4) unit quaternions x y z w."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(quaternions).as_matrix())


def _plate(u: float, v: float) -> NDArray[np.float64]:
    return np.array([u, v, 1.0]) / math.sqrt(1.0 + u * u + v * v)


def fit_mount(poses: NDArray[np.float64], range_m: NDArray[np.float64]) -> MountFit:
    """Fit a mount.

    Parameters
    ----------
    poses : (n, 7) tool poses, x y z [m] and unit quaternions
    range_m : (n,) distances [m]; not finite: left out

    Raises
    ------
    ConfigError
        too few readings, no unit quaternion, or moves that do not determine one of the unknowns
    """
    from scipy.optimize import least_squares

    known = np.isfinite(range_m) & np.isfinite(poses).all(axis=1)
    t, seen = poses[known, :3], range_m[known]
    if len(seen) < FEWEST:
        raise ConfigError(f"{len(seen)} readings over the plate are too few; take at least {FEWEST}")
    norms = np.linalg.norm(poses[:, 3:], axis=1)
    wrong = np.flatnonzero(known & ~(np.abs(norms - 1.0) < NORM_TOLERANCE))
    if len(wrong):
        raise ConfigError(
            f"move {wrong[0] + 1}: the quaternion qx qy qz qw has the norm {norms[wrong[0]]:.3g}, "
            "expected 1; a level tool has 0 0 0 1"
        )
    turns = matrices(poses[known, 3:])
    # about their middle: far from the origin, slopes and height of the plate could not be separated
    middle = t.mean(axis=0)
    t = t - middle

    def expected(x: NDArray[np.float64]) -> NDArray[np.float64]:
        n = _plate(x[5], x[6])
        down = turns @ beam_of(x[3], x[4]) @ n
        return np.asarray((x[7] - (t + turns @ x[:3]) @ n) / down)

    start = np.zeros(8)
    start[7] = float(np.mean(t[:, 2] - seen))
    found = least_squares(lambda x: expected(x) - seen, start, x_scale="jac", method="lm", max_nfev=2000)
    free = len(seen) - 8
    scatter_m = float(np.sqrt(2.0 * found.cost / max(free, 1)))
    normal = found.jac.T @ found.jac
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    values, vectors = np.linalg.eigh(normal * scale[:, None] * scale[None, :])
    if values[0] < 1e-12:
        weak = int(np.argmax(np.abs(vectors[:, 0])))
        raise ConfigError(f"the moves do not determine {_NAMES[weak]}; {_REMEDY}")
    covariance = scatter_m**2 * np.linalg.inv(normal)
    sigma = np.sqrt(np.diag(covariance))
    off = np.abs(found.fun)
    worst = int(np.argmax(off))
    stray = (
        f"; or leave out stray readings: they scatter by {1e3 * scatter_m:.3g} mm about the fit, move "
        f"{np.flatnonzero(known)[worst] + 1} is {1e3 * off[worst]:.3g} mm off"
    )
    for k, most in enumerate((*[MAX_POSITION_M] * 3, *[MAX_ANGLE_RAD] * 2)):
        if not sigma[k] < most:
            unit = f"{1e3 * sigma[k]:.3g} mm" if k < 3 else f"{math.degrees(sigma[k]):.3g} deg"
            raise ConfigError(
                f"the moves do not determine {_NAMES[k]}: it is uncertain by {unit}; {_REMEDY}{stray}"
            )
    x, y, z, a, b = found.x[:5].tolist()
    n = _plate(found.x[5], found.x[6])
    return MountFit(
        (x, y, z, *_shortest_turn(beam_of(a, b))),
        tuple(tuple(row) for row in covariance[:5, :5].tolist()),
        (float(n[0]), float(n[1]), float(n[2]), float(found.x[7] + n @ middle)),
        scatter_m,
    )


_NAMES = (
    *(
        "the sensor's x",
        "the sensor's y",
        "the sensor's z",
        "the beam's angle about x",
        "the beam's angle about y",
    ),
    *("the plate's slope in x", "the plate's slope in y", "the plate's height"),
)
_REMEDY = (
    "tilt the tool by 15 deg and more about x and about y, both ways, at two heights or more, and at places "
    "of the plate some 0.2 m apart along x and y"
)


def _shortest_turn(beam: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """The quaternion that turns −z into the beam the shortest way."""
    axis = np.cross([0.0, 0.0, -1.0], beam)
    w = 1.0 - float(beam[2])
    q = np.array([*axis, w])
    x, y, z, w = (q / np.linalg.norm(q)).tolist()
    return x, y, z, w
