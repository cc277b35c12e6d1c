"""Find a clock that stands still, or is too coarse: values change, their timestamp does not.

A follower in process has no clock of its own. While poses and readings keep one timestamp their age is 0, so
no time-out ends the demands.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import PoseError, UsageError
from surffollow.follower.kernel_time import CLOSE_POSES, SHIFT_NS

_REMEDY = "the clock stands still or is too coarse; use one that runs, such as time.monotonic_ns()"


class StandingClock:
    """Count poses, and steps with readings, that changed while their timestamp did not."""

    def __init__(self) -> None:
        self._pose_ns = self._step_ns = 0
        self._poses = self._steps = 0
        self._pose = b""
        self._ranges: dict[int, float] = {}

    def check_pose(self, t_ns: int, pose: NDArray[np.float64]) -> None:
        """Check the time of a pose; the same pose given again does not count.

        Parameters
        ----------
        t_ns : int              when the pose was true, in the kernels' time [ns]
        pose : (7,) float64     x y z [m], unit quaternion

        Raises
        ------
        PoseError
            the last `CLOSE_POSES` poses changed, but not their time
        """
        before, self._pose = self._pose, pose.tobytes()
        if t_ns != self._pose_ns:
            self._pose_ns, self._poses, self._steps = t_ns, 0, 0
        elif self._pose != before:
            self._poses += 1
            if self._poses >= CLOSE_POSES:
                raise PoseError(
                    f"the last {CLOSE_POSES} poses changed, but all have the time {t_ns - SHIFT_NS} ns; "
                    f"{_REMEDY}"
                )

    def check_step(self, t_ns: int, ranges_m: Sequence[float]) -> None:
        """Check the time of a step; the same readings given again do not count.

        Poses whose time advances meanwhile end the demands of readings that stay behind.

        Parameters
        ----------
        t_ns : int              time of the step, in the kernels' time [ns]
        ranges_m : numbers      per channel [m]; NaN: no reading

        Raises
        ------
        UsageError
            the readings of the last `CLOSE_POSES` steps changed, but neither their time nor that of the poses
        """
        readings = {c: r for c, r in enumerate(ranges_m) if r == r}
        if t_ns != self._step_ns:
            self._step_ns, self._steps, self._ranges = t_ns, 0, readings
        elif not readings.items() <= self._ranges.items():
            self._ranges.update(readings)
            self._steps += 1
            if self._steps >= CLOSE_POSES:
                raise UsageError(
                    f"the readings of the last {CLOSE_POSES} steps changed, but all have the time "
                    f"{t_ns - SHIFT_NS} ns, and no pose is newer; {_REMEDY}"
                )
