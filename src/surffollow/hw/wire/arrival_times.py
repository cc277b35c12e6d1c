"""Timestamps of a sensor with a regular period, from arrivals that the machine delays now and then.

The time at which a read returns, less the bytes' time on the line, is never before the frame truly began,
but may be milliseconds late on a busy machine: the kernel hands input over in a thread of normal priority.
Delayed frames pile up and come in one read, so that their number distinguishes a delay from a pause.
"""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Sequence

MIN_INCREMENTS = 32  # before a period is identified
WINDOW = 64  # frames in which one, at least, is taken to have come without delay
REGULAR = 0.15  # of the period: median deviation of a regular sensor's increments
PAUSE = 3.0  # periods without an explanation: the sensor paused; shorter ones show in a window
MAX_PAUSES = 8  # in a window; with more there is no regular period
PERIODS = 256  # over which the period is measured


class ArrivalClock:
    """Timestamps of consecutive frames; a sensor without a regular period keeps those of its arrivals."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget everything: the line was opened anew, or input was rejected."""
        self.period_ns = 0.0  # 0: not identified
        self._last_ns = 0.0
        self._arrived_ns = 0
        self._increments: deque[int] = deque(maxlen=WINDOW)
        self._stamps: deque[float] = deque(maxlen=PERIODS)
        self._late: deque[float] = deque(maxlen=WINDOW)
        self._pauses = self._seen = 0

    def stamps(self, arrivals_ns: Sequence[int]) -> list[int]:
        """When the frames of one read began [ns].

        Parameters
        ----------
        arrivals_ns : for each frame, oldest first, the read's time less the time on the line of the bytes
            from its first one on; ascending, and no sooner than the frame

        Returns
        -------
        list of int   ascending; no later than their arrivals, unless the timestamp before is
        """
        if not arrivals_ns:
            return []
        out = self._regularised(arrivals_ns) if self.period_ns else [float(a) for a in arrivals_ns]
        if out[0] <= self._last_ns:
            out = [max(t, self._last_ns + 1.0 + k) for k, t in enumerate(out)]
        for arrived in arrivals_ns:
            if self._arrived_ns:
                self._increments.append(arrived - self._arrived_ns)
            self._arrived_ns = arrived
        self._stamps.extend(out)
        self._last_ns = out[-1]
        self._seen += len(out)
        if self._seen >= MIN_INCREMENTS // 2:
            self._seen = 0
            self._identify_period()
        return [round(t) for t in out]

    def _regularised(self, arrivals_ns: Sequence[int]) -> list[float]:
        n, period = len(arrivals_ns), self.period_ns
        late = arrivals_ns[-1] - (self._last_ns + n * period)
        if late > PAUSE * period and arrivals_ns[-1] - self._arrived_ns < (n + 1) * period:
            self.restart()  # it grew frame by frame: not a pause, the period is another one now
            return [float(a) for a in arrivals_ns]
        if late > PAUSE * period:
            self._pauses += 1
            self._late.clear()
            self._stamps.clear()
            return [min(a, arrivals_ns[-1] - (n - 1 - k) * period) for k, a in enumerate(arrivals_ns)]
        self._late.append(late)
        shift = 0.0
        if len(self._late) == WINDOW and (shift := max(0.0, min(self._late))) > 0.0:
            self._late.clear()  # none of them came sooner: the timestamps are too early
        first = self._last_ns + shift
        out = [first + (k + 1) * period for k in range(n)]
        early = max(t - a for t, a in zip(out, arrivals_ns))
        return [t - early for t in out] if early > 0.0 else out

    def _envelope(self, usual_ns: float) -> float:
        """The period between the least delayed frames of both ends of the window."""
        arrived = [0.0]
        for step in self._increments:
            arrived.append(arrived[-1] + step)
        late = [t - k * usual_ns for k, t in enumerate(arrived)]
        third = len(late) // 3
        first = min(range(third), key=late.__getitem__)
        last = min(range(len(late) - third, len(late)), key=late.__getitem__)
        return (arrived[last] - arrived[first]) / (last - first)

    def _identify_period(self) -> None:
        """Identify the period, or measure the one that was identified."""
        if self.period_ns:
            if self._pauses > MAX_PAUSES:
                self.restart()
            elif len(self._stamps) > WINDOW and not self._pauses:
                self.period_ns = (self._stamps[-1] - self._stamps[0]) / (len(self._stamps) - 1)
            self._pauses = max(0, self._pauses - 1)
            return
        if len(self._increments) < MIN_INCREMENTS:
            return
        usual = statistics.median(self._increments)
        if statistics.median(abs(i - usual) for i in self._increments) < REGULAR * usual:
            self.period_ns = self._envelope(float(usual))
            self._stamps.clear()
            self._stamps.append(self._last_ns)
