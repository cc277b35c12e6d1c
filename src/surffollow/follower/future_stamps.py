"""Timestamps of readings that jump ahead of every time that is known.

A follower in process has no clock. It knows the time from poses and from steps without a reading; a reading
leads that time by a usual lead. A stamp that jumps ahead of it is wrong, or everything else is late. The
reading is dropped until two more times are told. If the stamps are still ahead then, they all count as new as
usual.
"""

from __future__ import annotations

RATE = 0.05  # of the usual lead, its deviation and the usual interval, per value
DEVIATIONS = 4.0  # mean absolute deviations of the lead, beside one interval: what is usual
MIN_LEADS = 20  # before anything is judged
CONFIRMING_TIMES = 2  # told after the jump: a single one may be late for itself


class KnownTime:
    """The newest time [ns] of poses and of steps without a reading, and how often it is told."""

    def __init__(self) -> None:
        self.begin_anew(0)

    def begin_anew(self, t_ns: int) -> None:
        """Forget what is usual; 0 ns: nothing is known."""
        self.newest_ns, self.interval_ns, self.told, self.restarts = t_ns, 0.0, 0, 0

    def tell(self, t_ns: int) -> None:
        """Take a time."""
        interval_ns = t_ns - self.newest_ns
        if self.newest_ns == 0:
            self.newest_ns = t_ns
        elif interval_ns > 0:
            if self.interval_ns == 0.0:
                self.interval_ns = float(interval_ns)
            self.interval_ns += RATE * (min(interval_ns, 2.0 * self.interval_ns) - self.interval_ns)
            self.newest_ns = t_ns
            self.told += 1
        elif interval_ns < -DEVIATIONS * self.interval_ns:  # another clock
            restarts = self.restarts + 1
            self.begin_anew(t_ns)
            self.restarts = restarts


class FutureStamps:
    """Correct the stamps of one sensor, in the order in which its readings and the times come.

    Parameters
    ----------
    time : KnownTime
    """

    def __init__(self, time: KnownTime) -> None:
        self._time = time
        self._begin_anew()

    def _begin_anew(self) -> None:
        self.shift_ns = 0.0
        self._waits_since = -1
        self._leads = 0
        self._lead_ns = self._deviation_ns = 0.0
        self._last_ns = 0
        self._restarts = self._time.restarts

    def correct(self, t_ns: int) -> int | None:
        """The stamp of a reading, corrected; None: the reading is to be dropped.

        Parameters
        ----------
        t_ns : int
            as it was given [ns]

        Returns
        -------
        int or None
        """
        time = self._time
        if time.newest_ns == 0:
            return t_ns
        if self._restarts != time.restarts:
            self._begin_anew()
        lead_ns = float(t_ns - time.newest_ns)
        jump_ns, self._last_ns = t_ns - self._last_ns, t_ns
        margin_ns = time.interval_ns + DEVIATIONS * self._deviation_ns
        ahead_ns = lead_ns - self._lead_ns
        if self._leads < MIN_LEADS or ahead_ns <= margin_ns:
            self.shift_ns, self._waits_since = 0.0, -1
            if self._leads < MIN_LEADS or ahead_ns >= -margin_ns:  # stamps that are too old are not usual
                self._learn(lead_ns)
            return t_ns
        if self.shift_ns != 0.0:
            if abs(ahead_ns - self.shift_ns) > margin_ns:
                self.shift_ns = ahead_ns
            return t_ns - int(self.shift_ns)
        if self._waits_since >= 0:
            if time.told < self._waits_since + CONFIRMING_TIMES:
                return None
            self.shift_ns, self._waits_since = ahead_ns, -1
            return t_ns - int(ahead_ns)
        if jump_ns <= margin_ns:  # the stamps go on; what is late are the other times
            self._learn(lead_ns)
            return t_ns
        self._waits_since = time.told
        return None

    def _learn(self, lead_ns: float) -> None:
        self._leads += 1
        rate = max(RATE, 1.0 / self._leads)
        self._deviation_ns += rate * (abs(lead_ns - self._lead_ns) - self._deviation_ns)
        self._lead_ns += rate * (lead_ns - self._lead_ns)
