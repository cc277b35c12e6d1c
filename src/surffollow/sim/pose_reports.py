"""Pose reports of a simulated robot: measured now, sent when their latency is over, kept for the demands."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
REPORTS_KEPT = 256


class PoseReports:
    """Measured poses on their way to the service, and those that it has.

    Parameters
    ----------
    latency_s : float [s]     from a measurement to its report
    first : (7,) float64      pose that counts as the newest before any report
    """

    def __init__(self, latency_s: float, first: Floats) -> None:
        self._latency_ns = round(latency_s * 1e9)
        self._waiting: deque[tuple[int, Floats]] = deque()
        self.sent: dict[int, Floats] = {}
        self.newest = first

    def measure(self, t_ns: int, pose: Floats) -> None:
        """Take a pose (7,) that is true at `t_ns` [ns]; x, y, z [m], qx, qy, qz, qw."""
        self._waiting.append((t_ns, pose))

    def due(self, now_ns: int) -> list[tuple[int, Floats]]:
        """Take the reports that are due: (when it was true [ns], pose (7,)), oldest first."""
        out = []
        while self._waiting and self._waiting[0][0] <= now_ns - self._latency_ns:
            t_ns, pose = self._waiting.popleft()
            self.newest = self.sent[t_ns] = pose
            out.append((t_ns, pose))
        while len(self.sent) > REPORTS_KEPT:
            del self.sent[next(iter(self.sent))]
        return out
