"""Overall calibration matrix: vertical corrections from touched spots, over the arm's x-y plane (§3.5)."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from surffollow.config.input_file import check_plain_file
from surffollow.errors import ScanFileError, ScanInputError
from surffollow.map.formats.atomic_file import replacing
from surffollow.scan.checks import Floats, near, positive, real_array, region_of
from surffollow.scan.path import ScanPath
from surffollow.scan.terrain import delaunay
from surffollow.scan.triangles import lay_triangles

FORMAT = "surffollow-calibration-1"
OUTSIDE = ("nearest", "unknown")
LARGEST_M = 1.0  # correction that can be; beyond it the unit is wrong
MAX_NODES = 1_000_000  # 100 × 100 m at 0.1 m


@dataclass(frozen=True)
class CalibrationMatrix:
    """Vertical corrections at regular places.

    Attributes
    ----------
    values_m : (rows, cols) float64 [m]
        correction at the nodes, to be added to z; finite
    inside : (rows, cols) bool
        nodes within the triangles of the spots
    origin_m : (x, y) [m]
        node [0, 0], in the arm's frame (or the frame of the spots)
    grid_m : float [m]
        distance of nodes
    outside : str
        "nearest": beyond them the nearest one counts; "unknown": NaN
    spots_m : (n, 3) float64 [m]
        x, y and correction of each spot
    left_out_m : (n,) float64 [m]
        leave-one-out residual of each spot

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import CalibrationMatrix
    >>> spots = [(0, 0, 0.002), (1, 0, 0.004), (0, 1, 0.002), (1, 1, 0.004)]     # x, y, correction [m]
    >>> matrix = CalibrationMatrix.fit(spots, grid_m=0.5)
    >>> np.round(matrix.at([[0.5, 0.5], [1.0, 0.2]]), 4)
    array([0.003, 0.004])
    """

    values_m: Floats
    inside: NDArray[np.bool_]
    origin_m: tuple[float, float]
    grid_m: float
    outside: str
    spots_m: Floats
    left_out_m: Floats

    @classmethod
    def fit(
        cls,
        spots: ArrayLike,
        *,
        grid_m: float = 0.1,
        region: Sequence[float] | None = None,
        outside: str = "nearest",
    ) -> CalibrationMatrix:
        """Triangulate spots and read the surface at regular places.

        Parameters
        ----------
        spots : (n, 3) float [m]
            x, y and correction (z of the model's tip at contact - mapped ground)
        grid_m : float [m]
            distance of the matrix' nodes
        region : (x_min, y_min, x_max, y_max) [m] or None
            None: around the spots
        outside : str
            policy beyond the spots' hull: "nearest" or "unknown"

        Returns
        -------
        CalibrationMatrix
            corrections at regular places

        Raises
        ------
        ScanInputError
            fewer than 3 spots or all on a line, not finite, corrections above 1 m, no such policy, or more
            than 1e6 nodes

        Notes
        -----
        Paper §3.5. Repeated spots at one place are averaged.
        """
        given = real_array("spots", spots, (None, 3))
        if outside not in OUTSIDE:
            raise ScanInputError(f"outside is '{outside}'; expected one of {', '.join(OUTSIDE)}")
        if not np.isfinite(given).all():
            raise ScanInputError("spots must be finite; leave out those that did not touch")
        near("the list of spots", given)
        if len(given) and np.abs(given[:, 2]).max() > LARGEST_M:
            raise ScanInputError(
                f"a correction of {np.abs(given[:, 2]).max():g} m is beyond {LARGEST_M:g} m; in metres?"
            )
        points = _unique(given)
        if len(delaunay(points[:, :2])) == 0:
            raise ScanInputError(
                f"{len(points)} places on one line or fewer than 3; touch spots that span the work space"
            )
        g = positive("grid_m", grid_m)
        box = region_of(region) if region is not None else (*points[:, :2].min(0), *points[:, :2].max(0))
        x0, y0 = np.floor(np.array(box[:2]) / g + 1e-9) * g
        cols, rows = (int(np.ceil((box[k + 2] - o) / g - 1e-9)) + 1 for k, o in enumerate((x0, y0)))
        if rows * cols > MAX_NODES:
            raise ScanInputError(
                f"{box[2] - box[0]:g} × {box[3] - box[1]:g} m with nodes every {g:g} m are {rows * cols} "
                f"nodes; at most {MAX_NODES}; are spots and grid in metres?"
            )
        x, y = x0 + g * np.arange(cols), y0 + g * np.arange(rows)
        nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        values, inside = _interpolate(points, nodes)
        left = np.array([_left_out(points, k) for k in range(len(points))])
        nearest, _ = _nearest(points, given[:, :2])
        return cls(
            values.reshape(rows, cols),
            inside.reshape(rows, cols),
            (float(x0), float(y0)),
            g,
            outside,
            given,
            left[nearest],
        )

    def at(self, xy_m: ArrayLike) -> Floats:
        """(n,) corrections [m] by linear interpolation in the matrix; see `outside` for places beyond it.

        Parameters
        ----------
        xy_m : (n, 2) float [m]
            places in map coordinates

        Returns
        -------
        (n,) float64 [m]
            corrections
        """
        xy = real_array("xy_m", xy_m, (None, None))[:, :2]
        rows, cols = self.values_m.shape
        uv = (xy - np.asarray(self.origin_m)) / self.grid_m
        with np.errstate(invalid="ignore"):
            beyond = ~((uv >= -1e-9) & (uv <= np.array([cols - 1, rows - 1]) + 1e-9)).all(axis=1)
        u = np.clip(np.nan_to_num(uv[:, 0]), 0.0, cols - 1.0)
        v = np.clip(np.nan_to_num(uv[:, 1]), 0.0, rows - 1.0)
        i, j = np.minimum(u.astype(int), max(cols - 2, 0)), np.minimum(v.astype(int), max(rows - 2, 0))
        i1, j1 = np.minimum(i + 1, cols - 1), np.minimum(j + 1, rows - 1)
        a, b = u - i, v - j
        z, q = self.values_m, self.inside
        made = (z[j, i] * (1 - a) + z[j, i1] * a) * (1 - b) + (z[j1, i] * (1 - a) + z[j1, i1] * a) * b
        if self.outside == "unknown":
            known = q[j, i] & q[j, i1] & q[j1, i] & q[j1, i1] & ~beyond
            made = np.where(known, made, np.nan)
        return np.where(np.isfinite(xy).all(axis=1), made, np.nan)

    def apply(self, path: ScanPath) -> ScanPath:
        """Add the correction to z (11); z is NaN where the correction is unknown.

        Parameters
        ----------
        path : ScanPath
            in map coordinates

        Returns
        -------
        ScanPath
            a copy with corrected z
        """
        position = path.position_m.copy()
        position[:, 2] += self.at(position)
        return path.changed(position_m=position)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a JSON file: format, origin_m, grid_m, outside, values_m, inside, spots_m, left_out_m.

        Parameters
        ----------
        path : path
            of the file

        Examples
        --------
        >>> import tempfile
        >>> from pathlib import Path
        >>> from surffollow.scan import CalibrationMatrix
        >>> matrix = CalibrationMatrix.fit([(0, 0, 0.002), (1, 0, 0.004), (0, 1, 0.002), (1, 1, 0.004)])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     matrix.save(Path(folder, "matrix.json"))
        ...     CalibrationMatrix.load(Path(folder, "matrix.json")).grid_m
        0.1
        """
        facts = {
            "format": FORMAT,
            "origin_m": list(self.origin_m),
            "grid_m": self.grid_m,
            "outside": self.outside,
            "values_m": self.values_m.tolist(),
            "inside": self.inside.astype(int).tolist(),
            "spots_m": self.spots_m.tolist(),
            "left_out_m": [v if np.isfinite(v) else None for v in self.left_out_m.tolist()],
        }
        with replacing(path) as temporary, open(temporary, "w", encoding="ascii") as f:
            json.dump(facts, f, allow_nan=False)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> CalibrationMatrix:
        """Read what `save` wrote.

        Parameters
        ----------
        path : path
            of a file that `save` wrote

        Returns
        -------
        CalibrationMatrix
            as it was saved

        Raises
        ------
        ScanFileError
        """
        check_plain_file(path, ScanFileError)
        try:
            with open(path, encoding="ascii") as f:
                facts = json.load(f)
            if facts["format"] != FORMAT:
                raise ValueError(f"its format is {facts['format']!r}, expected {FORMAT!r}")
            x, y = facts["origin_m"]
            made = cls(
                np.array(facts["values_m"], np.float64),
                np.array(facts["inside"], np.bool_),
                (float(x), float(y)),
                positive("grid_m", facts["grid_m"]),
                facts["outside"],
                np.array(facts["spots_m"], np.float64).reshape(-1, 3),
                np.array(facts["left_out_m"], np.float64),
            )
            if made.values_m.ndim != 2 or made.values_m.shape != made.inside.shape:
                raise ValueError(f"its matrix has shape {made.values_m.shape}, its mask {made.inside.shape}")
            if made.outside not in OUTSIDE or not np.isfinite(made.values_m).all():
                raise ValueError("its policy or its values cannot be")
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as e:
            raise ScanFileError(f"cannot read the calibration {path}: {e}") from e
        return made


def _unique(spots: Floats) -> Floats:
    """Spots with those at one place averaged."""
    _, number = np.unique(np.round(spots[:, :2], 6), axis=0, return_inverse=True)
    number = number.reshape(-1)
    count = np.bincount(number)
    return np.column_stack([np.bincount(number, spots[:, k]) / count for k in range(3)])


def _nearest(points: Floats, xy: Floats) -> tuple[NDArray[np.int64], Floats]:
    distance, index = cKDTree(points[:, :2]).query(xy)
    return np.asarray(index, np.int64), np.asarray(distance)


def _interpolate(points: Floats, xy: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Heights of the triangles at places, the nearest point's beside them; and which lie in a triangle."""
    values = np.full((len(xy), 1), np.nan)
    triangles = delaunay(points[:, :2])
    only = np.ones((1, 1), np.bool_)
    for k, place in enumerate(xy):
        local = np.column_stack([points[:, :2] - place, points[:, 2]])
        lay_triangles(local, triangles, np.inf, False, only, values[k : k + 1])
    made = values[:, 0]
    inside = np.isfinite(made)
    nearest, _ = _nearest(points, xy)
    return np.where(inside, made, points[nearest, 2]), inside


def _left_out(points: Floats, k: int) -> float:
    """Spot k minus the surface of all others; NaN where the others do not surround it."""
    others = np.delete(points, k, axis=0)
    value, inside = _interpolate(others, points[k : k + 1, :2])
    return float(points[k, 2] - value[0]) if inside[0] else float("nan")
