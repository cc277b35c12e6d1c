"""The response test of a range sensor as a plain state machine, one sentence per line."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from surffollow.forecast.sensing import response as r
from surffollow.forecast.setpoint.tested_setpoint import UNSEEN_RISE

RUN, HOLD, LIFT, NONE = "run", "hold", "lift", "none"


@dataclass
class NaiveResponse:
    """State of one sensor; lengths in metres, times in seconds."""

    tau_s: float
    interval_s: float
    standoff_m: float
    sigma_m: float
    gap_s: float
    lead_m: float = 0.0
    delay_s: float = 0.0
    rotation_failed: bool = False
    setpoint_m: float = 0.0
    climb_mps: float = 0.0
    applied: bool = True
    phase: str = RUN
    readings: list[float] = field(default_factory=list)
    last_ns: int | None = None
    noise_m: float = 0.0
    usual_m: float = 0.0
    began_quiet: bool = False
    settled_ns: int = 0

    def _begin_run(self, t_ns: int, z_m: float) -> None:
        self.phase, self.run_m, self.in_run = RUN, self.mean_m, 0
        self.top_z_m, self.top_ns = z_m, t_ns
        self.low_z_m, self.low_ns = z_m, t_ns
        self.shift_ns, self.shift_m = None, 0.0

    def _observe_noise(self) -> None:
        n = len(self.readings)
        if n < 3:
            return
        a, b, c = self.readings[-3:]
        seen_m = abs(c - 2.0 * b + a) / r.SECOND_DIFFERENCE
        no_more_m = 4.0 * max(self.noise_m, r.MIN_NOISE_M)
        self.noise_m += max(r.NOISE_RATE, 1.0 / (n - 2)) * (min(seen_m, no_more_m) - self.noise_m)
        if n < 2.0 / r.NOISE_RATE:
            self.usual_m = self.noise_m
        elif self.noise_m > r.QUIET_SHARE * self.usual_m:
            self.usual_m += r.USUAL_RATE * min(self.noise_m - self.usual_m, self.usual_m)

    def observe(self, t_ns: int, range_m: float, z_m: float) -> None:
        """One sample of the sensor, with the height of the tool at its time."""
        dt_s = None if self.last_ns is None else (t_ns - self.last_ns) * 1e-9
        if dt_s is None or not 0.0 < dt_s <= self.gap_s:
            self.mean_m, self.settled_ns = range_m, 0
            self._begin_run(t_ns, z_m)
        self.last_ns = t_ns
        self.readings.append(range_m)
        self._observe_noise()
        self.number = min(max(self.tau_s / self.interval_s, r.MIN_MEAN), r.MAX_MEAN)
        most_m = r.OUTLIER_SIGMAS * self.sigma_m
        newest = [reading - self.mean_m for reading in self.readings[-3:]]
        one_side = all(x > most_m for x in newest) or all(x < -most_m for x in newest)
        if len(self.readings) > 3 and one_side:
            self.mean_m = range_m
        step_m = range_m - self.mean_m
        self.mean_m += math.copysign(min(abs(step_m), most_m), step_m) / self.number
        self.in_run += 1
        if self.number < self.in_run < r.RUN_SAMPLES:
            self.run_m += (self.mean_m - self.run_m) / self.in_run
        self.band_m = r.BAND_SIGMAS * self.sigma_m / math.sqrt(self.number)
        allowed_m = self.band_m if self.phase == RUN else r.TEST_BAND_FACTOR * self.band_m
        self.noisy = self.noise_m >= r.QUIET_SHARE * self.usual_m
        noise_is_back = self.phase == NONE and self.began_quiet and self.noisy
        if abs(self.mean_m - self.run_m) > allowed_m or noise_is_back:
            if self.phase != RUN or self.shift_m > 0.0:
                back_s = self.delay_s + r.STOP_TAUS * self.tau_s + self.number * self.interval_s
                self.settled_ns = t_ns + int(1e9 * back_s)
            self._begin_run(t_ns, z_m)
            self.usual_m = min(self.usual_m, self.noise_m / r.QUIET_SHARE)
        elif self.phase == RUN and t_ns < self.settled_ns:
            self._begin_run(t_ns, z_m)
        elif self.phase == RUN:
            self._look_for_a_motion(t_ns, z_m)
        elif self.phase == HOLD:
            self._hold(t_ns, z_m)
        elif self.phase == LIFT:
            self._lift(t_ns, z_m)

    def _look_for_a_motion(self, t_ns: int, z_m: float) -> None:
        if z_m > self.top_z_m:
            self.top_z_m, self.top_ns = z_m, t_ns
        if z_m < self.low_z_m:
            self.low_z_m, self.low_ns = z_m, t_ns
        descent_m, ascent_m = self.top_z_m - z_m, z_m - self.low_z_m
        fast = self.number >= r.MAX_MEAN
        rises = r.ASCENT_SHARE * ascent_m > descent_m and descent_m < self.band_m
        if rises and self.number <= r.MIN_MEAN:
            return
        band_m = self.band_m
        if rises:
            band_m = max(band_m, r.BAND_SIGMAS * self.usual_m / math.sqrt(self.number))
        if rises:
            motion_m, moved_m, since_ns = r.ASCENT_SHARE * ascent_m, ascent_m, t_ns - self.low_ns
        else:
            motion_m, moved_m, since_ns = descent_m, descent_m, t_ns - self.top_ns
        rate_mps = moved_m / max(since_ns * 1e-9, self.interval_s)
        ahead = abs(self.lead_m) >= r.MIN_LEAD_M
        error_m = 0.0 if ahead else abs(self.run_m - self.standoff_m)
        no_lag = error_m > r.LAG_TAUS * self.tau_s * rate_mps
        work = error_m * motion_m / (band_m * self.standoff_m)
        wrong = error_m > band_m and no_lag and work > r.ERROR_MOTION
        quiet = not self.noisy
        enough = motion_m > r.MOTION_BANDS * band_m
        suspicious = enough and (wrong or quiet or self.rotation_failed)
        far = motion_m > r.FAR_DESCENT * self.standoff_m
        long = self.in_run > r.MIN_LONG_MEANS * self.number
        doubtful = fast and enough and no_lag and work > r.SHIFT_ERROR_MOTION
        distant = motion_m > r.SHIFT_DESCENT * self.standoff_m
        if long and self.shift_ns is None and (doubtful or distant or (rises and suspicious)):
            self.shift_ns, self.shift_m = t_ns, r.SHIFT_BANDS * band_m
        allowed_s = self.delay_s + r.STOP_TAUS * self.tau_s + r.MIN_MEANS * self.number * self.interval_s
        unanswered = self.shift_ns is not None and (t_ns - self.shift_ns) * 1e-9 > allowed_s
        begun = self.in_run > r.MIN_MEANS * self.number
        if unanswered or (not rises and ((long and far) or (begun and suspicious))):
            self.phase, self.begin_ns, self.begin_z_m, self.rate_mps = HOLD, t_ns, z_m, rate_mps
            self.rose, self.began_quiet = rises, quiet
            if rises:
                self.phase, self.lifted = LIFT, 0
                self.added_m = r.MOTION_BANDS * band_m + self.tau_s * rate_mps
                self.lift_m = self.shift_m + self.added_m
                self.lead_before_m = self._lead_m(z_m)

    def _lead_m(self, z_m: float) -> float:
        return self.setpoint_m - z_m - self.climb_mps * (self.tau_s + self.delay_s)

    def _hold(self, t_ns: int, z_m: float) -> None:
        since_s = (t_ns - self.begin_ns) * 1e-9
        not_descended_m = self.rate_mps * (since_s - self.delay_s - r.STOP_TAUS * self.tau_s)
        if not_descended_m > r.MOTION_BANDS * self.band_m or since_s > r.MAX_PHASE_TAUS * self.tau_s:
            self.phase, self.begin_ns, self.begin_z_m = LIFT, t_ns, z_m
            self.lift_m, self.lifted = r.MOTION_BANDS * self.band_m, 0

    def _lift(self, t_ns: int, z_m: float) -> None:
        risen_m, since_s = z_m - self.begin_z_m, (t_ns - self.begin_ns) * 1e-9
        stop_s = self.delay_s + r.STOP_TAUS * self.tau_s
        if self.rose and risen_m < -self.band_m:
            self.rate_mps = self.band_m / since_s
            self.phase, self.begin_ns, self.begin_z_m, self.rose = HOLD, t_ns, z_m, False
        elif self.rose:
            if since_s > stop_s + r.ANSWER_TAUS * self.tau_s:
                self.phase = NONE
                if not self.applied or self._lead_m(z_m) - self.lead_before_m > 0.5 * self.added_m:
                    self._begin_run(t_ns, z_m)
        elif risen_m > 0.5 * self.lift_m:
            self.lifted += 1
            if self.lifted > 2.0 * self.number:
                self.phase = NONE
        elif since_s > r.MAX_PHASE_TAUS * self.tau_s:
            self._begin_run(t_ns, z_m)

    def target_in_test_m(self, target_m: float) -> float:
        """The target, shifted up in a long run or in the test of an ascent, or what a test asks for."""
        if self.phase == RUN:
            return target_m + self.shift_m
        if self.rose:
            if self.phase == LIFT:
                return target_m + self.lift_m
            return min(target_m, self.begin_z_m + UNSEEN_RISE * self.standoff_m)
        if self.phase == HOLD:
            return max(target_m, self.begin_z_m)
        if self.phase == LIFT:
            return max(target_m, self.begin_z_m + self.lift_m)
        return target_m
