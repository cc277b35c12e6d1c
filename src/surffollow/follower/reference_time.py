"""The reference time of a follower in process: the newest timestamp of a pose or a step without reading."""

from __future__ import annotations

import math

from surffollow.forecast.quantities import LONG_GAP_NS

RATE = 0.05  # gain per value of the mean intervals, and of the mean lead of readings and its deviation
DEVIATIONS = 4.0  # usual ones beside a value that is no outlier
# at the reference time 1, divisible by all reference times: whole nanoseconds would not scale bit for bit
QUANTUM_NS = 1 << 12  # of a shift


def follow_interval_ns(usual_ns: float, interval_ns: float) -> float:
    """Mean interval [ns] after one more, which counts as two usual ones at most."""
    if usual_ns == 0.0:
        return interval_ns
    return usual_ns + RATE * (min(interval_ns, 2.0 * usual_ns) - usual_ns)


class ReferenceTime:
    """Newest timestamp of poses and of steps without a reading.

    Attributes
    ----------
    newest_ns : int
        the reference time [ns]; 0: unknown
    interval_ns : float
        mean interval between reference times [ns]
    count : int
        reference times since the start
    restarts : int
        changes of the clock
    jump_ns : float
        a time that goes back so far is that of another clock [ns]
    quantum_ns : float
        shifts of timestamps are multiples of it [ns]
    timeout_ns : float
        readings that lead the reference time by more cannot be used: the pose time-out [ns]
    """

    def __init__(self) -> None:
        self.timeout_ns = math.inf
        self.set_scale(1.0)
        self.restart(0)

    def set_scale(self, scale: float) -> None:
        """Scale the constants: a multiple of the usual reference time, a power of two."""
        self.jump_ns, self.quantum_ns = LONG_GAP_NS * scale, QUANTUM_NS * scale

    def restart(self, t_ns: int) -> None:
        """Reset the statistics and begin at a time.

        Parameters
        ----------
        t_ns : int
            reference time [ns]; 0: unknown
        """
        self.newest_ns, self.interval_ns, self.count, self.restarts = t_ns, 0.0, 0, 0

    def add(self, t_ns: int) -> None:
        """Add a reference time.

        Parameters
        ----------
        t_ns : int
            timestamp of a pose, or of a step without a reading [ns]
        """
        interval_ns = t_ns - self.newest_ns
        if self.newest_ns == 0:
            self.newest_ns = t_ns
        elif interval_ns > 0:
            self.interval_ns = follow_interval_ns(self.interval_ns, float(interval_ns))
            self.newest_ns = t_ns
            self.count += 1
        elif interval_ns < -max(DEVIATIONS * self.interval_ns, self.jump_ns):
            restarts = self.restarts + 1
            self.restart(t_ns)
            self.restarts = restarts
