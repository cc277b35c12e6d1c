"""Find that the simulated robot moves over another ground than the one that the simulated sensor sees."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.sim.surfaces import HeightField

OTHER_GROUND = "the simulated robot moves over another ground than the simulated sensor sees"
TOLERANCE = 0.01  # of the sensor's window: grounds of other grid spacings differ by less


class GroundCheck:
    """Compares the height that a robot publishes for the ground under its tool with the sensor's own ground.

    Parameters
    ----------
    field : HeightField
        the ground that the sensor sees
    window_m : float
        length of the sensor's window [m]
    """

    def __init__(self, field: HeightField, window_m: float) -> None:
        self._field, self._tolerance_m = field, TOLERANCE * window_m
        self._epoch = 0
        self.note = ""

    def look(self, record: NDArray[Any] | None, epoch: int) -> None:
        """Compare once; `note` stays until another robot writes: other grounds cross each other.

        Parameters
        ----------
        record : (1,) structured `WorldPose`, or None: nothing was published yet
        epoch : int
            of the writer
        """
        if epoch != self._epoch:
            self._epoch, self.note = epoch, ""
        if record is None or self.note:
            return
        now = record[0]
        x, y, _, qx, qy, qz, qw = (float(v) for v in now["pose"])
        standoff_m, ground_m = float(now["standoff_m"]), float(now["ground_m"])
        # the published height is that under the axis of the tool
        x -= standoff_m * 2.0 * (qx * qz + qw * qy)
        y -= standoff_m * 2.0 * (qy * qz - qw * qx)
        apart_m = ground_m - self._field.height_m(x, y) if np.isfinite([x, y, ground_m]).all() else 0.0
        if abs(apart_m) > self._tolerance_m:
            self.note = (
                f"{OTHER_GROUND}: {1e3 * abs(apart_m):.3g} mm apart at x {x:.3f} m, y {y:.3f} m. Give both "
                "the same surface, seed, grid and field ([driver.world], options of surffollow simulate)"
            )
