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


class FutureStamps:
    """Correct stamps [ns] in the order in which poses, steps and readings come."""

    def __init__(self) -> None:
        self.shift_ns = 0.0
        self.is_waiting = False
        self.known_ns = 0  # the newest time told; 0: none
        self._interval_ns = 0.0
        self._told_since = 0
        self._leads = 0
        self._lead_ns = self._deviation_ns = 0.0
        self._last_ns = 0

    def tell_time(self, t_ns: int) -> None:
        """Take the time of a pose, or of a step without a reading."""
        if self.known_ns != 0:
            interval_ns = t_ns - self.known_ns
            if -self._interval_ns * DEVIATIONS <= interval_ns <= 0:
                return
            if interval_ns < 0:
                self.__init__()  # type: ignore[misc]
            elif self._interval_ns == 0.0:
                self._interval_ns = float(interval_ns)
            else:
                self._interval_ns += RATE * (min(interval_ns, 2.0 * self._interval_ns) - self._interval_ns)
        self.known_ns = t_ns
        self._told_since += 1

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
        if self.known_ns == 0:
            return t_ns
        lead_ns = float(t_ns - self.known_ns)
        jump_ns, self._last_ns = t_ns - self._last_ns, t_ns
        margin_ns = self._interval_ns + DEVIATIONS * self._deviation_ns
        ahead_ns = lead_ns - self._lead_ns
        if self._leads < MIN_LEADS or ahead_ns <= margin_ns:
            self.shift_ns, self.is_waiting = 0.0, False
            if self._leads < MIN_LEADS or ahead_ns >= -margin_ns:  # stamps that are too old are not usual
                self._learn(lead_ns)
            return t_ns
        if self.shift_ns != 0.0:
            if abs(ahead_ns - self.shift_ns) > margin_ns:
                self.shift_ns = ahead_ns
            return t_ns - int(self.shift_ns)
        if self.is_waiting:
            if self._told_since < CONFIRMING_TIMES:
                return None
            self.shift_ns, self.is_waiting = ahead_ns, False
            return t_ns - int(ahead_ns)
        if jump_ns <= margin_ns:  # the stamps go on; what is late are the other times
            self._learn(lead_ns)
            return t_ns
        self.is_waiting, self._told_since = True, 0
        return None

    def _learn(self, lead_ns: float) -> None:
        self._leads += 1
        rate = max(RATE, 1.0 / self._leads)
        self._deviation_ns += rate * (abs(lead_ns - self._lead_ns) - self._deviation_ns)
        self._lead_ns += rate * (lead_ns - self._lead_ns)
