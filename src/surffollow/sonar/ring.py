"""The sonars of a robot: where they are, what they see, and how exactly."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import UsageError
from surffollow.sonar.readings import Readings, incidence_limit

Pose = tuple[float, float, float]


@dataclass(frozen=True)
class SonarRing:
    """The sonars of a robot.

    Attributes
    ----------
    positions_m : (m, 2) ndarray
        in the robot frame
    headings_rad : (m,) ndarray
        axes of the beams, in the robot frame
    half_beam_rad, max_incidence_rad : float
        α and δ_max
    range_sigma : float
        standard deviation of a range as a share of the range
    max_range_m : float
        no echo comes from beyond
    """

    positions_m: NDArray[np.float64]
    headings_rad: NDArray[np.float64]
    half_beam_rad: float
    max_incidence_rad: float
    range_sigma: float = 0.01
    max_range_m: float = 10.0

    @classmethod
    def regular(
        cls,
        count: int = 24,
        radius_m: float = 0.35,
        half_beam_rad: float = math.radians(11.25),
        model: str = "specular",
        max_incidence_rad: float | None = None,
        range_sigma: float = 0.01,
        max_range_m: float = 10.0,
    ) -> SonarRing:
        """Sonars at equal angles on a circle, looking outward; the first looks ahead.

        Parameters
        ----------
        count : int              sonars, ≥ 1
        radius_m : float [m]     of the circle
        half_beam_rad : float    α
        model : {"specular", "diffuse"}  echoes up to δ_max = α, or up to α + 90°
        max_incidence_rad : float or None  δ_max itself, instead of a model
        range_sigma : float      standard deviation of a range as a share of the range
        max_range_m : float [m]  no echo comes from beyond

        Raises
        ------
        UsageError
            no sonar, a radius that is none, or as `poses.incidence_limit`
        """
        if count < 1 or not 0.0 <= radius_m < math.inf:
            raise UsageError(f"a ring of {count} sonars with a radius of {radius_m} m cannot be")
        headings = np.arange(count, dtype=np.float64) * (2.0 * math.pi / count)
        positions = radius_m * np.column_stack([np.cos(headings), np.sin(headings)])
        limit = incidence_limit(half_beam_rad, model, max_incidence_rad)
        return cls(positions, headings, half_beam_rad, limit, range_sigma, max_range_m)

    @property
    def spacing_rad(self) -> float:
        """Least angle between two beams; the full beam of a single sonar."""
        if self.headings_rad.size < 2:
            return 2.0 * self.half_beam_rad
        ordered = np.sort(np.mod(self.headings_rad, 2.0 * math.pi))
        gaps = np.diff(np.append(ordered, ordered[0] + 2.0 * math.pi))
        return float(gaps[gaps > 1e-9].min())

    def at(self, pose: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions (m, 2) and headings (m,) of the sonars of a robot at a pose x, y [m], heading [rad]."""
        x, y, heading = pose
        c, s = math.cos(heading), math.sin(heading)
        turned = self.positions_m @ np.array([[c, s], [-s, c]])
        return turned + (x, y), self.headings_rad + heading

    def sigmas(self, ranges_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviations [m] of ranges; that of the maximum range where there was no echo."""
        return self.range_sigma * np.where(np.isfinite(ranges_m), ranges_m, self.max_range_m)

    def readings(
        self,
        positions_m: NDArray[np.float64],
        headings_rad: NDArray[np.float64],
        ranges_m: NDArray[np.float64],
    ) -> Readings:
        """Ranges of these sonars at one pose or several, as the kernels take them.

        Parameters
        ----------
        positions_m : (n, 2) float64
            places of the sonars when they were read
        headings_rad : (n,) float64
            axes of their beams then
        ranges_m : (n,) float64
            inf: no echo, NaN: not measured

        Returns
        -------
        Readings
            with this ring's noise, beams and maximum range
        """
        return Readings(
            np.ascontiguousarray(positions_m),
            np.ascontiguousarray(headings_rad),
            ranges_m,
            self.sigmas(ranges_m),
            self.half_beam_rad,
            self.max_incidence_rad,
            self.max_range_m,
        )
