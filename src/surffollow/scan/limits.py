"""Limits of an arm, as planning needs them: the reach of its tip, and the angles of its wrist."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import ScanInputError
from surffollow.scan.attitude_angles import normals_of, wrist_angles
from surffollow.scan.checks import Floats, finite


class WorkSpace(Protocol):
    """Interface of an arm for a plan; `Annulus` is the simplest one.

    Examples
    --------
    >>> from surffollow.scan import Annulus, WorkSpace
    >>> work_space: WorkSpace = Annulus((0.0, 0.0, 1.0), radius_max_m=2.0)
    >>> work_space.base_m
    (0.0, 0.0, 1.0)
    """

    @property
    def base_m(self) -> tuple[float, float, float]:
        """The base joint's place in the ground frame [m]."""

    def reachable(self, tip_m: Floats, normal: Floats) -> NDArray[np.bool_]:
        """(n,) bool, whether the tip can be at (n, 3) with its underside's normal (n, 3).

        Parameters
        ----------
        tip_m : (n, 3) float [m]
            places of the tip in the ground frame
        normal : (n, 3) float
            unit normals of the underside

        Returns
        -------
        (n,) bool
            True: the tip can be there
        """

    def azimuth_rad(self, tip_m: Floats) -> Floats:
        """(n,) azimuth ψ of the wrist when the tip is there.

        Parameters
        ----------
        tip_m : (n, 3) float [m]
            places of the tip in the ground frame

        Returns
        -------
        (n,) float64 [rad]
            azimuths
        """


class AboutBase:
    """A work space whose wrist has the azimuth of the direction from the base joint to the tip."""

    def azimuth_rad(self: WorkSpace, tip_m: Floats) -> Floats:
        """(n,) direction from the base to the tip, in the ground frame.

        Parameters
        ----------
        tip_m : (n, 3) float [m]
            as in `WorkSpace.azimuth_rad`

        Returns
        -------
        (n,) float64 [rad]
            directions
        """
        return np.arctan2(tip_m[:, 1] - self.base_m[1], tip_m[:, 0] - self.base_m[0])


@dataclass(frozen=True)
class WristLimits:
    """Limits of the two wrist angles [rad] (`attitude_angles`): pitch about y, then roll about x.

    Examples
    --------
    >>> import math
    >>> import numpy as np
    >>> from surffollow.scan import WristLimits
    >>> limits = WristLimits.symmetric(math.radians(20.0))
    >>> steep = np.array([[-0.6, 0.0, 0.8]])              # 37° from up
    >>> normal, changed = limits.clamp(steep, np.zeros(1))
    >>> round(math.degrees(math.acos(normal[0, 2])), 1), bool(changed[0])
    (20.0, True)
    """

    pitch_min: float = math.radians(-45.0)
    pitch_max: float = math.radians(45.0)
    roll_min: float = math.radians(-45.0)
    roll_max: float = math.radians(45.0)

    def __post_init__(self) -> None:
        for axis in ("pitch", "roll"):
            low = finite(f"{axis}_min", getattr(self, f"{axis}_min"), "rad")
            high = finite(f"{axis}_max", getattr(self, f"{axis}_max"), "rad")
            if not (-math.pi / 2 < low <= 0.0 <= high < math.pi / 2):
                raise ScanInputError(
                    f"wrist limits of {axis} are {low:g} to {high:g} rad; expected -π/2 < min ≤ 0 ≤ max < π/2"
                )

    @classmethod
    def symmetric(cls, limit_rad: float) -> WristLimits:
        """The same limit for both angles and signs.

        Parameters
        ----------
        limit_rad : float [rad]
            largest angle

        Returns
        -------
        WristLimits
            for pitch and roll
        """
        return cls(-limit_rad, limit_rad, -limit_rad, limit_rad)

    @classmethod
    def of(cls, limits: Any) -> WristLimits:
        """Limits [rad] from a number, ((pitch_min, pitch_max), (roll_min, roll_max)), or limits.

        Parameters
        ----------
        limits : float, pairs or WristLimits [rad]
            as in the summary

        Returns
        -------
        WristLimits
            for pitch and roll
        """
        if isinstance(limits, WristLimits):
            return limits
        values = np.asarray(limits, np.float64)
        if values.ndim == 0:
            return cls.symmetric(float(values))
        if values.shape != (2, 2):
            raise ScanInputError(f"wrist limits have shape {values.shape}; expected one number or (2, 2)")
        return cls(*(float(v) for v in values.reshape(-1)))

    def as_array(self) -> Floats:
        """(4,) pitch_min, pitch_max, roll_min, roll_max."""
        return np.array([self.pitch_min, self.pitch_max, self.roll_min, self.roll_max])

    def clamp(self, normal: Floats, azimuth_rad: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Normals within the limits, and where they had to be changed.

        Parameters
        ----------
        normal : (n, 3) float
            unit normals of the underside
        azimuth_rad : (n,) float [rad]
            azimuth of the wrist

        Returns
        -------
        (n, 3) float64 and (n,) bool
            the normals, and True where they were changed
        """
        angles = wrist_angles(normal, azimuth_rad)
        low = np.array([self.pitch_min, self.roll_min])
        high = np.array([self.pitch_max, self.roll_max])
        inside = np.clip(angles, low, high)
        changed: NDArray[np.bool_] = np.any(np.abs(inside - angles) > 1e-12, axis=1)
        return np.where(changed[:, None], normals_of(inside, azimuth_rad), normal), changed


@dataclass(frozen=True)
class Annulus(AboutBase):
    """A ring sector about a base joint, the same at every height between two limits.

    Attributes
    ----------
    base_m : (x, y, z) [m]
    radius_min_m, radius_max_m : float [m]
        horizontal distance of the tip from the base
    z_min_m, z_max_m : float [m]
        height of the tip above the base
    azimuth_min_rad, azimuth_max_rad : float
        sector, in the ground frame

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import Annulus
    >>> work_space = Annulus((0.0, 0.0, 1.0), radius_max_m=2.0, radius_min_m=0.5)
    >>> tip_m = np.array([[1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    >>> work_space.reachable(tip_m, np.array([[0.0, 0.0, 1.0]] * 2))
    array([ True, False])
    """

    base_m: tuple[float, float, float]
    radius_max_m: float
    radius_min_m: float = 0.0
    z_min_m: float = -math.inf
    z_max_m: float = math.inf
    azimuth_min_rad: float = -math.pi
    azimuth_max_rad: float = math.pi

    def __post_init__(self) -> None:
        if not 0.0 <= self.radius_min_m < self.radius_max_m:
            raise ScanInputError(
                f"a reach from {self.radius_min_m:g} to {self.radius_max_m:g} m; expected 0 ≤ least < most"
            )

    def reachable(self, tip_m: Floats, normal: Floats) -> NDArray[np.bool_]:
        """(n,) bool; any attitude is reachable where the tip is.

        Parameters
        ----------
        tip_m, normal : (n, 3) float
            as in `WorkSpace.reachable`; the normal does not matter

        Returns
        -------
        (n,) bool
            True: the tip is within the sector
        """
        d = tip_m - np.asarray(self.base_m)
        rho = np.hypot(d[:, 0], d[:, 1])
        middle = 0.5 * (self.azimuth_min_rad + self.azimuth_max_rad)
        half = 0.5 * (self.azimuth_max_rad - self.azimuth_min_rad)
        off = np.abs((np.arctan2(d[:, 1], d[:, 0]) - middle + math.pi) % (2 * math.pi) - math.pi)
        inside = (rho >= self.radius_min_m) & (rho <= self.radius_max_m) & (off <= half + 1e-12)
        made: NDArray[np.bool_] = inside & (d[:, 2] >= self.z_min_m) & (d[:, 2] <= self.z_max_m)
        return made
