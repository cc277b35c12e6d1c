"""A pin-hole camera with its pose: pixels and depths to points in the ground frame, and back.

The camera frame has x to the right, y down and z forward; depth is z, not the length of the ray.
Pixel (row v, column u) sees along ((u - cx) / fx, (v - cy) / fy, 1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from surffollow.errors import ScanInputError
from surffollow.scan.checks import Floats, finite, near, positive, real_array

LONGEST_RANGE_M = 100.0  # of a camera that says nothing else; a depth image in millimetres is beyond it


@dataclass(frozen=True)
class Camera:
    """Intrinsics, stereo geometry and pose of one image.

    Attributes
    ----------
    fx_px, fy_px, cx_px, cy_px : float [px]
        focal lengths and principal point
    ground_from_camera : (4, 4) float64
        pose: rotation and translation [m]; None: not known
    baseline_m : float [m]
        of a stereo pair; 0: no stereo camera
    disparity_offset_px : float [px]
        depth = fx baseline / (disparity + offset)
    min_range_m, max_range_m : float [m]
        depths that the camera can measure
    name : str
        in messages and reports

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import Camera, looking_down
    >>> camera = Camera(100.0, 100.0, 1.0, 1.0, looking_down(0.5, 0.5, 1.2), baseline_m=0.1)
    >>> camera.depth_m([5.0, 10.0])                       # of disparities [px]
    array([2., 1.])
    >>> points_m = camera.points_m(np.full((3, 3), 1.2))
    >>> points_m.shape, np.round(points_m[1, 1], 6) + 0.0
    ((3, 3, 3), array([0.5, 0.5, 0. ]))
    """

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    ground_from_camera: Floats | None = None
    baseline_m: float = 0.0
    disparity_offset_px: float = 0.0
    min_range_m: float = 0.0
    max_range_m: float = LONGEST_RANGE_M
    name: str = "camera"

    def __post_init__(self) -> None:
        positive("fx_px", self.fx_px, "px")
        positive("fy_px", self.fy_px, "px")
        for key in ("cx_px", "cy_px", "disparity_offset_px"):
            finite(key, getattr(self, key), "px")
        if finite("baseline_m", self.baseline_m) < 0.0:
            raise ScanInputError(f"baseline_m of {self.name} is {self.baseline_m:g}; it must be 0 or above")
        positive("max_range_m", self.max_range_m)
        if not 0.0 <= finite("min_range_m", self.min_range_m) < self.max_range_m:
            raise ScanInputError(
                f"ranges of {self.name} are {self.min_range_m:g} to {self.max_range_m:g} m; expected "
                "0 ≤ min < max"
            )
        if self.ground_from_camera is not None:
            object.__setattr__(self, "ground_from_camera", rigid_transform(self.ground_from_camera))

    def pose(self) -> Floats:
        """(4, 4) ground_from_camera; ScanInputError for a camera without one."""
        if self.ground_from_camera is None:
            raise ScanInputError(
                f"{self.name} has no pose; give ground_from_camera, the 4 × 4 matrix from camera to ground"
            )
        return self.ground_from_camera

    def stereo_factor_m_px(self) -> float:
        """fx baseline [m px]; ScanInputError for a camera that is no stereo pair."""
        if self.baseline_m <= 0.0:
            raise ScanInputError(f"{self.name} has no baseline_m; disparities need it")
        return self.fx_px * self.baseline_m

    def depth_m(self, disparity_px: ArrayLike) -> Floats:
        """Depths [m] of disparities [px]; NaN where there is none or where it is not above -offset.

        Parameters
        ----------
        disparity_px : float [px]
            NaN: none

        Returns
        -------
        float64 [m]
            depths, in the shape of the disparities
        """
        d = np.asarray(disparity_px, np.float64) + self.disparity_offset_px
        with np.errstate(divide="ignore", invalid="ignore"):
            z = self.stereo_factor_m_px() / d
        return np.where(np.isfinite(z) & (z > 0.0), z, np.nan)

    def disparity_px(self, depth_m: ArrayLike) -> Floats:
        """Disparities [px] of depths [m]; NaN where the depth is not above 0.

        Parameters
        ----------
        depth_m : float [m]
            NaN: none

        Returns
        -------
        float64 [px]
            disparities, in the shape of the depths
        """
        z = np.asarray(depth_m, np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            d = self.stereo_factor_m_px() / z - self.disparity_offset_px
        return np.where(np.isfinite(d) & (z > 0.0), d, np.nan)

    def rays(self, shape: tuple[int, int]) -> Floats:
        """(rows, cols, 3) direction of every pixel in the camera frame, z = 1.

        Parameters
        ----------
        shape : (rows, cols)
            of the image

        Returns
        -------
        (rows, cols, 3) float64
            directions, z = 1
        """
        v, u = np.indices(shape, dtype=np.float64)
        return np.stack(
            [(u - self.cx_px) / self.fx_px, (v - self.cy_px) / self.fy_px, np.ones(shape)], axis=-1
        )

    def points_m(self, depth_m: ArrayLike) -> Floats:
        """(rows, cols, 3) points in the ground frame [m], NaN where the depth is not finite.

        Parameters
        ----------
        depth_m : (rows, cols) float [m]
            NaN: none

        Returns
        -------
        (rows, cols, 3) float64 [m]
            points in the ground frame
        """
        z = depth_image(depth_m, self)
        pose = self.pose()
        points: Floats = (self.rays((z.shape[0], z.shape[1])) * z[..., None]) @ pose[:3, :3].T + pose[:3, 3]
        return points


def depth_image(depth_m: ArrayLike, camera: Camera) -> Floats:
    """A depth image that can be: NaN for no depth (0, negative, infinite or outside the camera's ranges).

    Raises
    ------
    ScanInputError
        an image without pixels, or most of whose depths lie outside the camera's ranges (wrong unit?)
    """
    z = real_array("depth_m", depth_m, (None, None))
    if z.size == 0:
        raise ScanInputError(f"the depth image of {camera.name} has shape {z.shape}; it has no pixel")
    given = np.isfinite(z) & (z > 0.0)
    inside = given & (z >= camera.min_range_m) & (z <= camera.max_range_m)
    if given.any() and 2 * inside.sum() < given.sum():
        median = float(np.median(z[given]))
        unit = "; a depth image in millimetres must be divided by 1000" if median > camera.max_range_m else ""
        raise ScanInputError(
            f"the median depth of {camera.name} is {median:g} m; expected {camera.min_range_m:g} to "
            f"{camera.max_range_m:g} m{unit}"
        )
    return np.where(inside, z, np.nan)


def rigid_transform(matrix: ArrayLike, name: str = "ground_from_camera") -> Floats:
    """A (4, 4) rotation and translation, checked to 1e-6; errors call it `name`.

    Raises
    ------
    ScanInputError
        not finite, no rotation, or another last row than 0 0 0 1
    """
    m = real_array(name, matrix, (4, 4))
    if not np.isfinite(m).all() or np.abs(m[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-9:
        raise ScanInputError(f"{name} must be finite, with the last row 0 0 0 1")
    near(name, m)
    r = m[:3, :3]
    if np.abs(r @ r.T - np.eye(3)).max() > 1e-6 or np.linalg.det(r) < 0.0:
        raise ScanInputError(f"the upper left 3 × 3 of {name} is no rotation (orthonormal, det +1)")
    return m


def looking_down(
    x_m: float, y_m: float, z_m: float, *, tilt_rad: float = 0.0, heading_rad: float = 0.0
) -> Floats:
    """(4, 4) pose of a camera at a place, its axis `tilt_rad` from straight down towards `heading_rad`.

    The image's upward direction points along the heading.

    Parameters
    ----------
    x_m : float [m]
        place
    y_m : float [m]
        place
    z_m : float [m]
        height
    tilt_rad : float [rad]
        of the axis from straight down
    heading_rad : float [rad]
        direction of the tilt

    Returns
    -------
    (4, 4) float64
        ground_from_camera

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import looking_down
    >>> ground_from_camera = looking_down(0.5, 0.2, 1.2)
    >>> np.round(ground_from_camera[:3, 3], 3), np.round(ground_from_camera[:3, 2], 3) + 0.0
    (array([0.5, 0.2, 1.2]), array([ 0.,  0., -1.]))
    """
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    ahead = np.array([c, s, 0.0])
    right = np.array([s, -c, 0.0])
    forward = math.sin(tilt_rad) * ahead - math.cos(tilt_rad) * np.array([0.0, 0.0, 1.0])
    down = np.cross(forward, right)
    made = np.eye(4)
    made[:3, :3] = np.stack([right, down, forward], axis=1)
    made[:3, 3] = (x_m, y_m, z_m)
    return made
