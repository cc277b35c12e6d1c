"""A three-axis arm with a two-axis wrist: kinematics, joint limits, reach and static sag (paper §1, fig. 2).

Joints are yaw of the base, elevation of the upper link and elevation of the forearm, both from the
horizontal (a pantograph keeps them and the wrist's base independent of each other), then pitch and roll of
the wrist (`attitude_angles`). The wrist's pivot is the end of the forearm; the tip lies `tool_m` below
it along the body's -z axis. Frames: ground, vehicle, arm base, camera, tip; `a_from_b` maps b to a.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surffollow.errors import ScanInputError
from surffollow.scan.attitude_angles import body_axes, wrist_angles
from surffollow.scan.camera import rigid_transform
from surffollow.scan.checks import Floats, finite, positive, real_array
from surffollow.scan.limits import AboutBase, WristLimits

JOINTS = ("yaw", "shoulder", "elbow", "pitch", "roll")
SAG_REFERENCE_M = 2.0
STRAIGHT = 1e-12  # law of cosines beyond ±1 by no more than this is a straight arm
LIMIT_SLACK_RAD = 1e-12


def _identity() -> Floats:
    return np.eye(4)


@dataclass(frozen=True)
class Arm(AboutBase):
    """Geometry, limits and sag.

    Attributes
    ----------
    upper_m, fore_m : float [m]
        lengths of the two links
    tool_m : float [m]
        from the wrist's pivot to the tip, along the body's -z
    ground_from_vehicle : (4, 4) float64
        pose of the vehicle
    vehicle_from_base : (4, 4) float64
        pose of the shoulder in the vehicle; z of all three is up
    forearm_from_camera : (4, 4) float64
        pose of the camera in the wrist's level frame, x outwards
    sag_at_2m_m : float [m]
        static sag of the pivot at a horizontal distance of 2 m; ∝ ρ³
    yaw_limit_rad : float
        of yaw, both signs, from the base's x axis
    shoulder_rad, elbow_rad : (min, max)
        limits of the links' elevations
    wrist : WristLimits

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import Arm
    >>> arm = Arm(upper_m=1.0, fore_m=1.0, tool_m=0.2)
    >>> joints_rad = arm.inverse([[1.2, 0.3, -0.5]], [[0.0, 0.0, 1.0]])
    >>> joints_rad.shape, bool(arm.within_limits(joints_rad)[0])
    ((1, 5), True)
    >>> tip_m, normal = arm.forward(joints_rad)
    >>> np.round(tip_m, 6) + 0.0
    array([[ 1.2,  0.3, -0.5]])
    """

    upper_m: float = 1.5
    fore_m: float = 1.5
    tool_m: float = 0.25
    ground_from_vehicle: Floats = field(default_factory=_identity)
    vehicle_from_base: Floats = field(default_factory=_identity)
    forearm_from_camera: Floats = field(default_factory=_identity)
    sag_at_2m_m: float = 0.0
    yaw_limit_rad: float = math.radians(120.0)
    shoulder_rad: tuple[float, float] = (math.radians(-20.0), math.radians(100.0))
    elbow_rad: tuple[float, float] = (math.radians(-110.0), math.radians(45.0))
    wrist: WristLimits = field(default_factory=WristLimits)

    def __post_init__(self) -> None:
        for name in ("upper_m", "fore_m"):
            positive(name, getattr(self, name))
        for name in ("tool_m", "sag_at_2m_m"):
            if finite(name, getattr(self, name)) < 0.0:
                raise ScanInputError(f"{name} of the arm is {getattr(self, name):g} m; it must be 0 or above")
        for name in ("ground_from_vehicle", "vehicle_from_base", "forearm_from_camera"):
            object.__setattr__(self, name, rigid_transform(getattr(self, name), name))
        if self.ground_from_base[2, 2] < 1.0 - 1e-9:
            raise ScanInputError(
                "the arm's base is tilted against the ground frame; expected a ground frame with the base's z"
            )

    @property
    def ground_from_base(self) -> Floats:
        """(4, 4) pose of the arm's base in the ground frame."""
        made: Floats = self.ground_from_vehicle @ self.vehicle_from_base
        return made

    @property
    def base_m(self) -> tuple[float, float, float]:
        """Place of the base joint in the ground frame [m]."""
        x, y, z = self.ground_from_base[:3, 3]
        return float(x), float(y), float(z)

    @property
    def heading_rad(self) -> float:
        """Direction of the base's x axis in the ground frame."""
        m = self.ground_from_base
        return math.atan2(m[1, 0], m[0, 0])

    def sag_m(self, rho_m: ArrayLike) -> Floats:
        """Static sag [m] at a horizontal distance of the pivot from the base: a cantilever's, ∝ ρ³.

        Parameters
        ----------
        rho_m : float [m]
            horizontal distance of the pivot from the base

        Returns
        -------
        float64 [m]
            sag, in the shape of `rho_m`
        """
        return np.asarray(self.sag_at_2m_m * (np.abs(rho_m) / SAG_REFERENCE_M) ** 3)

    def forward(self, joints_rad: ArrayLike) -> tuple[Floats, Floats]:
        """Tip and normal of joint angles.

        Parameters
        ----------
        joints_rad : (n, 5) float [rad]
            columns of JOINTS

        Returns
        -------
        tip_m (n, 3) [m], normal (n, 3) unit z axis of the body, both in the ground frame
        """
        q = real_array("joints_rad", joints_rad, (None, 5))
        axes = self._axes(q)
        return self._pivot(q) - self.tool_m * axes[:, :, 2], axes[:, :, 2]

    def inverse(self, tip_m: ArrayLike, normal: ArrayLike) -> Floats:
        """(n, 5) joint angles [rad] with the elbow above the line from shoulder to wrist; NaN out of reach.

        Parameters
        ----------
        tip_m : (n, 3) float [m]
            in the ground frame
        normal : (n, 3) float
            unit

        Returns
        -------
        (n, 5) float64 [rad]
            joint angles; NaN out of reach

        Notes
        -----
        The tilt of the normal gives the pivot, the pivot gives yaw and the two elevations by the law of
        cosines, yaw gives the wrist's angles. Joint limits are not looked at (`within_limits`).
        """
        tip, n = real_array("tip_m", tip_m, (None, 3)), real_array("normal", normal, (None, 3))
        d = tip + self.tool_m * n - np.asarray(self.base_m)
        rho = np.hypot(d[:, 0], d[:, 1])
        azimuth = np.arctan2(d[:, 1], d[:, 0])
        up = d[:, 2] + self.sag_m(rho)
        reach = np.hypot(rho, up)
        with np.errstate(invalid="ignore", divide="ignore"):
            c = (self.upper_m**2 + reach**2 - self.fore_m**2) / (2.0 * self.upper_m * reach)
            c = np.where(np.abs(c) <= 1.0 + STRAIGHT, np.clip(c, -1.0, 1.0), np.nan)
        shoulder = np.arctan2(up, rho) + np.arccos(c)
        elbow = np.arctan2(up - self.upper_m * np.sin(shoulder), rho - self.upper_m * np.cos(shoulder))
        angles = wrist_angles(n, azimuth)
        yaw = (azimuth - self.heading_rad + math.pi) % (2.0 * math.pi) - math.pi
        made = np.column_stack([yaw, shoulder, elbow, angles])
        made[np.isnan(c)] = np.nan
        return made

    def within_limits(self, joints_rad: ArrayLike) -> NDArray[np.bool_]:
        """(n,) bool, true where every joint is finite and within its limits.

        Parameters
        ----------
        joints_rad : (n, 5) float [rad]
            columns of JOINTS; NaN is outside

        Returns
        -------
        (n,) bool
            True: every joint is finite and within its limits
        """
        q = real_array("joints_rad", joints_rad, (None, 5))
        box = self.wrist.as_array()
        low = np.array([-self.yaw_limit_rad, self.shoulder_rad[0], self.elbow_rad[0], box[0], box[2]])
        high = np.array([self.yaw_limit_rad, self.shoulder_rad[1], self.elbow_rad[1], box[1], box[3]])
        with np.errstate(invalid="ignore"):
            inside = (q >= low - LIMIT_SLACK_RAD) & (q <= high + LIMIT_SLACK_RAD)
        return np.asarray(inside.all(axis=1), np.bool_)

    def reachable(self, tip_m: Floats, normal: Floats) -> NDArray[np.bool_]:
        """(n,) bool, whether the tip can be there with that normal, within all limits (`WorkSpace`).

        Parameters
        ----------
        tip_m, normal : (n, 3) float
            as in `WorkSpace.reachable`

        Returns
        -------
        (n,) bool
            True: joint angles within the limits reach it
        """
        return self.within_limits(self.inverse(tip_m, normal))

    def ground_from_tip(self, joints_rad: ArrayLike) -> Floats:
        """(n, 4, 4) poses of the tip.

        Parameters
        ----------
        joints_rad : (n, 5) float [rad]
            as for `forward`

        Returns
        -------
        (n, 4, 4) float64
            homogeneous matrices, ground from tip
        """
        q = real_array("joints_rad", joints_rad, (None, 5))
        axes = self._axes(q)
        return _poses(axes, self._pivot(q) - self.tool_m * axes[:, :, 2])

    def ground_from_camera(self, joints_rad: ArrayLike) -> Floats:
        """(n, 4, 4) poses of the camera, which the pantograph keeps level at the end of the forearm.

        Parameters
        ----------
        joints_rad : (n, 5) float [rad]
            columns of JOINTS; pitch and roll do not matter

        Returns
        -------
        (n, 4, 4) float64
            homogeneous matrices, ground from camera
        """
        q = real_array("joints_rad", joints_rad, (None, 5))
        level = np.zeros((len(q), 5))
        level[:, 0] = q[:, 0]
        made: Floats = _poses(self._axes(level), self._pivot(q)) @ self.forearm_from_camera
        return made

    def _axes(self, q: Floats) -> Floats:
        """(n, 3, 3) body axes in the ground frame."""
        azimuth = q[:, 0] + self.heading_rad
        p, r = q[:, 3], q[:, 4]
        x, y, z = np.sin(p) * np.cos(r), -np.sin(r), np.cos(p) * np.cos(r)
        c, s = np.cos(azimuth), np.sin(azimuth)
        return body_axes(np.column_stack([c * x - s * y, s * x + c * y, z]), azimuth)

    def _pivot(self, q: Floats) -> Floats:
        """(n, 3) place of the wrist's pivot in the ground frame, sag included."""
        azimuth = q[:, 0] + self.heading_rad
        rho = self.upper_m * np.cos(q[:, 1]) + self.fore_m * np.cos(q[:, 2])
        up = self.upper_m * np.sin(q[:, 1]) + self.fore_m * np.sin(q[:, 2]) - self.sag_m(rho)
        made: Floats = np.column_stack([rho * np.cos(azimuth), rho * np.sin(azimuth), up])
        return made + np.asarray(self.base_m, np.float64)


def _poses(axes: Floats, place: Floats) -> Floats:
    made = np.zeros((len(axes), 4, 4))
    made[:, :3, :3], made[:, :3, 3], made[:, 3, 3] = axes, place, 1.0
    return made
