"""Timestamps of readings that jump ahead of every time that is known.

A follower in process has no clock. Its reference time is the newest timestamp of a pose or of a step without
a reading. The timestamp of a reading leads the reference time by a mean lead. A timestamp that jumps ahead
of the mean lead is wrong, or the reference time is late. The reading is dropped until two reference times
more have come. If the timestamps are still ahead, they are shifted back to the mean lead.
"""

from __future__ import annotations

RATE = 0.05  # gain per value of the mean lead, its mean deviation and the mean interval
DEVIATIONS = 4.0  # mean absolute deviations of the lead, in addition to one interval: the gate
MIN_LEADS = 20  # burn-in of the mean lead
CONFIRMING_TIMES = 2  # reference times after the jump: a single one may itself be late


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
    """

    def __init__(self) -> None:
        self.restart(0)

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
            if self.interval_ns == 0.0:
                self.interval_ns = float(interval_ns)
            self.interval_ns += RATE * (min(interval_ns, 2.0 * self.interval_ns) - self.interval_ns)
            self.newest_ns = t_ns
            self.count += 1
        elif interval_ns < -DEVIATIONS * self.interval_ns:  # another clock
            restarts = self.restarts + 1
            self.restart(t_ns)
            self.restarts = restarts


class FutureStamps:
    """Correct the timestamps of one sensor in the order of arrival.

    Parameters
    ----------
    time : ReferenceTime
        shared by all sensors of a follower
    """

    def __init__(self, time: ReferenceTime) -> None:
        self._time = time
        self._restart()

    def _restart(self) -> None:
        self.shift_ns = 0.0
        self._waits_since = -1
        self._leads = 0
        self._lead_ns = self._deviation_ns = 0.0
        self._last_ns = 0
        self._restarts = self._time.restarts

    def correct(self, t_ns: int) -> int | None:
        """Correct the timestamp of a reading.

        Parameters
        ----------
        t_ns : int
            timestamp of the reading as given [ns]

        Returns
        -------
        int or None
            corrected timestamp [ns]; None: the reading is to be dropped
        """
        time = self._time
        if time.newest_ns == 0:
            return t_ns
        if self._restarts != time.restarts:
            self._restart()
        lead_ns = float(t_ns - time.newest_ns)
        jump_ns, self._last_ns = t_ns - self._last_ns, t_ns
        margin_ns = time.interval_ns + DEVIATIONS * self._deviation_ns
        ahead_ns = lead_ns - self._lead_ns
        if self._leads < MIN_LEADS or ahead_ns <= margin_ns:
            self.shift_ns, self._waits_since = 0.0, -1
            # timestamps that stand still or run slow are not usual: right ones later would be called ahead
            if self._leads < MIN_LEADS or ahead_ns >= -time.interval_ns:
                self._learn(lead_ns)
            return t_ns
        if self.shift_ns != 0.0:
            if abs(ahead_ns - self.shift_ns) > margin_ns:
                self.shift_ns = ahead_ns
            return t_ns - int(self.shift_ns)
        if self._waits_since >= 0:
            if time.count < self._waits_since + CONFIRMING_TIMES:
                return None
            self.shift_ns, self._waits_since = ahead_ns, -1
            return t_ns - int(ahead_ns)
        if jump_ns <= margin_ns:  # the timestamps go on; the other times are late
            self._learn(lead_ns)
            return t_ns
        self._waits_since = time.count
        return None

    def _learn(self, lead_ns: float) -> None:
        self._leads += 1
        rate = max(RATE, 1.0 / self._leads)
        self._deviation_ns += rate * (abs(lead_ns - self._lead_ns) - self._deviation_ns)
        self._lead_ns += rate * (lead_ns - self._lead_ns)
