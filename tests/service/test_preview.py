"""Preview from the live map: second passes, simulated and live with a replay; when it is looked up."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from service.map_loop import MapLoop
from shell_loop import MS, START
from surffollow.forecast.plant.controller_clock import (
    begin_period,
    latch_time,
    observe_latch,
    period_is_due,
)
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_follow import MODE_PAPER, Inputs

TOOLS = Path(__file__).parents[2] / "tools"
# uses of a preview: for a sample, for a controller period
NONE, FOR_SAMPLE, FOR_PERIOD = (False, False), (True, False), (False, True)


def test_the_way_back_over_ground_just_mapped_is_followed_far_better_than_the_way_there():
    # GIVEN a robot that goes over unknown ground and back
    loop = MapLoop("fy91")
    # WHEN the robot has finished both passes
    loop.run_to_end()
    # THEN the way there had no preview, and the way back is followed better by it
    first, second = loop.passes()
    assert second <= 0.4 * first, (first, second)
    assert not any(loop.previews[2500:5500]), "the first pass has nothing to remember"


@pytest.mark.parametrize("period_ms", [1, 2, 4, 8, 14, 20, 25])
def test_a_controller_of_any_rate_follows_mapped_ground_closely(period_ms):
    """GIVEN a controller of 40 Hz to 1 kHz WHEN ground is passed again THEN a third of the error."""
    loop = MapLoop("fy91-rolling", period_ms)
    loop.run_to_end()
    first, second = loop.passes()
    print(f"{1000 / period_ms:.0f} Hz: first pass {1e3 * first:.3f} mm, second {1e3 * second:.3f} mm")
    assert second < 0.33 * first


def test_with_the_parameter_off_nothing_is_looked_up():
    loop = MapLoop("fy91", preview=0)
    loop.run(9.0)
    assert not any(loop.previews)


def test_ground_is_looked_up_only_in_cycles_that_use_it():
    # GIVEN a robot that goes over rolling ground and back
    loop = MapLoop("fy91-rolling")
    # WHEN the robot has finished both passes
    loop.run_to_end()
    # THEN the way back is followed better, by heights that were looked up in a part of the cycles only
    first, second = loop.passes()
    assert second <= 0.5 * first, (first, second)
    back = np.array(loop.previews[8000:10000])
    # 100 controller periods and 250 samples a second, some in one cycle; long pieces for periods alone
    assert 0.25 < np.mean(back > 0) < 0.5
    assert 0.08 < np.mean(back > 20) < 0.13


def test_a_map_wrong_by_20_mm_disables_the_preview():
    # GIVEN a robot that has gone over rolling ground and turns
    loop = MapLoop("fy91-rolling")
    loop.run(5.9)
    # WHEN the map is wrong by 20 mm on the way back
    loop.raise_map(0.02)
    loop.run_to_end()
    # THEN the way back is followed about as well as the way there
    first, second = loop.passes()
    assert second < 1.5 * first, (first, second)


def test_a_map_that_is_laid_anew_meanwhile_previews_nothing_and_the_cycle_goes_on():
    # GIVEN a robot on its way back with a preview
    loop = MapLoop("fy91-rolling")
    loop.run(8.0)
    assert any(loop.previews[-100:])
    # WHEN the map is being laid anew
    loop.begin_refocus()
    loop.run(0.5)
    # THEN nothing is previewed, and the demand is valid
    assert not any(loop.previews[-500:])
    assert loop.is_valid


@pytest.fixture(scope="module")
def on_flat_ground():
    """A robot that has gone over flat ground for three seconds."""
    loop = MapLoop("flat")
    loop.run(3.0)
    return loop


@pytest.fixture
def loop(on_flat_ground):
    with on_flat_ground.tried():
        yield on_flat_ground


def test_a_preview_is_due_for_each_controller_period(loop):
    loop.expect_nothing()
    assert loop.preview_uses() == NONE
    loop.expect_period()
    assert loop.preview_uses() == FOR_PERIOD


@pytest.mark.parametrize(
    ("change_counts", "channel", "flags", "expected"),
    [(40, 0, 0, FOR_SAMPLE), (40, 1, 0, NONE), (40, 0, 1, NONE)],
    ids=["new", "of another channel", "invalid"],
)
def test_a_preview_is_due_for_new_valid_samples_of_the_first_sensor(
    loop, change_counts, channel, flags, expected
):
    loop.expect_reading(change_counts, channel, flags)
    assert loop.preview_uses() == expected


@pytest.mark.parametrize(("name", "value"), [("mode", MODE_PAPER), ("preview", 0)])
def test_no_preview_is_due_in_paper_mode_or_with_the_parameter_off(loop, name, value):
    loop.expect_reading(40)
    before = loop.set_param(name, value)
    assert loop.preview_uses() == NONE
    loop.set_param(name, before)
    assert loop.preview_uses() == FOR_SAMPLE


def test_no_preview_is_due_for_a_sensor_that_leads_and_so_sees_better_than_memory(loop):
    loop.expect_reading(40)
    loop.lead(0.05)
    assert loop.preview_uses() == NONE


def test_the_map_is_used_again_when_a_second_sensor_no_longer_leads(loop):
    loop.expect_reading(40)
    loop.look_ahead(0.05)
    assert loop.preview_uses() == NONE
    loop.look_ahead(0.0)
    assert loop.preview_uses() == FOR_SAMPLE


def test_the_map_is_read_where_a_tilted_tool_points(loop):
    # GIVEN an upright tool, under whose newest place the preview begins
    loop.expect_period()
    x, y = loop.preview_begin()
    assert (x, y) == pytest.approx(loop.newest_place(), abs=1e-9)
    # WHEN the tool is tilted
    loop.tilt(0.03, -0.01)
    # THEN the preview begins where it points
    tip_x, tip_y = loop.preview_begin()
    assert (tip_x - x, tip_y - y) == pytest.approx((0.03, -0.01))


class Periods:
    """The controller's periods, as the follower keeps them; `t_ns` counts from START."""

    def __init__(self):
        self._adaptive = zeros(AdaptiveState)[0]
        self._controller = self._adaptive["controller"]
        self._adaptive["preview"]["share"] = 1.0

    def report(self, number, t_ns):
        self._adaptive["clock"]["now_ns"] = START + t_ns
        observe_latch(self._adaptive, zeros(Inputs)[0], number)

    @staticmethod
    def _inputs(answers_each):
        """Of a caller who gives a range, or of a service."""
        inputs = zeros(Inputs)[0]
        inputs["n_ranges"] = answers_each
        return inputs

    def is_due(self, t_ns, answers_each=False, call_s=0.0):
        """Whether a setpoint is due; `answers_each`: the caller takes each answer himself."""
        self._adaptive["setpoint"]["interval_s"] = call_s
        return period_is_due(self._adaptive, self._inputs(answers_each), START + t_ns) != 0

    def answer(self, t_ns):
        """A setpoint is computed now; when the controller takes it."""
        self._adaptive["setpoint"]["interval_s"] = 0.0
        self._adaptive["clock"]["now_ns"] = START + t_ns
        begin_period(self._adaptive, self._inputs(False))
        return self.latch_ns(t_ns)

    def latch_ns(self, t_ns, answers_each=False):
        self._adaptive["setpoint"]["interval_s"] = 0.0
        return int(latch_time(self._adaptive, self._inputs(answers_each), START + t_ns)) - START


def test_periods_are_put_before_reports_that_come_a_hundred_times_a_second():
    # GIVEN reports every 10 ms, which are late by up to 0.3 ms
    periods, answered = Periods(), []
    late = np.random.default_rng(5).uniform(0, 300_000, 3000)
    # WHEN the cycles of three seconds look whether a period is due
    for k in range(3000):
        t_ns = k * MS + int(late[k])
        if k % 10 == 3:
            periods.report(k // 10 + 1, t_ns)
        if periods.is_due(t_ns):
            answered.append((k, periods.answer(t_ns)))
            last_ns = t_ns
    # THEN each is answered in the cycles after a report, and taken half a millisecond before the next
    settled = [(k, taken) for k, taken in answered if k > 1000]
    assert {k % 10 for k, _ in settled} <= {4, 5}
    assert len(settled) == pytest.approx(200, abs=2)
    for k, taken in settled:
        report = k + (3 - k) % 10
        assert abs(taken - (report * MS - 500_000)) < 600_000
    # THEN where the caller takes each answer himself, one is due every 10 ms and taken at once
    assert periods.is_due(last_ns + 9_999_000, answers_each=True)
    assert not periods.is_due(last_ns + 9_998_000, answers_each=True)
    # a caller of 100 Hz is not punctual; one of 1 kHz calls again in time
    assert periods.is_due(last_ns + 9_050_000, answers_each=True, call_s=0.01)
    assert not periods.is_due(last_ns + 8_950_000, answers_each=True, call_s=0.01)
    assert not periods.is_due(last_ns + 9_700_000, answers_each=True, call_s=0.001)
    assert periods.latch_ns(0, answers_each=True) == 0


def test_live_the_second_pass_is_better_and_its_replay_has_the_same_bits(monkeypatch):
    monkeypatch.syspath_prepend(str(TOOLS))
    bench = __import__("bench_second_pass")
    try:
        for _ in range(4):  # a stall at an edge takes the plan away for half a second, as it should
            got = bench.there_and_back("fy91", length_m=0.45)
            assert got["replay_identical"], got
            first, second = got["passes"]
            if second["rms_m"] <= 0.6 * first["rms_m"]:
                break
    finally:
        sys.modules.pop("bench_second_pass", None)
    assert second["rms_m"] <= 0.6 * first["rms_m"], got
