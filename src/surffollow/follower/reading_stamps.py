"""Timestamps of readings that disagree with every other time that is known.

A follower in process has no clock. Its reference time is the newest timestamp of a pose or of a step without
a reading. Readings between two reference times are a group: a batch, or those of an interval. The last one of
a group leads the reference time by a mean lead; the others lie behind it, however long the group is. A
timestamp that jumps ahead of the mean lead, or goes back behind it as far as no delay is, is wrong, or the
reference time is. The reading is dropped until two reference times more have come. If the timestamps still
disagree, they are shifted to the mean lead.
"""

from __future__ import annotations

import math

from surffollow.follower.reference_time import DEVIATIONS, RATE, ReferenceTime, follow_interval_ns
from surffollow.forecast.plant.axis_model import LONG_TAUS
from surffollow.shm.layout_adaptive import REASON_NAMES, REASON_TIMESTAMPS
from surffollow.shm.layout_follow import CHANNELS

AHEAD = "timestamps jumped ahead; readings count as new as usual"
FAST = "timestamps of readings run ahead of those of poses: the sensor's clock is fast"
# where both arrive
READINGS_AHEAD = "timestamps of readings lie ahead of those of poses by more than the pose time-out"
READINGS_BEHIND = "timestamps of readings lie behind those of poses by more than the pose time-out"
MAX_INTERVALS = 2.0  # after so many without another time, the other times stopped for a while
MIN_LEADS = 20  # burn-in of the mean lead
BACK = 0.5  # of the time that tells another clock: timestamps that go back less are for the sample hold
RELEASE = 0.5  # of the shift: timestamps nearer to the mean lead are right again
CONFIRMING_TIMES = 2  # reference times after the jump: a single one may itself be late


class ReadingStamps:
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
        self._last_ns = self._count = 0
        self._interval_ns = 0.0
        self._restarts = self._time.restarts
        self._begin()

    def _begin(self) -> None:
        self.shift_ns = 0.0
        self._waits_since = -1
        self._wait_ns = self._wait_from_ns = 0
        self._leads = self._group_time_ns = 0
        self._lead_ns = self._deviation_ns = self._least_ns = 0.0
        self._group_lead_ns = self._group_ahead_ns = 0.0
        self._is_usual = False

    @property
    def _margin_ns(self) -> float:
        return self._time.interval_ns + DEVIATIONS * self._deviation_ns

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
        renewed = time.count > self._count
        if renewed:
            self._end_group()
        lead_ns, margin_ns = float(t_ns - time.newest_ns), self._margin_ns
        self._group_lead_ns, self._group_time_ns = lead_ns, time.newest_ns
        jump_ns, steady = self._advance(t_ns)
        ahead_ns = lead_ns - self._lead_ns
        back_ns = RELEASE * self.shift_ns if self.shift_ns < 0.0 else -BACK * time.jump_ns
        self._is_usual = False
        if self._leads >= MIN_LEADS and ahead_ns < back_ns:
            if self.shift_ns < 0.0:
                # set again; later ones are late
                if renewed and (jump_ns < 0 or self._beyond_shift_ns(ahead_ns) > margin_ns):
                    self._shift(ahead_ns)
                return t_ns - int(self.shift_ns)
            return self._await(t_ns, ahead_ns, jump_ns >= 0)
        if self._leads < MIN_LEADS or ahead_ns <= margin_ns:
            self.shift_ns, self._waits_since, self._is_usual = 0.0, -1, True
            return t_ns
        if self.shift_ns > 0.0:
            before_ns = self.shift_ns - self._group_ahead_ns
            if renewed and max(before_ns, self._beyond_shift_ns(ahead_ns)) > margin_ns:
                self._shift(ahead_ns)
            return t_ns - int(self.shift_ns)
        self._is_usual = self._waits_since < 0 and steady  # then the other times are late
        return self._await(t_ns, ahead_ns, self._is_usual)

    def _advance(self, t_ns: int) -> tuple[int, bool]:
        """How far a timestamp is ahead of that of the reading before [ns], and whether it advances evenly."""
        jump_ns = t_ns - self._last_ns
        steady = jump_ns <= self._interval_ns + self._margin_ns
        if jump_ns > 0 and self._last_ns != 0:
            self._interval_ns = follow_interval_ns(self._interval_ns, float(jump_ns))
        self._last_ns = t_ns
        return jump_ns, steady

    def begin_wait(self) -> None:
        """Wait for other times, unless the timestamps turn out to be usual."""
        self._waits_since = self._time.count
        self._wait_ns, self._wait_from_ns = self._last_ns, self._time.newest_ns

    def _await(self, t_ns: int, ahead_ns: float, goes_on: bool) -> int | None:
        """Drop readings with timestamps that jumped until other times confirm the jump, then shift them."""
        if not -BACK * self._time.jump_ns <= self._lead_ns <= self._time.timeout_ns:
            self._begin()  # usual timestamps are of no use: these may be right
            return t_ns
        if self._waits_since < 0:
            if goes_on:
                return t_ns
            self.begin_wait()
        if self._time.count < self._waits_since + CONFIRMING_TIMES:
            return None
        self._shift(ahead_ns)
        self._waits_since = -1
        return t_ns - int(self.shift_ns)

    @property
    def time_of_drop_ns(self) -> int:
        """Time at the dropped reading [ns]: its timestamp may be wrong, but time passes while poses stop."""
        elapsed_ns = max(self._last_ns - self._wait_ns, 0)
        return max(self._wait_from_ns + elapsed_ns, self._time.newest_ns)

    def _beyond_shift_ns(self, ahead_ns: float) -> float:
        """How far the last group, or this reading, lies ahead of the mean lead when it is shifted [ns]."""
        return max(self._group_ahead_ns, ahead_ns) - self.shift_ns

    def _shift(self, ahead_ns: float) -> None:
        """Shift the last reading of a group to the mean lead, and this one too if it is farther ahead."""
        beyond = ahead_ns - self._group_ahead_ns > self._margin_ns
        found_ns = ahead_ns if beyond else self._group_ahead_ns
        self.shift_ns = found_ns - math.fmod(found_ns, self._time.quantum_ns)

    def _end_group(self) -> None:
        """Learn the lead of the last reading, unless the other times stopped behind it for a while."""
        time, lead_ns = self._time, self._group_lead_ns
        self._group_ahead_ns = lead_ns - self._lead_ns
        intervals, self._count = time.count - self._count, time.count
        if not self._is_usual or time.newest_ns - self._group_time_ns > (
            MAX_INTERVALS * time.interval_ns * intervals
        ):
            return
        # timestamps that stand still or run slow are not usual: right ones later would be called ahead
        if self._leads >= MIN_LEADS and self._group_ahead_ns < -time.interval_ns:
            return
        self._leads += 1
        rate = max(RATE, 1.0 / self._leads)
        self._deviation_ns += rate * (abs(self._group_ahead_ns) - self._deviation_ns)
        self._lead_ns += rate * self._group_ahead_ns
        if self._leads <= MIN_LEADS or self._lead_ns < self._least_ns:
            self._least_ns = self._lead_ns

    def is_fast(self, tau_ns: float) -> bool:
        """Whether the mean lead has grown, to one that no delay explains, at a time constant [ns]."""
        return self._lead_ns - max(self._least_ns, 0.0) - self._margin_ns > LONG_TAUS * tau_ns


class Offset:
    """How far the timestamps of readings and poses are apart as long as both arrive."""

    def __init__(self) -> None:
        self._reading_ns = self._pose_ns = 0
        self._at_reading_ns = self._at_pose_ns = 0

    def note_reading(self, t_ns: int) -> None:
        """Note the timestamp of a reading [ns]."""
        self._reading_ns = t_ns
        self._at_reading_ns = t_ns - self._pose_ns if self._pose_ns else 0

    def note_pose(self, t_ns: int) -> None:
        """Note the timestamp of a pose [ns]."""
        self._pose_ns = t_ns
        self._at_pose_ns = self._reading_ns - t_ns if self._reading_ns else 0

    @property
    def ns(self) -> int:
        """Readings' timestamps minus poses' [ns]; 0: they enclose each other, or one of them stopped."""
        if self._at_reading_ns > 0 and self._at_pose_ns > 0:
            return min(self._at_reading_ns, self._at_pose_ns)
        if self._at_reading_ns < 0 and self._at_pose_ns < 0:
            return max(self._at_reading_ns, self._at_pose_ns)
        return 0


class Timestamps:
    """Timestamps of a follower's poses, readings and other steps."""

    def __init__(self) -> None:
        self.time, self._offset = ReferenceTime(), Offset()
        self._sensors = [ReadingStamps(self.time) for _ in range(CHANNELS)]

    def reset(self) -> None:
        """Take the next timestamps as usual; those of a clock that was set back stay corrected."""
        self._sensors = [s if s.shift_ns < 0.0 else ReadingStamps(self.time) for s in self._sensors]

    def note_pose(self, t_ns: int) -> None:
        """Note a pose that was taken, true at a time [ns]."""
        self.time.add(t_ns)
        self._offset.note_pose(t_ns)

    def note_clock_set(self, t_ns: int) -> None:
        """Note that the poses' clock was set back to a time [ns]: readings that go on are of another."""
        self.time.newest_ns = t_ns
        for sensor in self._sensors:
            sensor.begin_wait()

    def check(self, t_ns: int, channel: int | None) -> tuple[int, bool]:
        """The time of a step [ns], and whether its readings are to be dropped.

        Parameters
        ----------
        t_ns : int
            as given [ns]
        channel : int or None
            the first one with a reading; None: there is none
        """
        if channel is None:
            self.time.add(t_ns)
            return t_ns, False
        sensor = self._sensors[channel]
        found = sensor.correct(t_ns)
        self._offset.note_reading(t_ns if found is None else found)
        return (sensor.time_of_drop_ns, True) if found is None else (found, False)

    def reason_of_shift(self) -> str:
        """Why timestamps are shifted; "": they are not."""
        shifts = [s.shift_ns for s in self._sensors]
        if any(shift < 0.0 for shift in shifts):
            return REASON_NAMES[REASON_TIMESTAMPS]
        return AHEAD if any(shift > 0.0 for shift in shifts) else ""

    def reason_of_drift(self, tau_ns: float) -> str:
        """Why timestamps cannot be right, at the axis' time constant [ns]; "": they may be."""
        return FAST if any(s.is_fast(tau_ns) for s in self._sensors) else ""

    def reason_of_offset(self, behind_ns: float, ahead_ns: float) -> str:
        """Why readings and poses do not meet; "": they are apart by less than these times [ns]."""
        if self._offset.ns > ahead_ns:
            return READINGS_AHEAD
        return READINGS_BEHIND if self._offset.ns < -behind_ns else ""
