"""Correction of the planned height by the follower's demand and over known ground: limited and shaped."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from surffollow.apps.scan_robot_config import ScanRobotConfig

ASKED_KEPT = 200  # periods that a shaper may look back


class HeightCorrection:
    """The height that is added to the plan's.

    Parameters
    ----------
    config : ScanRobotConfig  its way, shaper and time constants
    limit_m : float [m]       most correction, up and down

    Attributes
    ----------
    correction_m : float [m]  the newest
    """

    def __init__(self, config: ScanRobotConfig, limit_m: float) -> None:
        self._config, self._limit_m = config, limit_m
        self._asked: deque[tuple[float, float, float]] = deque(maxlen=ASKED_KEPT)
        self.correction_m = 0.0

    def forget(self) -> None:
        """Forget what the shaper looks back on; the correction stays."""
        self._asked.clear()

    def update(self, t_s: float, passed_s: float, error_m: float, lift_m: float) -> float:
        """The new correction [m].

        Parameters
        ----------
        t_s : float [s]       now
        passed_s : float [s]  since the period before
        error_m : float [m]   the follower's height above the plan
        lift_m : float [m]    least correction that known ground bears; −inf: none is known
        """
        c = self._config
        error, lift = self._shaped(t_s, self._limited(error_m), self._limited(lift_m))
        if c.way == "feedforward":
            change = error - self.correction_m
            constant = c.rise_s if change > 0.0 else c.sink_s
            error = self.correction_m + change * (1.0 - math.exp(-max(passed_s, 0.0) / constant))
        self.correction_m = max(error, lift)
        return self.correction_m

    def _limited(self, height_m: float) -> float:
        return min(max(height_m, -self._limit_m), self._limit_m)

    def _shaped(self, t_s: float, error_m: float, lift_m: float) -> tuple[float, float]:
        """Both after the shaper's impulses."""
        shaper = self._config.shaper
        if shaper is None:
            return error_m, lift_m
        self._asked.append((t_s, error_m, lift_m))
        when, error, lift = np.array(self._asked).T
        at = t_s - shaper.times_s
        shaped = [float(shaper.amplitudes @ np.interp(at, when, v)) for v in (error, lift)]
        return shaped[0], shaped[1]
