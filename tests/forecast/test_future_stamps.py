"""Timestamps of readings that jump ahead of every time given to the follower in process."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow import Follower
from surffollow.benchmark.hazard_scenarios import FAR_M, NEAR_M, STANDOFF_M, draw
from surffollow.benchmark.hazards import PLoop, play
from surffollow.follower.future_stamps import FutureStamps, ReferenceTime

MS = 1_000_000
BEGIN = 1000 * MS


class Sensor(FutureStamps):
    """Stamps of a sensor with a time of their own."""

    def __init__(self) -> None:
        self.time = ReferenceTime()
        super().__init__(self.time)


def fed(ms_range, stamps: Sensor, ahead_ms=0, times=True):
    """Corrections of readings every 4 ms, beside a time given every 10 ms [ms]."""
    out = []
    for ms in ms_range:
        if times and ms % 10 == 0:
            stamps.time.add(BEGIN + ms * MS)
        if ms % 4 == 0:
            t = stamps.correct(BEGIN + (ms + ahead_ms) * MS)
            out.append(None if t is None else (t - BEGIN) / MS - ms)
    return out


@pytest.mark.parametrize("ahead_ms", [25, 60, 900, 3_600_000])
def test_stamps_that_jump_ahead_count_as_new_as_usual(ahead_ms):
    """GIVEN usual stamps WHEN all jump ahead THEN few are dropped, and the others are corrected."""
    stamps = Sensor()
    assert set(fed(range(2000), stamps)) == {0}
    found = fed(range(2000, 3000), stamps, ahead_ms)
    assert 0 < found.count(None) <= 5
    kept = np.array([f for f in found if f is not None])
    assert np.abs(kept).max() < 10.0, "one interval of the times"
    assert set(fed(range(3000, 4000), stamps)) == {0}
    assert stamps.shift_ns == 0.0


def test_one_stamp_ahead_is_dropped():
    stamps = Sensor()
    fed(range(2000), stamps)
    assert stamps.correct(BEGIN + 2300 * MS) is None
    assert set(fed(range(2004, 2400), stamps)) == {0}


def test_stamps_go_on_while_no_time_is_given():
    """GIVEN poses that stop WHEN readings go on as before THEN their stamps are taken as they are."""
    stamps = Sensor()
    fed(range(2000), stamps)
    assert set(fed(range(2000, 3000), stamps, times=False)) == {0}


def test_after_a_pause_of_everything_stamps_are_taken_as_they_are():
    """GIVEN a process that stood still WHEN a reading comes before a pose THEN it alone is dropped."""
    stamps = Sensor()
    fed(range(2000), stamps)
    assert fed([2504], stamps) == [None]
    assert set(fed(range(2510, 3000), stamps)) == {0}


def test_stamps_that_were_too_old_for_a_while_are_not_usual():
    stamps = Sensor()
    fed(range(2000), stamps)
    assert set(fed(range(2000, 3000), stamps, -100)) == {-100}
    assert set(fed(range(3000, 4000), stamps)) == {0}


@pytest.mark.parametrize("rate", [0.0, 0.5])
def test_stamps_that_stood_still_or_ran_slow_are_usual_again_when_they_are_right(rate):
    """GIVEN a sensor clock that runs slow for a second WHEN it is right again THEN nothing is shifted."""
    stamps = Sensor()
    fed(range(2000), stamps)
    for ms in range(2000, 3000, 4):
        if ms % 10 == 0:
            stamps.time.add(BEGIN + ms * MS)
        stamps.correct(BEGIN + round((2000 + rate * (ms - 2000)) * MS))
    assert set(fed(range(3010, 4000), stamps)) == {0}


def test_the_first_stamps_are_taken_as_they_are():
    stamps = Sensor()
    assert stamps.correct(5) == 5
    assert set(fed(range(2000), Sensor(), 500)) == {500}


def standard(mode: str = "adaptive") -> Follower:
    return Follower({"mode": mode, "sensors": [{"near_m": NEAR_M, "far_m": FAR_M}]}, offset_m=STANDOFF_M)


@pytest.mark.parametrize("seed", range(6))
def test_the_tool_keeps_its_distance(seed):
    """GIVEN a closed loop WHEN stamps lie 20 to 150 ms ahead THEN a plain P loop is nowhere 5 mm safer."""
    scenario = draw("early stamps", seed)
    assert scenario.late_s < 0.0
    ours, plain = play(standard(), scenario), play(PLoop(), scenario)
    assert not ours.contact_valid
    assert ours.clearance_m > plain.clearance_m - 5e-3, scenario


def test_state_says_why_until_the_stamps_are_usual_again_or_a_reset():
    f = standard()
    health = []
    for ms in range(3000):
        if ms % 10 == 0:
            f.pose(ms * MS, (1e-4 * ms, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
        if ms % 4 == 0:
            f.step((ms + (60 if 1000 <= ms < 2000 else 0)) * MS, [0.1])
            health.append((f.state()["health"], f.state()["reason"]))
    reason = "timestamps jumped ahead; readings count as new as usual"
    assert health[240] == ("OK", "")
    assert health[260:490] == [("SUSPECT", reason)] * 230
    assert health[-1] == ("OK", "")


def test_a_new_sensor_beside_a_late_one_is_not_dropped():
    """GIVEN a sensor 60 ms late WHEN another, that is not late, reads at times THEN its readings enter."""
    config = {"sensors": [{"near_m": NEAR_M, "far_m": FAR_M}, {"near_m": NEAR_M, "far_m": FAR_M}]}
    f = Follower(config, offset_m=STANDOFF_M)
    fresh = []
    for ms in range(4000):
        if ms % 10 == 0:
            f.pose(ms * MS, (1e-4 * ms, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
            f.step((ms - 60) * MS, [0.1, np.nan])
        if ms % 200 == 5:
            f.step(ms * MS, [np.nan, 0.09 + 1e-6 * ms])
            fresh.append(f.state()["range_m"][1])
    np.testing.assert_allclose(fresh, 0.09 + 1e-6 * np.arange(5, 4000, 200))


def test_a_clock_that_begins_anew_is_followed():
    stamps = Sensor()
    fed(range(2000, 4000), stamps)
    assert set(fed(range(0, 2000), stamps)) == {0}


def test_the_paper_mode_takes_every_stamp():
    f = standard("paper")
    for ms in range(0, 500, 4):
        f.pose(ms * MS, (1e-4 * ms, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
        f.step(ms * MS, [0.1])
    f.step(700 * MS, [0.1])
    assert f.state()["t_ns"] == 700 * MS
