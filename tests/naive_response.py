"""The response test of a range sensor as a plain state machine, one sentence per line."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from surffollow.forecast.estimation.noise import MIN_NOISE_M
from surffollow.forecast.plant.axis_model import LONG_TAUS
from surffollow.forecast.quantities import APART_M, LEVEL_SHARE, REPEAT_BAND, SLOW_RATE
from surffollow.forecast.sensing import constant_ranges as c
from surffollow.forecast.sensing import mean_range as m
from surffollow.forecast.sensing import response as r
from surffollow.forecast.sensing.repeated_ranges import REPEAT_RATIO

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
    settled_ns: int = 0
    proven_m: float = 0.0
    repeats: int = 0
    chance: float = 1.0
    equal: int = 0
    usual_equal: float = 0.0
    noise_m: float = 0.0  # without that of the quantisation
    count_m: float = 0.0  # of the sensor
    usual_repeats: float = 0.0
    spread_m: float = 0.0
    usual_m: float = 0.0
    usual_error_m: float = 0.0
    mean_m: float = 0.0
    repeated_m: float = 0.0
    rose: bool = False
    far_m: float = 0.1524
    repeated_z_m: float = 0.0
    unused: bool = False
    lift_m: float = 0.0
    misses_m: float = 0.0
    begin_z_m: float = 0.0
    descent_m: tuple[float, float] | None = None  # least and greatest mean range of one that is to be tested
    swing_m: float = 0.0
    shift_z_m: float = 0.0
    shift_excess_m: float = 0.0
    band_m: float = 0.0
    begun_band_m: float = 0.0  # of the run

    def _begin_run(self, z_m: float) -> None:
        self.phase, self.run_m, self.in_run = RUN, self.mean_m, 0
        self.top_z_m, self.low_z_m = z_m, z_m
        self.begun_band_m = self.band_m
        self.rates_mps: list[float] = []
        self.shift_ns, self.lift_m, self.swing_m = None, 0.0, 0.0

    def _count_repeats(self, range_m: float, z_m: float) -> None:
        if self.repeats > 0 and abs(range_m - self.repeated_m) <= REPEAT_BAND * self.noise_m:
            self.repeats += 1
            if range_m == self.repeated_m:
                self.equal += 1
                self.chance *= min(1.0, self.count_m / (2.0 * math.sqrt(math.pi) * self.sigma_m))
            return
        self.chance = 1.0
        if self.phase == RUN:
            share = 1.0 / (m.MAX_READINGS if self.repeats > self.usual_repeats else m.RUN_SAMPLES)
            self.usual_repeats = (1.0 - share) * self.usual_repeats + share * self.repeats
            share = 1.0 / (m.MAX_READINGS if self.equal > self.usual_equal else m.RUN_SAMPLES)
            self.usual_equal = (1.0 - share) * self.usual_equal + share * self.equal
        self.equal = 1
        self.repeats, self.repeated_m, self.repeated_z_m = 1, range_m, z_m
        self.repeated_setpoint_m = self.setpoint_m

    @property
    def is_quiet(self) -> bool:
        return self.usual_m > MIN_NOISE_M and self.spread_m < 0.5 * self.usual_m

    @property
    def is_repeated(self) -> bool:
        return self.repeats >= m.MAX_READINGS and self.repeats >= REPEAT_RATIO * self.usual_repeats

    def observe(self, t_ns: int, range_m: float, z_m: float) -> None:
        """One sample of the sensor, with the height of the tool at its time."""
        dt_s = None if self.last_ns is None else (t_ns - self.last_ns) * 1e-9
        begins = dt_s is None or dt_s < 0.0
        if dt_s is not None and dt_s > self.gap_s:  # an answer takes time with samples
            self.begin_ns = t_ns
            if self.phase == RUN and self.shift_ns is not None:
                self.shift_ns, self.shift_z_m = t_ns, z_m
        if self.last_ns is None:
            self.mean_m = self.run_m = 0.0
            self.in_run = 0
        self.last_ns = t_ns
        self._count_repeats(range_m, z_m)
        self.number = min(max(self.tau_s / self.interval_s, m.MIN_READINGS), m.MAX_READINGS)
        self.slow = self.interval_s > LONG_TAUS * self.tau_s
        self.band_m = m.BAND_SIGMAS * self.sigma_m / math.sqrt(self.number)
        one_m = m.BAND_SIGMAS * self.sigma_m
        tests = self.phase != RUN or self.lift_m > 0.0
        most_m = self.number * max(self.band_m, self.begun_band_m) if tests else one_m
        most_m = max(most_m, r.SWINGS[0] * self.swing_m)
        step_m = range_m - self.mean_m
        deviation_m = min(abs(step_m), most_m)
        self.mean_m += math.copysign(deviation_m, step_m) / self.number
        self.spread_m += (min(deviation_m, m.BAND_SIGMAS * self.sigma_m) - self.spread_m) / (
            2.0 * c.MIN_MEANS * self.number
        )
        if not self.is_quiet:
            self.usual_m += SLOW_RATE * (min(self.spread_m, self.sigma_m) - self.usual_m)
        if not tests and not begins:
            error_m = min(abs(self.mean_m - self.standoff_m), 0.03 * self.standoff_m)
            self.usual_error_m += SLOW_RATE * (error_m - self.usual_error_m)
        self.in_run += 1
        if self.swing_m == 0.0 and self.number < self.in_run < m.RUN_SAMPLES:
            self.run_m += (self.mean_m - self.run_m) / self.in_run
        moved_m = abs(z_m - self.repeated_z_m)
        led_m = max(moved_m, abs(self.setpoint_m - self.repeated_setpoint_m))
        fine = self.count_m < REPEAT_BAND * self.sigma_m
        near = fine and self.repeats >= max(5, REPEAT_RATIO * self.usual_repeats) and moved_m > self.band_m
        rare = self.equal >= REPEAT_RATIO * self.usual_equal and self.chance < 1e-5
        moved = near or (rare and led_m > self.band_m)
        self.unused = self.repeats > 1 and (self.unused or moved)
        allowed_m = self.band_m if begins else max(self.band_m, self.begun_band_m)
        self.answer_m = max(m.TEST_BAND_FACTOR * self.band_m, r.SWINGS[0] * self.swing_m)
        if self.phase != RUN:
            allowed_m = self.answer_m
        self.answer_s = self.delay_s + 2.0 * self.tau_s + c.MIN_MEANS * self.number * self.interval_s
        if begins or abs(self.mean_m - self.run_m) > allowed_m:
            back_s = self.delay_s + 2.0 * self.tau_s + self.number * self.interval_s
            back_ns = t_ns + int(1e9 * back_s)
            if begins:
                self.settled_ns, self.proven_m = 0, 0.0
            elif tests:
                self.settled_ns = back_ns
                rates_mps = self.rates_mps or [0.0]
                moved_m = math.fsum(rates_mps) / len(rates_mps) * self.number * self.interval_s
                jumps = abs(range_m - self.mean_m) > one_m + moved_m
                proven_m = self.mean_m if self.mean_m > self.run_m else min(self.proven_m, self.mean_m)
                self.proven_m = 0.0 if self.rose or jumps else proven_m
            if begins or abs(range_m - self.mean_m) > one_m:
                self.mean_m = range_m
            self._begin_run(z_m)
        elif self.phase == RUN and self.descent_m is not None:
            self._begin_run(z_m)
            least_m, most_m = self.descent_m
            self.mean_m = self.run_m = 0.5 * (least_m + most_m)
            self.swing_m, self.rose = 0.5 * (most_m - least_m), False
            self.phase, self.begin_ns, self.begin_z_m = HOLD, t_ns, z_m
        elif self.phase == RUN:
            self._look_for_a_motion(t_ns, z_m)
        elif self.phase in (HOLD, LIFT):
            self._test(t_ns, z_m)

    def _look_for_a_motion(self, t_ns: int, z_m: float) -> None:
        self.top_z_m, self.low_z_m = max(self.top_z_m, z_m), min(self.low_z_m, z_m)
        self.rates_mps.append(abs(self.climb_mps))
        descent_m, ascent_m = self.top_z_m - z_m, z_m - self.low_z_m
        rises = 0.25 * ascent_m > descent_m and descent_m < self.band_m
        repeats = self.is_repeated
        rate_mps = math.fsum(self.rates_mps) / len(self.rates_mps)
        motion_m = 0.25 * ascent_m if rises else descent_m
        ahead = abs(self.lead_m) >= APART_M
        error_m = 0.0 if ahead else abs(self.run_m - self.standoff_m)
        level_s = LEVEL_SHARE * self.interval_s if self.slow else 0.0
        no_lag = error_m > (m.LAG_TAUS * self.tau_s + level_s) * rate_mps
        work = error_m * motion_m / (self.band_m * self.standoff_m)
        unusual = error_m > 3.0 * self.usual_error_m
        wrong = unusual and error_m > self.band_m and no_lag and work > m.ERROR_MOTION
        enough = motion_m > c.MOTION_BANDS * self.band_m
        quiet = self.is_quiet
        distant = motion_m > c.SHIFT_DESCENT * self.standoff_m
        faster_m = self.tau_s * (-self.climb_mps - 1.5 * rate_mps)
        runs_away = distant and faster_m > self.band_m
        suspicious = enough and (wrong or repeats or quiet or self.rotation_failed or runs_away)
        if self.run_error_m() < max(self.band_m, m.LAG_TAUS * self.tau_s * rate_mps):
            self.proven_m = 0.0
        comes_back = self.proven_m > 0.0 and not rises and not repeats
        few = self.slow
        steep = rate_mps * self.answer_s > r.STEEP * self.standoff_m and not rises
        steep = steep or (comes_back and few)
        wait_s = self.answer_s
        if steep:
            wait_s = self.delay_s + 2.0 * self.tau_s + self.number * self.interval_s - self.tau_s
        least_m = c.MOTION_BANDS * self.band_m
        if comes_back:
            taken_m = rate_mps * (wait_s + self.delay_s + self.tau_s)
            room_m = min(r.MAX_DESCENT * self.standoff_m - taken_m, c.SHIFT_DESCENT * self.standoff_m)
            higher_m = self.proven_m - self.standoff_m if not self.slow else 0.0
            least_m = max(least_m, room_m + higher_m)
        waits = 2.0 if comes_back and not few else 1.0
        if self.in_run <= waits * (1.0 if steep else c.MIN_MEANS) * self.number:
            return
        if rises and self.slow and not repeats and motion_m <= c.SHIFT_DESCENT * self.standoff_m:
            return
        doubtful = enough and self.number >= m.MAX_READINGS and no_lag and work > m.ERROR_MOTION / 6.0
        stops_m = rate_mps * (self.delay_s + self.tau_s)
        far = not self.slow and descent_m + stops_m > r.MAX_DESCENT * self.standoff_m
        long = self.in_run > 2.0 * c.MIN_MEANS * self.number
        if t_ns < self.settled_ns and not repeats:
            suspicious = doubtful = distant = False
        sign = doubtful or (enough and distant) or suspicious
        if comes_back:
            suspicious, sign = False, descent_m > least_m and t_ns >= self.settled_ns
        if self.shift_ns is None and ((long and sign) or ((steep or comes_back) and descent_m > least_m)):
            self.shift_ns, self.lift_m = t_ns, (1.0 if steep else 0.5) * c.MOTION_BANDS * self.band_m
            came_back = t_ns - int(1e9 * self.in_run * self.interval_s) < self.settled_ns
            if came_back and not rises and not ahead:
                self.lift_m += max(self.run_m - self.standoff_m, 0.0)
            self.shift_z_m, self.shift_excess_m, self.rose = z_m, self._excess_m(z_m), rises
            self.highest_m = self._climbs_to_m(z_m) if self.slow else self._ceiling_m(z_m)
        unanswered = self.shift_ns is not None and (t_ns - self.shift_ns) * 1e-9 > wait_s
        self.rose = rises
        if rises and unanswered:
            self._lift(t_ns, z_m, self.lift_m + c.MOTION_BANDS * self.band_m + self.tau_s * rate_mps)
        elif not rises and (unanswered or far or suspicious):
            self.phase, self.begin_ns, self.begin_z_m, self.lift_m = HOLD, t_ns, z_m, 0.0

    def run_error_m(self) -> float:
        """Error of the mean range, positive above the stand-off."""
        return self.mean_m - self.standoff_m

    def _lift(self, t_ns: int, z_m: float, lift_m: float) -> None:
        self.excess_before_m = self._excess_m(z_m) - self.lift_m
        self.phase, self.begin_ns, self.begin_z_m = LIFT, t_ns, z_m
        self.lift_m = self.misses_m = lift_m
        self.highest_m = self._ceiling_m(z_m)

    def _climbs_to_m(self, z_m: float) -> float:
        """Two lifts and what the run climbs in an answer."""
        rate_mps = math.fsum(self.rates_mps) / len(self.rates_mps) if self.rates_mps else 0.0
        return z_m + 2.0 * self.lift_m + rate_mps * (self.answer_s + self.tau_s)

    def _ceiling_m(self, z_m: float) -> float:
        """So high in a lift, within the window; over ground that is level."""
        sees_m = self.far_m - self.run_m
        sees_m = max(sees_m - self.standoff_m, sees_m / 2.0)
        sees_m += self.low_z_m if self.rose else self.top_z_m
        return min(self._climbs_to_m(z_m), max(sees_m, z_m + self.lift_m))

    def _excess_m(self, z_m: float) -> float:
        return self.setpoint_m - z_m - self.climb_mps * (self.tau_s + self.delay_s)

    def _test(self, t_ns: int, z_m: float) -> None:
        missing_m = max(self.begin_z_m + self.lift_m - z_m, self._excess_m(z_m))
        if self.rose:
            missing_m = self._excess_m(z_m) - self.excess_before_m
        self.misses_m += (missing_m - self.misses_m) / ((4.0 if self.rose else 2.0) * self.number)
        late_s, longest_s = (t_ns - self.begin_ns) * 1e-9 - self.answer_s, c.ANSWER_TAUS * self.tau_s
        allowed_m = 0.65 * self.lift_m if self.rose else self.lift_m - self.answer_m
        stands = False
        if self.rose:
            rate_mps = math.fsum(self.rates_mps) / len(self.rates_mps)
            at_ceiling = self.highest_m - allowed_m < z_m < self.highest_m + allowed_m
            stands = at_ceiling and abs(self.climb_mps) < 0.5 * rate_mps
        if stands:
            climb_s = (self.highest_m - self.begin_z_m + self.answer_m) / rate_mps
            longest_s = min(longest_s, max(climb_s - self.answer_s, 0.0))
        if late_s <= 0.0 or (self.rose and late_s <= longest_s):
            return
        if self.phase == HOLD:
            self._lift(t_ns, z_m, max(c.MOTION_BANDS * self.band_m, r.SWINGS[1] * self.swing_m))
            return
        obeyed = self.misses_m < allowed_m
        if self.rose and z_m > self.highest_m - allowed_m:
            obeyed = stands
        if self.is_repeated or (self.applied and obeyed):
            self.phase = NONE
        elif late_s > longest_s:
            self._begin_run(z_m)

    def target_in_test_m(self, target_m: float) -> float:
        """The target, shifted up in a long run or in the test of an ascent, or what a test asks for."""
        if self.phase == RUN and self.shift_ns is not None and self.rose:
            return min(target_m + self.lift_m, self.highest_m)
        if self.phase == RUN:
            shifted = self.shift_ns is not None and not self.rose
            rate_mps = math.fsum(self.rates_mps) / len(self.rates_mps) if shifted else 0.0
            if not shifted or -self.shift_excess_m <= max(self.lift_m, self.tau_s * rate_mps):
                return target_m + self.lift_m
            since_s = (self.last_ns - self.shift_ns) * 1e-9 + self.tau_s
            return max(target_m + self.lift_m, self.shift_z_m - rate_mps * since_s + self.lift_m)
        if self.phase == NONE:
            return min(target_m + 2.0 * self.lift_m, self.highest_m)
        lowest_m = self.begin_z_m if self.rose else self.begin_z_m + self.lift_m
        highest_m = self.highest_m if self.phase == LIFT else math.inf
        return min(max(target_m + self.lift_m, lowest_m), highest_m)
