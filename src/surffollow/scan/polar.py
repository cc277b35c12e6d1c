"""Partial path correction: radial scale and offset, angular offset, about the arm's base (paper §3.4)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.errors import ScanInputError
from surffollow.scan.checks import Floats, positive, real_array
from surffollow.scan.envelope import Envelope
from surffollow.scan.following import sample_terrain
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.path import UNKNOWN_BENEATH, ScanPath

ZONE_M = 0.01  # residual that still counts as effective
SCALES = (0.5, 2.0)  # an arm that errs by more has another unit, or its spots are in another order


@dataclass(frozen=True)
class PolarCorrection:
    """Parameters of equations 8 and 9, and where their fit holds.

    Attributes
    ----------
    base_m : (x, y) [m]
        pole, the arm's base joint
    scale : float
        of ρ
    offset_m : float [m]
        of ρ
    offset_rad : float
        of φ
    spots_m : (n, 2) [m]
        measured places of the fit
    residual_m : (n,) [m]
        distance of each commanded spot from its corrected one
    zone_m : float [m]
        bound of the zone of effectiveness

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import PolarCorrection
    >>> commanded_m = np.array([[1.0, 0.0], [0.0, 1.0], [2.0, 0.0], [0.0, 2.0]])
    >>> measured_m = 1.01 * commanded_m                       # the arm reaches 1 % too far
    >>> correction = PolarCorrection.fit(commanded_m, measured_m, (0.0, 0.0))
    >>> np.round(correction.apply([[1.5, 0.0]]), 4) + 0.0     # to be sent, to reach 1.5 m
    array([[1.4851, 0.    ]])
    """

    base_m: tuple[float, float]
    scale: float = 1.0
    offset_m: float = 0.0
    offset_rad: float = 0.0
    spots_m: Floats | None = None
    residual_m: Floats | None = None
    zone_m: float = ZONE_M

    @classmethod
    def fit(
        cls,
        commanded_m: ArrayLike,
        measured_m: ArrayLike,
        base_m: Sequence[float],
        *,
        zone_m: float = ZONE_M,
    ) -> PolarCorrection:
        """Least squares from tip positions.

        Parameters
        ----------
        commanded_m : (n, 2 or 3) float [m]
            tip of the computer model
        measured_m : (n, 2 or 3) float [m]
            real tip
        base_m : (x, y, …) [m]
        zone_m : float [m]

        Returns
        -------
        PolarCorrection
            radial scale and offset, angular offset, zone

        Raises
        ------
        ScanInputError
            fewer than 2 spots, spots at one distance from the base (the scale has no solution), or a scale
            that cannot be (another unit)

        Notes
        -----
        ρ_commanded = ρ_measured scale + offset, φ_commanded = φ_measured + offset: applied to a desired
        place, the correction gives the command that brings the real tip there.
        """
        base = np.array([float(v) for v in list(base_m)[:2]])
        a = real_array("commanded_m", commanded_m, (None, None))[:, :2] - base
        b = real_array("measured_m", measured_m, (None, None))[:, :2] - base
        if a.shape != b.shape or len(a) < 2 or a.shape[1] != 2:
            raise ScanInputError(f"{len(a)} commanded and {len(b)} measured spots; expected at least 2 pairs")
        if not (np.isfinite(a).all() and np.isfinite(b).all()):
            raise ScanInputError("spots must be finite; leave out those that were not measured")
        ra, rb = np.hypot(a[:, 0], a[:, 1]), np.hypot(b[:, 0], b[:, 1])
        if np.ptp(rb) < 1e-3 * rb.max():
            raise ScanInputError(
                f"all {len(a)} spots are {rb.mean():.3g} m from the base; the scale needs two distances"
            )
        scale, offset = np.polyfit(rb, ra, 1)
        if not SCALES[0] <= scale <= SCALES[1]:
            raise ScanInputError(
                f"the spots ask for a radial scale of {scale:.4g}, expected {SCALES[0]:g} to "
                f"{SCALES[1]:g}; are both in metres, and in one order?"
            )
        turn = np.arctan2(a[:, 1], a[:, 0]) - np.arctan2(b[:, 1], b[:, 0])
        angle = math.atan2(float((rb * np.sin(turn)).sum()), float((rb * np.cos(turn)).sum()))
        made = cls((float(base[0]), float(base[1])), float(scale), float(offset), angle)
        left = np.hypot(*(made.apply(b + base) - (a + base)).T)
        zone = positive("zone_m", zone_m)
        return cls(made.base_m, made.scale, made.offset_m, angle, b + base, left, zone)

    def apply(self, xy_m: ArrayLike) -> Floats:
        """(n, 2) corrected places (8), (9).

        Parameters
        ----------
        xy_m : (n, 2) float [m]
            places as they were measured

        Returns
        -------
        (n, 2) float64 [m]
            corrected places
        """
        d = real_array("xy_m", xy_m, (None, None))[:, :2] - np.asarray(self.base_m)
        rho = np.hypot(d[:, 0], d[:, 1]) * self.scale + self.offset_m
        phi = np.arctan2(d[:, 1], d[:, 0]) + self.offset_rad
        made: Floats = np.column_stack([rho * np.cos(phi), rho * np.sin(phi)]) + np.asarray(self.base_m)
        return made

    def effective(self, xy_m: ArrayLike) -> NDArray[np.bool_]:
        """(n,) bool: the zone of effectiveness, where the nearest spot of the fit is within the bound.

        Parameters
        ----------
        xy_m : (n, 2) float [m]
            places to be judged

        Returns
        -------
        (n,) bool
            True: within the zone of effectiveness
        """
        xy = real_array("xy_m", xy_m, (None, None))[:, :2]
        if self.spots_m is None or self.residual_m is None:
            return np.zeros(len(xy), np.bool_)
        from scipy.spatial import cKDTree

        _, nearest = cKDTree(self.spots_m).query(xy)
        return np.asarray(self.residual_m[nearest] <= self.zone_m)


def polar_correction(
    path: ScanPath, correction: PolarCorrection, surface: Envelope | TerrainGrid | None = None
) -> ScanPath:
    """Move a path to where the arm must be sent (eqs 8-10).

    Parameters
    ----------
    path : ScanPath
    correction : PolarCorrection
    surface : Envelope or TerrainGrid
        z is sampled again from it at the corrected places, `lift_m` added;
        None: z is kept, which is right where the map is true and the arm is not

    Returns
    -------
    ScanPath
        the attitude is unchanged; UNKNOWN_BENEATH set where z was sampled beside the surface

    Notes
    -----
    ρ' = ρ scale + offset (8), φ' = φ + offset (9), (ρ' cos φ', ρ' sin φ', f_env there) (10).

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import PolarCorrection, ScanPath, polar_correction
    >>> path = ScanPath.planar(np.array([[1.0, 0.0], [1.5, 0.0]]), np.zeros(2, np.int32))
    >>> sent = polar_correction(path, PolarCorrection((0.0, 0.0), offset_m=0.02))
    >>> np.round(sent.position_m[:, 0], 3)
    array([1.02, 1.52])
    """
    xy = correction.apply(path.position_m)
    position = np.column_stack([xy, path.position_m[:, 2]])
    moved = path.changed(position_m=position)
    if surface is None:
        return moved
    sampled = sample_terrain(moved, surface)
    z = sampled.position_m[:, 2] + path.lift_m
    made = moved.changed(position_m=np.column_stack([xy, z]))
    return made.with_flag(UNKNOWN_BENEATH, made.has(UNKNOWN_BENEATH) | np.isnan(z))
