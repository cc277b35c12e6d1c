"""The last lift: no part of the underside nearer to any known ground cell than the gap (paper §3.3).

Between cell centres an interpolated envelope is lower than the exact one, and it is looked at beneath the
control points only. Here every known cell that the underside may be near is compared with the whole of it, at
the samples and on the straight way between two of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from surffollow.scan.attitude_angles import body_axes
from surffollow.scan.bands import in_bands
from surffollow.scan.body import body_points
from surffollow.scan.checks import Floats, positive
from surffollow.scan.clearance_kernels import TILE, distances, lifts, lifts_between, tile_tops
from surffollow.scan.following import LIFTED_M
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.path import LIFTED, ScanPath
from surffollow.scan.underside import plates

SPARE_M = 1e-9  # above the gap, against rounding
LOOK_GAPS = 3.0  # clearances are looked for up to so many gaps away
PARTS_OF_GAP = 8  # between rows the body is looked at wherever a point of it moved by a part of the gap


class Clearance:
    """Ground that a body is compared with.

    Parameters
    ----------
    heights_m : (rows, cols) float64 [m]  NaN unknown; may change, with `tops`
    tops : (⌈rows/TILE⌉, ⌈cols/TILE⌉) float64 [m] from `tile_tops`
    first_m : (x, y) [m]                  centre of heights_m[0, 0]
    grid_m : float [m]
    body_m : (m, 3) float64 [m]           control points of the body
    """

    def __init__(self, heights_m: Floats, tops: Floats, first_m: Any, grid_m: float, body_m: Floats) -> None:
        self._ground = (heights_m, tops, float(grid_m))
        self._first_m, self._grid_m = np.asarray(first_m, np.float64), float(grid_m)
        self._plates = plates(body_m)
        self._reach_m = float(np.linalg.norm(body_m, axis=1).max())

    @classmethod
    def over(cls, ground: TerrainGrid, body_m: Floats) -> Clearance:
        """Of a terrain grid."""
        tops = tops_of(ground.heights_m)
        first = np.array(ground.origin_m) + 0.5 * ground.grid_m
        return cls(ground.heights_m, tops, first, ground.grid_m, body_m)

    def _cells(self, position_m: Floats) -> Floats:
        at: Floats = np.array(position_m, np.float64, order="C")
        at[:, :2] = (at[:, :2] - self._first_m) / self._grid_m
        return at

    def lifts(self, position_m: Floats, quaternion: Floats, gap_m: float) -> Floats:
        """(n,) lift [m], at least 0, that keeps the underside the gap from the ground.

        Parameters
        ----------
        position_m : (n, 3) float64 [m]   NaN: no lift
        quaternion : (n, 4) float64
        gap_m : float [m]
        """
        at, out = self._cells(position_m), np.zeros(len(position_m))
        for p in self._plates:
            plate = (p.corners_m, p.round_m, p.level_m)

            def work(first: int, last: int, plate: Any = plate) -> None:
                lifts(*self._ground, *plate, gap_m, at, quaternion, first, last, np.empty((3, 3)), out)

            in_bands(len(at), work)
        return out

    def lifts_between(self, position_m: Floats, quaternion: Floats, gap_m: float) -> Floats:
        """(n - 1,) the same for the ways from row to row, along which both change linearly."""
        move = np.linalg.norm(np.diff(position_m, axis=0), axis=1)
        turn = np.linalg.norm(np.diff(quaternion, axis=0), axis=1)
        travel = np.nan_to_num(move + 2.0 * turn * self._reach_m)
        parts = np.ceil(travel / min(self._grid_m, gap_m / PARTS_OF_GAP) - 1e-9).astype(np.int64)
        at, out = self._cells(position_m), np.zeros(len(parts))
        for p in self._plates:
            plate = (p.corners_m, p.round_m, p.level_m)

            def work(first: int, last: int, plate: Any = plate) -> None:
                scratch = (np.empty((3, 3)), np.empty((1, 3)), np.empty((1, 4)), np.zeros(1))
                lifts_between(*self._ground, *plate, gap_m, at, quaternion, parts, first, last, *scratch, out)

            in_bands(len(parts), work)
        return out

    def distances(self, position_m: Floats, quaternion: Floats, most_m: float) -> Floats:
        """(n,) least distance of the underside from known cell centres [m], at most `most_m`.

        A cell that is above the underside counts as negative.

        Parameters
        ----------
        position_m : (n, 3) float64 [m]   NaN: `most_m`
        quaternion : (n, 4) float64
        most_m : float [m]
        """
        at, out = self._cells(position_m), np.full(len(position_m), float(most_m))
        for p in self._plates:
            plate = (p.corners_m, p.round_m, p.level_m)

            def work(first: int, last: int, plate: Any = plate) -> None:
                distances(*self._ground, *plate, at, quaternion, first, last, np.empty((3, 3)), out)

            in_bands(len(at), work)
        return out


def tops_of(heights_m: Floats) -> Floats:
    """(⌈rows/TILE⌉, ⌈cols/TILE⌉) highest height [m] of every TILE × TILE cells; -inf unknown."""
    rows, cols = heights_m.shape
    tops = np.empty((-(-rows // TILE), -(-cols // TILE)))
    tile_tops(heights_m, tops)
    return tops


def clear_ground(
    path: ScanPath, body_points_m: ArrayLike, ground: TerrainGrid, gap_m: float, *, between: bool = False
) -> ScanPath:
    """Lift samples until the whole underside is at least the gap from every known cell centre.

    Parameters
    ----------
    path : ScanPath
        with attitudes
    body_points_m : (m, 3) float [m]
        the underside is the flat plate between these points; a circle of 8 points or more is the circle
    ground : TerrainGrid
        not expanded
    gap_m : float [m]
    between : bool
        the straight way from sample to sample is clear as well: both samples are lifted where it is not

    Returns
    -------
    ScanPath
        `lift_m` increased, `clearance_m` set (NaN where no ground lies within three gaps)

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import ScanPath, TerrainGrid, clear_ground, disc, sample_terrain
    >>> ground = TerrainGrid.of(np.zeros((20, 20)), grid_m=0.05)
    >>> path = ScanPath.planar(np.array([[0.4, 0.5], [0.6, 0.5]]), np.zeros(2, np.int32))
    >>> path = clear_ground(sample_terrain(path, ground), disc(0.1), ground, gap_m=0.05)
    >>> np.round(path.clearance_m, 3)
    array([0.05, 0.05])
    """
    compared = Clearance.over(ground, body_points(body_points_m))
    gap = positive("gap_m", gap_m)
    made = clear_rows(path, compared, gap)
    if between:
        made = clear_ways(made, compared, gap)
    return _measured(made, compared, gap)


def clear_rows(path: ScanPath, compared: Clearance, gap_m: float) -> ScanPath:
    """`clear_ground` of samples, without a measurement: `clearance_m` and the flag `lifted` are of before."""
    return _lifted(path, compared.lifts(path.position_m, path.quaternion, gap_m + SPARE_M))


def clear_ways(path: ScanPath, compared: Clearance, gap_m: float) -> ScanPath:
    """The same for the straight ways from sample to sample of a path whose samples are clear."""
    way = compared.lifts_between(path.position_m, path.quaternion, gap_m + SPARE_M)
    # a straight way rises by what both its ends rise by
    return _lifted(path, np.maximum(np.append(way, 0.0), np.append(0.0, way)))


def _lifted(path: ScanPath, lift_m: Floats) -> ScanPath:
    position = path.position_m.copy()
    position[:, 2] += lift_m
    return path.changed(position_m=position, lift_m=path.lift_m + lift_m)


def with_clearance(path: ScanPath, body_points_m: ArrayLike, ground: TerrainGrid, gap_m: float) -> ScanPath:
    """Measure a path that was raised since it was cleared: `clearance_m` and the flag `lifted`.

    Parameters
    ----------
    path : ScanPath
        with attitudes and `lift_m`
    body_points_m : (m, 3) float [m]
        as for `clear_ground`
    ground : TerrainGrid
        not expanded
    gap_m : float [m]

    Returns
    -------
    ScanPath
        places and attitudes are kept
    """
    compared = Clearance.over(ground, body_points(body_points_m))
    return _measured(path, compared, positive("gap_m", gap_m))


def _measured(path: ScanPath, compared: Clearance, gap_m: float) -> ScanPath:
    most = LOOK_GAPS * (gap_m + SPARE_M)
    clearance = compared.distances(path.position_m, path.quaternion, most)
    clearance[clearance >= most] = np.nan
    return path.changed(clearance_m=clearance).with_flag(LIFTED, path.lift_m > LIFTED_M)


def control_points(path: ScanPath, body: Floats) -> Floats:
    """(n, m, 3) places of the body's points along a path [m]."""
    axes = body_axes(path.normal, path.azimuth_rad)
    made: Floats = path.position_m[:, None, :] + np.einsum("nij,mj->nmi", axes, body)
    return np.ascontiguousarray(made)
