"""The gap from a scan's range readings: ground known so far, lift that it asks for, clearance.

The readings see the ground under the tool's middle only. Every reading corrects the map of the plan
(`scan.known_ground`) as far as the underside meets it at the poses that are looked at, unless another reading
is nearer; the whole underside is compared with the corrected ground.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from surffollow.scan.body import body_points
from surffollow.scan.checks import Floats
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.known_ground import KnownGround
from surffollow.scan.path import ScanPath

INSIDE_M = 0.01  # an underside by so much inside the gap counts as inside
READY_PART = 0.5  # of that is tolerated where the tool is lifted, against the readings' noise
CELLS_PER_GAP = 12  # without a map
POSES_AHEAD = 8
READINGS_KEPT, POSES_KEPT = 50, 100


def tolerance_m(gap_m: float, inside_m: float = INSIDE_M) -> float:
    """By how much an underside may be inside a gap [m]: half of a narrow one."""
    return min(inside_m, 0.5 * gap_m)


def body_rotations(quaternion: Floats) -> Floats:
    """(n, 3, 3) rotations of quaternions (n, 4), normalised here."""
    x, y, z, w = (quaternion / np.linalg.norm(quaternion, axis=1)[:, None]).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    made: Floats = np.moveaxis(np.array(rows), -1, 0)
    return made


class ClearanceMonitor:
    """Ground as map and readings know it, beneath the body of a path.

    Parameters
    ----------
    path : ScanPath               its facts name gap, body and swath
    ground : TerrainGrid          the map of the plan; None: only what the readings show
    inside_m : float [m]          tolerance of the gap
    """

    def __init__(self, path: ScanPath, ground: TerrainGrid | None, inside_m: float = INSIDE_M) -> None:
        self.gap_m = float(path.facts["gap_m"])
        self.inside_m = tolerance_m(self.gap_m, inside_m)
        self.body_m = body_points(path.facts.get("body_m", [[0.0, 0.0, 0.0]]))
        radius = float(np.hypot(self.body_m[:, 0], self.body_m[:, 1]).max())
        swath = float(path.facts.get("swath_m", 2.0 * radius))
        box = np.vstack([path.position_m.min(axis=0), path.position_m.max(axis=0)])[:, :2]
        margin = 2.0 * self.gap_m + radius + swath
        cell = self.gap_m / CELLS_PER_GAP
        if ground is None:
            low, size = box[0] - margin, np.ptp(box, axis=0) + 2.0 * margin
            cols, rows = (int(v) for v in np.ceil(size / cell))
            unknown = np.full((rows, cols), np.nan)
            local = TerrainGrid.of(unknown, origin_m=low, grid_m=cell)
        else:
            local = ground.window([*box[0], *(box[1] + 1e-9)], margin)
        self._underside_m = radius + self.gap_m
        self.ground = KnownGround(local, self._underside_m)
        self._beneath = self.ground.beneath(self.body_m)
        self._readings: deque[tuple[int, float]] = deque(maxlen=READINGS_KEPT)
        self._poses: deque[tuple[int, Floats]] = deque(maxlen=POSES_KEPT)
        self._last_ns = 0

    def look_ahead(self, ahead_m: float) -> None:
        """Let readings correct the map as far as poses `ahead_m` [m] along the path meet it."""
        self.ground.reach_m = self._underside_m + ahead_m

    def pose(self, t_ns: int, pose: Floats) -> None:
        """Take a reported pose (7,), then the readings that it and the one before bracket."""
        self._poses.append((t_ns, pose))
        while self._readings and self._readings[0][0] <= t_ns:
            when, distance = self._readings.popleft()
            self._measured(when, distance)

    def reading(self, t_ns: int, distance_m: float) -> None:
        """Take a range [m], true at `t_ns` [ns]; one that was taken already, or NaN, is passed over."""
        if t_ns > self._last_ns and np.isfinite(distance_m):
            self._last_ns = t_ns
            self._readings.append((t_ns, distance_m))

    def _measured(self, t_ns: int, distance_m: float) -> None:
        times = np.array([t for t, _ in self._poses])
        k = int(np.searchsorted(times, t_ns))
        if not 0 < k < len(times):
            return
        w = (t_ns - times[k - 1]) / (times[k] - times[k - 1])
        pose = (1.0 - w) * self._poses[k - 1][1] + w * self._poses[k][1]
        axis = body_rotations(pose[None, 3:])[0][:, 2]
        self.ground.take(pose[:3] - distance_m * axis)

    def lift_m(self, poses: Floats, least_m: float = 0.0) -> float:
        """Least lift of poses (n, 7) with which the underside is clear, but for a part of the tolerance [m].

        Parameters
        ----------
        poses : (n, 7) [m]
        least_m : at least this; below 0, the answer says how far the poses may be lowered [m]
        """
        low = poses[:, :3] + np.array([0.0, 0.0, least_m])
        gap = self.gap_m - READY_PART * self.inside_m
        return least_m + float(self._beneath.lifts(low, poses[:, 3:], gap).max())

    def is_inside(self, poses: Floats) -> NDArray[np.bool_]:
        """(n,) whether a part of the underside is more than the tolerance inside the gap."""
        return self._beneath.lifts(poses[:, :3], poses[:, 3:], self.gap_m - self.inside_m) > 0.0

    def clearance_m(self, pose: Floats) -> float:
        """Least distance of the underside at a pose (7,) from known ground, at most the gap [m].

        Below 0: known ground is above it.
        """
        return float(self._beneath.distances(pose[None, :3], pose[None, 3:], self.gap_m)[0])
