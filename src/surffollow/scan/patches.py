"""Split depth images and point clouds into coherent patches, and drop those that cannot be terrain (§2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter

from surffollow.scan.camera import Camera, depth_image
from surffollow.scan.checks import Floats, positive, region_of
from surffollow.scan.patch_labels import label_patches, patch_sums
from surffollow.scan.patch_support import floating_patches
from surffollow.scan.seen_beneath import LowestSeen

KEPT, TOO_SMALL, OVERHANGING, OUTSIDE, FLOATING, RAISED = 0, 1, 2, 3, 4, 5
OUTCOMES = ("kept", "too_small", "overhanging", "outside", "floating", "raised")
SUPPORT_PX = 3.0  # least side of the cells in which patches meet, in pixels at the median depth
CELL_PX = 2.0  # side of the cells in which something is seen beneath a patch, in pixels at the median depth
STEEPEST_RAD = math.radians(80.0)  # of a patch's mean normal from up
JUMP_PX = 1.0  # of disparity between neighbours
SLOPE_FACTOR, SLOPE_BLOCK = 1.5, 5  # of a cloud's own slope; cells per block, wider than most objects
JUMP_PER_M = 0.02  # of a camera without baseline: depth jump over depth squared [1 / m]


@dataclass(frozen=True)
class Patches:
    """Patches of one image.

    Attributes
    ----------
    labels : (rows, cols) int32
        number of the patch, -1 without data
    outcome : (n,) uint8
        per patch: KEPT, RAISED (kept as an obstacle) or why it was dropped
    pixels : (n,) int64
        per patch
    terrain : (rows, cols) bool
        pixels of kept and raised patches within the region

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import Camera, coherent_patches, looking_down
    >>> camera = Camera(60.0, 60.0, 31.5, 23.5, looking_down(0.5, 0.5, 1.2), baseline_m=0.1)
    >>> patches = coherent_patches(np.full((48, 64), 1.2), camera)
    >>> patches.counts()["kept"], patches.pixel_counts()["kept"]
    (1, 3072)
    """

    labels: NDArray[np.int32]
    outcome: NDArray[np.uint8]
    pixels: NDArray[np.int64]
    terrain: NDArray[np.bool_]

    @property
    def fate(self) -> NDArray[np.uint8]:
        """The name of `outcome` before release 0.1.0; it works for one release."""
        return self.outcome

    def having(self, *outcomes: int) -> NDArray[np.bool_]:
        """Pixels of patches with one of these outcomes.

        Parameters
        ----------
        outcomes : int
            indices into `OUTCOMES`

        Returns
        -------
        (rows, cols) bool array
        """
        if not len(self.outcome):
            return np.zeros(self.labels.shape, np.bool_)
        wanted = np.isin(self.outcome, outcomes)
        return np.asarray((self.labels >= 0) & wanted[np.maximum(self.labels, 0)])

    def counts(self) -> dict[str, int]:
        """Number of patches by outcome."""
        return {name: int(np.count_nonzero(self.outcome == k)) for k, name in enumerate(OUTCOMES)}

    def pixel_counts(self) -> dict[str, int]:
        """Number of pixels by the outcome of their patch."""
        return {name: int(self.pixels[self.outcome == k].sum()) for k, name in enumerate(OUTCOMES)}


def coherent_patches(
    depth_m: ArrayLike,
    camera: Camera,
    *,
    jump_px: float = JUMP_PX,
    min_pixels: int = 50,
    support_m: float = 0.1,
    steepest_rad: float = STEEPEST_RAD,
    region: Sequence[float] | None = None,
    border_px: int = 0,
    seen: LowestSeen | None = None,
) -> Patches:
    """Label connected pixels without depth jumps, and say which patches can be terrain.

    Parameters
    ----------
    depth_m : (rows, cols) float [m]
        NaN or 0: none
    camera : Camera
        with its pose
    jump_px : float [px]
        largest difference of disparity between neighbours of a patch; in
        depth it grows with z², as stereo noise does. Without baseline: 0.02 z² per unit of `jump_px`
    min_pixels : int
        smaller patches are *too small*
    support_m : float [m]
        a patch hangs when what lies below and beside it is farther below than this, along most of its
        outline. It is *floating* when something was seen beneath it, farther below than this; else it is
        *raised*, and stays as an obstacle
    steepest_rad : float [rad]
        a patch whose mean normal is farther from up is *overhanging*
    region : (x_min, y_min, x_max, y_max) work space [m]; a patch without a pixel in it is *outside*
    border_px : int
        pixels this close to a jump or hole are no terrain: a block matcher
        widens objects by half of its block. A patch that would lose all of its pixels keeps them
    seen : LowestSeen, optional
        what all views saw; None: what this one saw

    Returns
    -------
    Patches

    Raises
    ------
    ScanInputError
        no pixel, depths that cannot be, a camera without pose

    Notes
    -----
    Paper §2. The mean normal is the area-weighted one, turned towards the camera. A post that is seen from
    above has no visible sides, so a missing side is no proof that something floats (docs/decisions/0062).

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import Camera, coherent_patches, looking_down
    >>> camera = Camera(60.0, 60.0, 31.5, 23.5, looking_down(0.5, 0.5, 1.2), baseline_m=0.1)
    >>> depth_m = np.full((48, 64), 1.2)
    >>> depth_m[:12, :20] = 0.5                               # a branch; the ground beneath it is seen
    >>> patches = coherent_patches(depth_m, camera)
    >>> patches.counts()["floating"], bool(patches.terrain[5, 5])
    (1, False)
    >>> depth_m = np.full((48, 64), 1.2)
    >>> depth_m[10:30, 20:40] = 0.5                           # it hides what is beneath it: an obstacle
    >>> patches = coherent_patches(depth_m, camera)
    >>> patches.counts()["raised"], bool(patches.terrain[20, 30])
    (1, True)
    """
    z = depth_image(depth_m, camera)
    points = camera.points_m(z)
    made = classify(
        z,
        points,
        _jumps(z, camera, jump_px),
        camera.pose()[:3, 3],
        min_pixels=min_pixels,
        support_m=positive("support_m", support_m),
        cell_m=max(support_m, _pixel_size(z, camera, SUPPORT_PX)),
        steepest_rad=steepest_rad,
        region=region,
        seen=LowestSeen(_pixel_size(z, camera, CELL_PX)) if seen is None else seen,
        add=seen is None,
    )
    if border_px <= 0 or not made.terrain.any():
        return made
    inner = made.terrain & ~_near_border(made, border_px)
    left = np.bincount(made.labels[inner], minlength=len(made.outcome)) > 0
    return replace(made, terrain=made.terrain & (inner | ~left[np.maximum(made.labels, 0)]))


def seen_points(
    depth_m: ArrayLike, camera: Camera, *, jump_px: float = JUMP_PX, min_pixels: int = 50
) -> tuple[Floats, float]:
    """(n, 3) points [m] of patches that are large enough, and the side of cells that they fill [m].

    Parameters
    ----------
    depth_m, camera, jump_px, min_pixels
        as `coherent_patches`
    """
    z = depth_image(depth_m, camera)
    labels = np.empty(z.shape, np.int32)
    n = int(label_patches(z, _jumps(z, camera, jump_px), np.empty(z.size, np.int32), labels))
    pixels = np.bincount(labels[labels >= 0], minlength=max(n, 1))
    large = (labels >= 0) & (pixels[np.maximum(labels, 0)] >= min_pixels)
    points: Floats = camera.points_m(z)[large]
    return points, _pixel_size(z, camera, CELL_PX)


def _jumps(z: Floats, camera: Camera, jump_px: float) -> Floats:
    scale = 1.0 / camera.stereo_factor_m_px() if camera.baseline_m > 0.0 else JUMP_PER_M
    made: Floats = positive("jump_px", jump_px, "px") * scale * z * z
    return made


def _near_border(patches: Patches, border_px: int) -> NDArray[np.bool_]:
    """(rows, cols) bool: a pixel of another patch, or without data, next to one within border_px."""
    labels = patches.labels
    edge = np.zeros(labels.shape, np.bool_)
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        change = labels[a] != labels[b]
        edge[a] |= change
        edge[b] |= change
    return np.asarray(maximum_filter(edge, size=2 * border_px + 1, mode="constant"), np.bool_)


def classify(
    z: Floats,
    points: Floats,
    jump: Floats,
    eye: Floats,
    *,
    min_pixels: int,
    support_m: float,
    cell_m: float,
    steepest_rad: float,
    region: Sequence[float] | None,
    seen: LowestSeen | None = None,
    add: bool = False,
) -> Patches:
    """Patches of an image of points (rows, cols, 3) whose values z may jump by at most `jump` per pixel.

    Parameters
    ----------
    z : (rows, cols) float64     value whose jumps end a patch; NaN: no point
    points : (rows, cols, 3) float64 [m]  the points, ground frame
    jump : (rows, cols) float64  greatest change of z to a neighbour within a patch
    eye : (3,) float64 [m]       place from which the points were seen
    min_pixels : int             smaller patches are TOO_SMALL
    support_m : float [m]        as in `floating_patches`
    cell_m : float [m]           as in `floating_patches`
    steepest_rad : float [rad]   greatest angle of a patch's mean normal from up
    region : (x_min, y_min, x_max, y_max) [m]  patches outside are OUTSIDE; None: everywhere
    seen : LowestSeen            what was seen: a patch which hangs is RAISED if that is no proof that it
        floats; None: each is FLOATING
    add : bool                   add the patches that are large enough to `seen` first
    """
    rows, cols = z.shape
    labels = np.empty((rows, cols), np.int32)
    n = int(label_patches(z, jump, np.empty(rows * cols, np.int32), labels))
    sums = np.zeros((n, 4))
    patch_sums(points, labels, sums)
    pixels = sums[:, 3].astype(np.int64)
    outcome = np.full(n, KEPT, np.uint8)
    inside = np.isfinite(z)
    if region is not None:
        x0, y0, x1, y1 = region_of(region)
        with np.errstate(invalid="ignore"):
            inside &= (points[..., 0] >= x0) & (points[..., 0] <= x1)
            inside &= (points[..., 1] >= y0) & (points[..., 1] <= y1)
        outcome[np.bincount(labels[inside], minlength=n) == 0] = OUTSIDE
    outcome[_overhanging(points, labels, sums, eye, steepest_rad)] = OVERHANGING
    outcome[pixels < min_pixels] = TOO_SMALL
    if seen is not None and add:
        seen.add(
            points[(labels >= 0) & (pixels >= min_pixels)[np.maximum(labels, 0)]] if n else np.empty((0, 3))
        )
    hanging = np.zeros(n, np.bool_)
    while n:
        use = (labels >= 0) & (outcome == KEPT)[np.maximum(labels, 0)]
        own, at = labels[use], points[use]
        hanging = floating_patches(at, own, pixels, support_m, cell_m)
        dropped = hanging if seen is None else seen.beneath_patches(hanging, at, own, support_m)
        if not dropped.any():
            break
        outcome[dropped] = FLOATING
    outcome[hanging & (outcome == KEPT)] = RAISED
    made = Patches(labels, outcome, pixels, inside)
    return replace(made, terrain=inside & made.having(KEPT, RAISED))


def _overhanging(
    points: Floats, labels: NDArray[np.int32], sums: Floats, eye: Floats, steepest_rad: float
) -> NDArray[np.bool_]:
    """(n,) bool: the area vector, turned towards the eye, is farther from up than allowed."""
    n = len(sums)
    area = sums[:, :3]
    good = labels >= 0
    middle = np.stack(
        [np.bincount(labels[good], weights=points[..., k][good], minlength=n) for k in range(3)], axis=1
    ) / np.maximum(sums[:, 3:], 1.0)
    towards = np.einsum("ij,ij->i", area, eye - middle)
    size = np.linalg.norm(area, axis=1)
    up = np.where(towards < 0.0, -area[:, 2], area[:, 2])
    return np.asarray((size > 0.0) & (up < math.cos(steepest_rad) * size))


def _pixel_size(z: Floats, camera: Camera, pixels: float) -> float:
    """Ground covered by some pixels at the median depth [m]: cells smaller than that would stay empty."""
    known = z[np.isfinite(z)]
    return max(pixels * float(np.median(known)) / camera.fx_px, 1e-9) if known.size else 1.0
