"""Lay a planar path on the envelope: heights, normals (eqs 5-7), attitude of the body (paper §3.2-3.3)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.errors import ScanInputError
from surffollow.scan.attitude_angles import body_axes, normals_of, wrist_angles
from surffollow.scan.attitude_kernels import MAX_POINTS, settle_path
from surffollow.scan.bands import in_bands
from surffollow.scan.body import body_points
from surffollow.scan.cells_beneath import any_beneath
from surffollow.scan.checks import Floats, positive
from surffollow.scan.envelope import Envelope
from surffollow.scan.grid import FILLED, TerrainGrid
from surffollow.scan.limits import WristLimits
from surffollow.scan.path import (
    FILLED_BENEATH,
    LIFTED,
    UNKNOWN_BENEATH,
    WRIST_LIMIT,
    ScanPath,
)
from surffollow.scan.surface_lookup import sample_surface

STEP_RAD = math.radians(0.5)  # the paper's small correction
LIFTED_M = 1e-4  # lifts below this are not flagged


def sample_terrain(
    path: ScanPath, envelope: Envelope | TerrainGrid, *, span_m: float | None = None
) -> ScanPath:
    """Give a planar path the envelope's heights and unit normals.

    Parameters
    ----------
    path : ScanPath
        x and y are used
    envelope : Envelope or TerrainGrid
    span_m : float [m]
        slopes are taken over ± this; None: one cell

    Returns
    -------
    ScanPath
        z and clearance NaN and UNKNOWN_BENEATH set where the envelope is unknown

    Notes
    -----
    z = f_env (5), n = γ (-f_x, -f_y, 1) (6), γ = 1 / √(f_x² + f_y² + 1) (7).

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import ScanPath, TerrainGrid, sample_terrain
    >>> slope = TerrainGrid.of(np.tile(0.1 * np.arange(10), (10, 1)), grid_m=0.1)     # 45° along x
    >>> path = ScanPath.planar(np.array([[0.35, 0.5], [0.55, 0.5]]), np.zeros(2, np.int32))
    >>> path = sample_terrain(path, slope)
    >>> np.round(path.position_m[:, 2], 3), np.round(path.normal[0], 3) + 0.0
    (array([0.3, 0.5]), array([-0.707,  0.   ,  0.707]))
    """
    grid = _grid(envelope)
    span = grid.grid_m if span_m is None else positive("span_m", span_m)
    uv = _cells(path.position_m, grid)
    out = np.empty((len(path), 3))
    sample_surface(grid.heights_m, max(span / grid.grid_m, 1e-3), uv, out)
    slope = np.where(np.isfinite(out[:, 1:]), out[:, 1:], 0.0) / grid.grid_m
    normal = np.column_stack([-slope, np.ones(len(path))])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    position = np.column_stack([path.position_m[:, :2], out[:, 0]])
    unknown = np.isnan(out[:, 0])
    if isinstance(envelope, Envelope):
        unknown |= _at(envelope.unknown_beneath, uv, outside=True)
    filled = _at(grid.cells == FILLED, uv, outside=False)
    made = path.changed(position_m=position, normal=normal, lift_m=np.zeros(len(path)))
    return made.with_flag(UNKNOWN_BENEATH, unknown).with_flag(FILLED_BENEATH, filled)


def advanced_terrain_following(
    path: ScanPath,
    body_points_m: ArrayLike,
    envelope: Envelope | TerrainGrid,
    wrist_limits_rad: Any,
    *,
    step_rad: float = STEP_RAD,
) -> ScanPath:
    """Turn and lift the body so that no control point is below the envelope.

    Parameters
    ----------
    path : ScanPath
        of `sample_terrain`
    body_points_m : (m, 3) float [m]
        control points in the body's frame (`body`)
    envelope : Envelope or TerrainGrid
        already holds the scanning gap; it is not added again
    wrist_limits_rad : WristLimits, one limit for all, or ((pitch_min, pitch_max), (roll_min, roll_max))
    step_rad : float
        first correction; the paper's ½°

    Returns
    -------
    ScanPath
        flags WRIST_LIMIT (the normal was beyond the limits, or the body rests at one) and LIFTED

    Raises
    ------
    ScanInputError

    Notes
    -----
    Paper §3.3. A sample whose body is clear keeps its attitude. The step is halved to 1/16 of itself near
    the equilibrium, so that the lift is close to the least one of any attitude. The lift comes last: with any
    attitude, every control point is at or above the interpolated envelope.

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import ScanPath, TerrainGrid, advanced_terrain_following, disc, sample_terrain
    >>> ground_m = np.zeros((20, 20))
    >>> ground_m[:, 10] = 0.02                                # a ridge
    >>> envelope = TerrainGrid.of(ground_m, grid_m=0.05)
    >>> path = ScanPath.planar(np.array([[0.2, 0.5], [0.45, 0.5]]), np.zeros(2, np.int32))
    >>> path = advanced_terrain_following(sample_terrain(path, envelope), disc(0.1), envelope, 0.3)
    >>> np.round(path.lift_m, 3)                              # on flat ground, and beside the ridge
    array([0.   , 0.008])
    """
    return _follow(path, body_points_m, envelope, wrist_limits_rad, positive("step_rad", step_rad, "rad"))


def reactionary(
    path: ScanPath, body_points_m: ArrayLike, envelope: Envelope | TerrainGrid, wrist_limits_rad: Any = None
) -> ScanPath:
    """The baseline: lift the body until it is clear, with its attitude unchanged but for the wrist's limits.

    Parameters and result as `advanced_terrain_following`; without limits any attitude is kept.

    Parameters
    ----------
    path : ScanPath
        as `advanced_terrain_following`
    body_points_m : (m, 3) float [m]
        control points of the body
    envelope : Envelope or TerrainGrid
        surface that no control point may be below
    wrist_limits_rad : WristLimits or what makes them, optional
        None: any attitude is kept

    Returns
    -------
    ScanPath
        the lifted path

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import ScanPath, TerrainGrid, disc, reactionary, sample_terrain
    >>> ground_m = np.zeros((20, 20))
    >>> ground_m[:, 10] = 0.02                                # a ridge
    >>> envelope = TerrainGrid.of(ground_m, grid_m=0.05)
    >>> path = ScanPath.planar(np.array([[0.2, 0.5], [0.45, 0.5]]), np.zeros(2, np.int32))
    >>> path = reactionary(sample_terrain(path, envelope), disc(0.1), envelope)
    >>> np.round(path.lift_m, 3)                              # on flat ground, and beside the ridge
    array([0.  , 0.01])
    """
    limits = WristLimits.symmetric(math.radians(89.0)) if wrist_limits_rad is None else wrist_limits_rad
    return _follow(path, body_points_m, envelope, limits, 0.0)


def _follow(
    path: ScanPath, body_points_m: ArrayLike, envelope: Envelope | TerrainGrid, wrist: Any, step_rad: float
) -> ScanPath:
    body, limits, grid = body_points(body_points_m), WristLimits.of(wrist), _grid(envelope)
    if len(body) > MAX_POINTS:
        raise ScanInputError(f"the body has {len(body)} control points; at most {MAX_POINTS}")
    n = len(path)
    normal, clamped = limits.clamp(path.normal, path.azimuth_rad)
    angles = wrist_angles(normal, path.azimuth_rad)
    before = angles.copy()
    depth = np.empty(n)
    uv = _cells(path.position_m, grid)
    tip_z = np.ascontiguousarray(path.position_m[:, 2])
    box = limits.as_array()

    def work(first: int, last: int) -> None:
        settle_path(
            grid.heights_m,
            1.0 / grid.grid_m,
            uv,
            tip_z,
            path.azimuth_rad,
            angles,
            body,
            box,
            step_rad,
            first,
            last,
            np.empty((5, len(body))),
            depth,
        )

    in_bands(n, work)
    turned = np.any(angles != before, axis=1)
    attitude = np.where(turned[:, None], normals_of(angles, path.azimuth_rad), normal)
    lift = np.where(np.isfinite(depth), np.maximum(depth, 0.0), 0.0)
    position = path.position_m.copy()
    position[:, 2] += lift
    at_limit = np.any((angles <= box[[0, 2]] + 1e-12) | (angles >= box[[1, 3]] - 1e-12), axis=1)
    made = path.changed(position_m=position, normal=attitude, lift_m=path.lift_m + lift)
    made = made.with_flag(WRIST_LIMIT, clamped | (at_limit & turned))
    made = made.with_flag(LIFTED, made.lift_m > LIFTED_M)
    made = _flag_beneath(made, body, grid, FILLED_BENEATH, grid.cells == FILLED, outside=False)
    if isinstance(envelope, Envelope):
        made = _flag_beneath(made, body, grid, UNKNOWN_BENEATH, envelope.unknown_beneath, outside=True)
    return made


def _flag_beneath(
    path: ScanPath, body: Floats, grid: TerrainGrid, flag: int, cells: NDArray[np.bool_], *, outside: bool
) -> ScanPath:
    """The path with a flag also where the body covers one of these cells, or has a point outside."""
    axes, at = body_axes(path.normal, path.azimuth_rad), path.position_m.copy()
    at[:, :2] = _cells(at, grid)
    found = path.has(flag) | any_beneath(cells, grid.grid_m, body, at, path.quaternion)
    for point in body:
        found |= _at(cells, _cells(path.position_m + axes @ point, grid), outside=outside)
    return path.with_flag(flag, found)


def _grid(envelope: Envelope | TerrainGrid) -> TerrainGrid:
    return envelope.grid if isinstance(envelope, Envelope) else envelope


def _cells(position_m: Floats, grid: TerrainGrid) -> Floats:
    """(n, 2) column and row, cell centres at whole numbers."""
    return np.ascontiguousarray((position_m[:, :2] - np.array(grid.origin_m)) / grid.grid_m - 0.5)


def _at(mask: NDArray[np.bool_], uv: Floats, *, outside: bool) -> NDArray[np.bool_]:
    """Value of a mask at the cell of each point."""
    rows, cols = mask.shape
    with np.errstate(invalid="ignore"):
        at = np.floor(np.nan_to_num(uv, nan=-9.0) + 0.5).astype(np.int64)
    inside = (at[:, 0] >= 0) & (at[:, 0] < cols) & (at[:, 1] >= 0) & (at[:, 1] < rows)
    out = np.full(len(uv), outside)
    out[inside] = mask[at[inside, 1], at[inside, 0]]
    return out
