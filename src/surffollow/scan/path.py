"""A scan path: columns of time, tip pose, normal, clearance and flags.

The *tip* is the middle of the body's underside. Its pose maps body to ground coordinates; the body's z
axis is the unit normal that the underside turns away from the ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.scan.attitude_angles import quaternions_of
from surffollow.scan.checks import Floats

Flags = NDArray[np.uint32]

TURN = 1  # joins two passes; not part of the scan
STOP = 2  # the tip rests here
LIFTED = 4  # raised above the envelope, so that no control point is inside the gap
WRIST_LIMIT = 8  # the attitude was clamped to the wrist's limits
UNKNOWN_BENEATH = 16  # unknown ground beneath the body or within the gap
FILLED_BENEATH = 32  # interpolated ground beneath the tip or the body
OUT_OF_REACH = 64  # outside the arm's work space
SLOWED = 128  # slower than asked, for the limits of speed and acceleration
FLAG_NAMES = (
    "turn",
    "stop",
    "lifted",
    "wrist_limit",
    "unknown_beneath",
    "filled_beneath",
    "out_of_reach",
    "slowed",
)


@dataclass(frozen=True)
class ScanPath:
    """Samples along a path, in order of time.

    Attributes
    ----------
    t_s : (n,) float64 [s]
        from 0, ascending
    position_m : (n, 3) float64 [m]
        tip in the ground frame
    normal : (n, 3) float64
        unit z axis of the body in the ground frame
    azimuth_rad : (n,) float64
        heading of the wrist's first axis (arm azimuth; lanes: 0), continuous from row to row
    clearance_m : (n,) float64 [m]
        least distance of the underside from the ground; NaN unknown
    lift_m : (n,) float64 [m]
        height of the tip above the envelope beneath it
    flags : (n,) uint32
        bits above
    passes : (n,) int32
        number of the pass; -1 on turns
    facts : dict
        how the path was made: gap_m, swath_m, region, body, limits …

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import ScanPath
    >>> xy_m = np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0]])
    >>> path = ScanPath.planar(xy_m, np.zeros(3, np.int32))       # all samples are of pass 0
    >>> len(path), path.poses.shape, path.normal[0]
    (3, (3, 7), array([0., 0., 1.]))
    >>> path.changed(t_s=np.array([0.0, 0.5, 1.0])).t_s
    array([0. , 0.5, 1. ])
    """

    t_s: Floats
    position_m: Floats
    normal: Floats
    azimuth_rad: Floats
    clearance_m: Floats
    lift_m: Floats
    flags: Flags
    passes: NDArray[np.int32]
    facts: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def planar(
        cls,
        xy_m: Floats,
        passes: NDArray[np.int32],
        *,
        azimuth_rad: Floats | None = None,
        facts: dict[str, Any] | None = None,
    ) -> ScanPath:
        """A path of x-y samples alone: z NaN, normal up, time 0, TURN where the pass is -1.

        Parameters
        ----------
        xy_m : (n, 2) float [m]
            samples
        passes : (n,) int32
            number of the pass; -1: a turn
        azimuth_rad : (n,) float [rad], optional
            azimuth of the wrist; None: 0
        facts : dict, optional
            facts that a check needs

        Returns
        -------
        ScanPath
            without heights and times
        """
        n = len(xy_m)
        normal = np.zeros((n, 3))
        normal[:, 2] = 1.0
        return cls(
            np.zeros(n),
            np.column_stack([xy_m, np.full(n, np.nan)]),
            normal,
            np.zeros(n) if azimuth_rad is None else azimuth_rad,
            np.full(n, np.nan),
            np.zeros(n),
            np.where(passes < 0, TURN, 0).astype(np.uint32),
            passes.astype(np.int32),
            dict(facts or {}),
        )

    def __len__(self) -> int:
        return len(self.t_s)

    @property
    def quaternion(self) -> Floats:
        """(n, 4) body to ground rotation x, y, z, w: the wrist's tilt at the azimuth.

        Of q and -q, which are one rotation, each row has the one nearer to the row before.
        """
        q = quaternions_of(self.normal, self.azimuth_rad)
        away = (q[1:] * q[:-1]).sum(axis=1) < 0.0
        q[1:] *= np.cumprod(np.where(away, -1.0, 1.0))[:, None]
        return q

    @property
    def poses(self) -> Floats:
        """(n, 7) tip poses x, y, z [m], qx, qy, qz, qw, as `client.ee_pos` takes them."""
        return np.column_stack([self.position_m, self.quaternion])

    def has(self, flag: int) -> NDArray[np.bool_]:
        """(n,) bool, true where any bit of `flag` is set.

        Parameters
        ----------
        flag : int
            bits of `surffollow.scan.path`

        Returns
        -------
        (n,) bool
            True: any of the bits is set
        """
        return np.asarray((self.flags & np.uint32(flag)) != 0)

    def changed(self, **columns: Any) -> ScanPath:
        """A copy with other columns.

        Parameters
        ----------
        columns : any
            columns by name

        Returns
        -------
        ScanPath
            a copy
        """
        return replace(self, **columns)

    def with_flag(self, flag: int, where: NDArray[np.bool_]) -> ScanPath:
        """A copy whose `flag` is set exactly at the given rows.

        Parameters
        ----------
        flag : int
            bits of `surffollow.scan.path`
        where : (n,) bool
            True: set, False: cleared

        Returns
        -------
        ScanPath
            a copy

        Examples
        --------
        >>> import numpy as np
        >>> from surffollow.scan import ScanPath
        >>> from surffollow.scan.path import STOP
        >>> path = ScanPath.planar(np.zeros((3, 2)), np.zeros(3, np.int32))
        >>> path.with_flag(STOP, np.array([True, False, True])).has(STOP)
        array([ True, False,  True])
        """
        cleared = self.flags & np.uint32(~flag & 0xFFFFFFFF)
        return replace(self, flags=cleared | np.where(where, np.uint32(flag), np.uint32(0)))


def flag_counts(flags: Flags, names: Sequence[str] = FLAG_NAMES) -> dict[str, int]:
    """How many samples carry each flag, by name."""
    return {name: int(np.count_nonzero(flags & np.uint32(1 << k))) for k, name in enumerate(names)}
