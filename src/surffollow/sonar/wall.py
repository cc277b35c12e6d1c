"""A wall's pose, and which of several walls an earlier pose and the beams speak for."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import UsageError

N_SIGMA = 3.0  # as for the incidences of a pair


@dataclass(frozen=True)
class WallPose:
    """One wall {x : x·cos φ + y·sin φ = d}.

    φ points from the sonars that see the wall to the wall, in every frame. d is negative where the frame's
    origin lies behind the wall.

    Attributes
    ----------
    phi_rad : float
        direction of the normal, from the sonars to the wall, in [−π, π)
    distance_m : float
        from the origin along the normal; < 0: the origin is behind the wall
    covariance : (2, 2) ndarray
        of (φ, d): rad², rad m, m²; inf on the diagonal where the readings do not fix the wall
    sensors : tuple of int
        indices of the readings that it was computed from
    ambiguous : bool
        another wall explains the same readings as well
    favoured : bool
        beams' axes and prior pose speak for no other wall (see `mark_favoured`)

    Examples
    --------
    >>> import math
    >>> import numpy as np
    >>> from surffollow.sonar import WallPose
    >>> wall = WallPose(phi_rad=0.0, distance_m=1.2, covariance=np.diag([1e-4, 4e-6]), sensors=(0, 1))
    >>> round(wall.phi_std_rad, 3), round(wall.distance_std_m, 3)
    (0.01, 0.002)
    >>> seen = wall.moved(0.2, 0.0, math.pi / 2)          # by a robot that went 0.2 m and turned left
    >>> round(seen.phi_rad, 3), round(seen.distance_m, 3)
    (-1.571, 1.0)
    """

    phi_rad: float
    distance_m: float
    covariance: NDArray[np.float64]
    sensors: tuple[int, ...]
    ambiguous: bool = False
    favoured: bool = True

    @property
    def phi_std_rad(self) -> float:
        """Standard deviation of φ [rad]."""
        return math.sqrt(self.covariance[0, 0])

    @property
    def distance_std_m(self) -> float:
        """Standard deviation of d [m]."""
        return math.sqrt(self.covariance[1, 1])

    def moved(self, x_m: float, y_m: float, heading_rad: float) -> WallPose:
        """The same wall in the frame of a pose (x, y, heading) that is given in this wall's frame.

        φ keeps its sense: behind the wall d is negative.

        Parameters
        ----------
        x_m : float [m]
            place of the new frame
        y_m : float [m]
            place of the new frame
        heading_rad : float [rad]
            direction of the new frame's x axis

        Returns
        -------
        WallPose
            with its covariance: d takes part in the error of φ
        """
        n = np.array([math.cos(self.phi_rad), math.sin(self.phi_rad)])
        slope = x_m * n[1] - y_m * n[0]
        turn = np.array([[1.0, 0.0], [slope, 1.0]])
        distance = self.distance_m - float(n @ (x_m, y_m))
        phi = math.remainder(self.phi_rad - heading_rad, 2.0 * math.pi)
        phi = -math.pi if phi == math.pi else phi
        covariance = self.covariance
        if np.isfinite(covariance).all():  # inf: unknown in every frame
            covariance = turn @ covariance @ turn.T
        return replace(self, phi_rad=phi, distance_m=distance, covariance=covariance)


def wall_of(row: NDArray[np.float64], sensors: tuple[int, ...]) -> WallPose:
    """The wall of a solution (φ, d, var φ, cov, var d) and of the readings that saw it."""
    covariance = np.array([[row[2], row[3]], [row[3], row[4]]])
    return WallPose(float(row[0]), float(row[1]), covariance, sensors)


def mark_favoured(
    found: list[WallPose],
    headings_rad: NDArray[np.float64],
    prior: WallPose | None,
    reproduces: Callable[[WallPose], bool],
) -> list[WallPose]:
    """Set `favoured` and `ambiguous` of walls that explain the same readings; the favoured ones come first.

    A rule that every wall fails, or none, says nothing.

    Parameters
    ----------
    headings_rad : (m,) array
        axes of the beams, by the walls' `sensors`
    prior : WallPose or None
        an earlier pose of the wall that is looked for, in the walls' frame, whose origin is among the sonars
    reproduces : callable
        whether every reading is within its own noise of what a wall predicts: a vague
        solution of one pair agrees with anything
    """

    def is_before_its_sonars(wall: WallPose) -> bool:
        # an echo from behind the beam's axis would come from its outermost edge, at grazing incidence
        off = (math.remainder(wall.phi_rad - headings_rad[k], 2.0 * math.pi) for k in wall.sensors)
        return all(abs(o) <= 0.5 * math.pi for o in off)

    rules: list[Callable[[WallPose], bool]] = [reproduces, is_before_its_sonars]
    if prior is not None:
        rules.append(_near(prior))
    kept = list(found)
    for rule in rules:
        kept = [w for w in kept if rule(w)] or kept
    several = len(kept) > 1
    marked = [replace(w, ambiguous=several, favoured=any(w is k for k in kept)) for w in found]
    return sorted(marked, key=lambda w: not w.favoured)


def check_prior(prior: WallPose) -> None:
    """Refuse an earlier pose without a covariance.

    Raises
    ------
    UsageError
        the prior's covariance is not positive definite
    """
    if not (
        np.isfinite(prior.covariance).all()
        and prior.covariance[0, 0] > 0.0
        and np.linalg.det(prior.covariance) > 0.0
    ):
        raise UsageError(
            f"the prior's covariance {prior.covariance.tolist()} is not positive definite; give the "
            "uncertainty that the pose has by now (rad², rad m, m²)"
        )


def _near(prior: WallPose) -> Callable[[WallPose], bool]:
    """Whether a wall lies within three standard deviations of a prior pose."""
    if prior.distance_m < 0.0:  # the sonars passed it: the same line from its other side is (φ + π, −d)
        turned = prior.covariance * np.array([[1.0, -1.0], [-1.0, 1.0]])
        phi, distance = prior.phi_rad + math.pi, -prior.distance_m
        prior = replace(prior, phi_rad=phi, distance_m=distance, covariance=turned)

    def near(wall: WallPose) -> bool:
        turn = math.remainder(wall.phi_rad - prior.phi_rad, 2.0 * math.pi)
        off = np.array([turn, wall.distance_m - prior.distance_m])
        own = wall.covariance if np.isfinite(wall.covariance).all() else np.zeros((2, 2))
        return float(off @ np.linalg.solve(prior.covariance + own, off)) <= N_SIGMA**2

    return near
