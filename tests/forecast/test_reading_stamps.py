"""Timestamps of readings that disagree with every other time given to the follower in process."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow import Follower
from surffollow.benchmark.hazard_scenarios import FAR_M, NEAR_M, STANDOFF_M, draw
from surffollow.benchmark.hazards import PLoop, play
from surffollow.follower.reading_stamps import ReadingStamps
from surffollow.follower.reference_time import ReferenceTime

MS = 1_000_000
BEGIN = 1000 * MS


class Sensor(ReadingStamps):
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


def batched(stamps: Sensor, ms_range, interval_ms: int, batch_ms: int, late_ms=0, ahead_ms=0, unit=MS):
    """Corrections of readings that arrive in batches, beside poses every 4 ms that are late themselves."""
    out, waiting = [], []
    for ms in ms_range:
        if ms % 4 == 0:
            stamps.time.add((BEGIN // MS + ms - late_ms) * unit)
        if ms % interval_ms == 0:
            waiting.append(ms)
        if ms % batch_ms == 0:
            given = [(BEGIN // MS + w + ahead_ms) * unit for w in waiting]
            found = [stamps.correct(t) for t in given]
            out += [None if t is None else t / unit - BEGIN // MS - w for t, w in zip(found, waiting)]
            waiting = []
    return out


@pytest.mark.parametrize("unit", [MS, MS >> 5, MS << 5], ids=["usual", "quick", "slow"])
@pytest.mark.parametrize("late_ms", [0, 50])
@pytest.mark.parametrize("batch_ms", [10, 40, 80, 400])
@pytest.mark.parametrize("interval_ms", [1, 5, 16, 32])
def test_readings_in_batches_keep_their_stamps(interval_ms, batch_ms, late_ms, unit):
    """GIVEN readings slower or quicker than poses WHEN they come in batches THEN none is dropped.

    Where a batch had two readings or more, farther apart than the poses, 36 to 77 % were dropped.
    """
    stamps = Sensor()
    stamps.time.set_scale(unit / MS)
    assert set(batched(stamps, range(20_000), interval_ms, batch_ms, late_ms, unit=unit)) == {0}


@pytest.mark.parametrize("seed", range(4))
def test_readings_in_batches_of_random_length_keep_their_stamps(seed):
    """GIVEN readings every 16 ms, a half of them missing WHEN batches are random THEN none is dropped."""
    rng, stamps = np.random.default_rng(seed), Sensor()
    print("seed", seed)
    waiting = []
    for ms in range(0, 40_000, 4):
        stamps.time.add(BEGIN + ms * MS)
        if ms % 16 == 0 and rng.random() < 0.5:
            waiting.append(BEGIN + ms * MS)
        if rng.random() < 0.1:
            assert [stamps.correct(t) for t in waiting] == waiting
            waiting = []


@pytest.mark.parametrize("ahead_ms", [200, 3000, -3000])
@pytest.mark.parametrize("interval_ms", [5, 16])
def test_stamps_of_batches_that_jump_count_as_new_as_usual(interval_ms, ahead_ms):
    """GIVEN batches of 80 ms WHEN their stamps jump THEN a batch is dropped, and soon all are as usual."""
    stamps = Sensor()
    batched(stamps, range(8000), interval_ms, 80)
    found = batched(stamps, range(8000, 12_000), interval_ms, 80, ahead_ms=ahead_ms)
    assert 0 < found.count(None) <= 80 // interval_ms + 1
    assert np.abs([f for f in found[-2000 // interval_ms :] if f is not None]).max() < 4.0, "one pose"
    assert stamps.shift_ns * ahead_ms > 0.0
    assert set(batched(stamps, range(12_080, 14_000), interval_ms, 80)) == {0}
    assert stamps.shift_ns == 0.0


@pytest.mark.parametrize("tau_ms", [40, 320])
@pytest.mark.parametrize(("interval", "batch"), [(0.4, 1.2), (0.4, 2.0), (0.125, 2.0)])
def test_a_follower_uses_all_readings_of_batches(interval, batch, tau_ms):
    """GIVEN poses every 0.1 τ WHEN readings come in batches THEN all enter, and no pose is stale."""
    config = {"sensors": [{"near_m": NEAR_M, "far_m": FAR_M}], "plant": {"tau_s": 1e-3 * tau_ms}}
    f, entered, waiting = Follower(config, offset_m=STANDOFF_M), 0, []
    count = 4000
    for k in range(count):  # of 40 ticks in τ
        t_ns = 10**13 + k * tau_ms * MS // 40
        if k % round(40 * interval) == 0:
            waiting.append(t_ns)
        if k % 4 == 0:
            f.pose(t_ns, (1e-3 * k / 40.0, 0.0, STANDOFF_M, 0.0, 0.0, 0.0, 1.0))
        if k % round(40 * batch) == 0:
            for stamp in waiting:
                f.step(stamp, [STANDOFF_M + 1e-6 * (k % 7)])
                entered += f.state()["t_ns"] == stamp
            waiting = []
        if k % 4 == 0:
            f.step(t_ns, [np.nan])
            assert k < 200 or {"VALID"} <= set(f.state()["status"]) <= {"VALID", "NO_SENSOR"}, k
    assert entered >= (count - 40 * batch) / (40 * interval)


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


@pytest.mark.parametrize("back_ms", [600, 1000, 1100, 3000, 3_600_000])
def test_stamps_of_a_clock_that_was_set_back_count_as_old_as_usual(back_ms):
    stamps = Sensor()
    assert set(fed(range(2000), stamps)) == {0}
    found = fed(range(2000, 3000), stamps, -back_ms)
    assert 0 < found.count(None) <= 5
    assert np.abs([f for f in found if f is not None]).max() < 10.0, "one interval of the times"
    assert stamps.shift_ns < 0.0
    assert set(fed(range(3000, 4000), stamps)) == {0}
    assert stamps.shift_ns == 0.0


def test_one_stamp_far_behind_is_dropped():
    stamps = Sensor()
    fed(range(2000), stamps)
    assert stamps.correct(BEGIN - 500 * MS) is None
    assert set(fed(range(2004, 2400), stamps)) == {0}


def test_readings_that_wait_for_long_and_arrive_in_order_keep_their_stamps():
    """GIVEN usual stamps WHEN readings of 3 s arrive at once THEN none is shifted: they are that old."""
    stamps = Sensor()
    fed(range(2000), stamps)
    for ms in range(2000, 5000, 10):
        stamps.time.add(BEGIN + ms * MS)
    assert [stamps.correct(BEGIN + ms * MS) for ms in range(2000, 4900, 4)] == [
        BEGIN + ms * MS for ms in range(2000, 4900, 4)
    ]
    assert set(fed(range(5000, 6000), stamps)) == {0}


RING = [(0.03 * math.cos(a), 0.03 * math.sin(a), 0.0) for a in (0.0, 2.1, 4.2)]
BACK = "timestamps went back; readings count as old as usual"


class Walk:
    """A tool that moves over a slope of 10 % at 0.1 m/s; `others`: steps without a reading at every pose."""

    def __init__(self, places=((0.0, 0.0, 0.0),), others: bool = True, mode: str = "adaptive") -> None:
        sensors = [{"position_m": p, "near_m": NEAR_M, "far_m": FAR_M} for p in places]
        self.f = Follower(
            {"mode": mode, "orient": "off" if len(places) < 3 else "on", "sensors": sensors}, STANDOFF_M
        )
        self.places, self.others, self.ms = places, others, 0
        self.rng = np.random.default_rng(4)
        self.seen: list[tuple[bool, str, str]] = []
        self.demands: list[float] = []

    def go(
        self, ms: int, ahead_ms: int = 0, poses: bool = True, readings: bool = True, pose_ahead_ms: int = 0
    ):
        """Go on for some time; timestamps of readings, or of poses and other steps, lie ahead."""
        for now in range(self.ms, self.ms + ms):
            t_ns, x, n = 10**13 + now * MS, 1e-4 * now, len(self.places)
            if now % 10 == 0:
                if poses:
                    tool = (x, 0.0, STANDOFF_M + 0.1 * x, 0.0, 0.0, 0.0, 1.0)
                    self.f.pose(t_ns + pose_ahead_ms * MS, tool)
                if self.others:
                    self.f.step(t_ns + pose_ahead_ms * MS, [np.nan] * n)
            if now % 4 == 0 and readings:
                noise = 1e-4 * self.rng.standard_normal(n)
                ranges = [STANDOFF_M - 0.1 * p[0] + e for p, e in zip(self.places, noise)]
                demand = self.f.step(t_ns + ahead_ms * MS, ranges)
                self.demands.append(float(demand[2]))
            state = self.f.state()
            self.seen.append(("VALID" in state["status"], state["health"], state["reason"]))
        self.ms += ms
        return self.seen[-1]


@pytest.mark.parametrize("others", [True, False])
@pytest.mark.parametrize("places", [((0.0, 0.0, 0.0),), RING], ids=["one", "three"])
@pytest.mark.parametrize("back_ms", [600, 1000, 3000, 3_600_000])
def test_a_sensor_clock_that_is_set_back_is_followed(back_ms, places, others):
    walk = Walk(places, others)
    assert walk.go(2000) == (True, "OK", "")
    before = walk.demands[-1]
    assert walk.go(4000, -back_ms) == (True, "SUSPECT", BACK)
    assert all(valid for valid, _, _ in walk.seen[2000:])
    if len(places) == 1:
        assert abs(walk.demands[-1] - before) < 2e-4
        assert np.abs(np.array(walk.demands[500:]) - before).max() < 1e-3
    walk.f.reset()
    assert walk.go(500, -back_ms) == (True, "SUSPECT", BACK), "a reset does not make them right"
    assert walk.go(1000) == (True, "OK", "")


@pytest.mark.parametrize("ahead_ms", [60, -3000])
@pytest.mark.parametrize("others", [True, False])
def test_poses_that_stop_are_stale_while_stamps_are_shifted(ahead_ms, others):
    walk = Walk(others=others)
    walk.go(2000)
    assert walk.go(1000, ahead_ms)[:2] == (True, "SUSPECT")
    walk.go(400, ahead_ms, poses=False)
    assert walk.f.state()["status"] == ["POSE_STALE"]


@pytest.mark.parametrize("ahead_ms", [0, 500, -3000])
def test_poses_that_stop_are_stale_while_readings_are_dropped(ahead_ms):
    """GIVEN a pause of 0.5 s of everything WHEN readings alone go on THEN time does not stand still."""
    walk = Walk(others=False)
    walk.go(2000)
    walk.ms += 503
    walk.go(400, ahead_ms, poses=False)
    assert walk.f.state()["status"] == ["POSE_STALE"]


@pytest.mark.parametrize("others", [True, False])
@pytest.mark.parametrize(("ahead_ms", "word"), [(3000, "ahead of"), (300, "ahead of"), (-3000, "behind")])
def test_stamps_that_are_wrong_from_the_first_one_are_the_reason(ahead_ms, word, others):
    walk = Walk(others=others)
    valid, health, reason = walk.go(4000, ahead_ms)
    assert (valid, health) == (False, "DROPOUT")
    assert reason == f"timestamps of readings lie {word} those of poses by more than the pose time-out"
    assert {r for _, _, r in walk.seen[500:]} == {reason}


def test_late_readings_without_another_step_that_gives_the_time_are_the_reason():
    assert "behind those of poses" in Walk(others=False).go(1000, -300)[2]
    assert Walk(others=True).go(1000, -300) == (True, "OK", "")


@pytest.mark.parametrize("others", [True, False])
def test_poses_or_readings_that_stop_are_not_called_wrong_stamps(others):
    walk = Walk(others=others)
    walk.go(1000)
    walk.go(4000, poses=False)
    assert walk.f.state()["status"] == ["POSE_STALE"]
    assert "timestamps" not in walk.seen[-1][2]
    walk.go(1000)
    assert "timestamps" not in walk.go(4000, readings=False)[2]


def test_a_clock_of_everything_that_is_set_back_is_followed_in_whatever_order_it_shows():
    for others in (True, False):
        walk = Walk(others=others)
        walk.go(2003)
        walk.go(1500, -5000, pose_ahead_ms=-5000)
        assert walk.seen[-1] == (True, "OK", "")


@pytest.mark.parametrize("others", [True, False])
@pytest.mark.parametrize("back_ms", [150, 200, 320, 480, 800])
def test_a_clock_that_is_set_back_by_less_than_a_second_is_followed_within_a_drop_out(back_ms, others):
    """GIVEN a steady slope WHEN every timestamp goes back THEN the estimate begins anew, soon, with a fault.

    Every pose was refused until the old time had come again, `VALID` and `OK`: a torch touched the ground.
    """
    walk = Walk(others=others)
    walk.go(2000)
    before = walk.demands[-1]
    walk.go(150, -back_ms, pose_ahead_ms=-back_ms)
    assert "CLOCK" in walk.f.state()["faults"]
    assert walk.f.state()["poses_refused"] <= 6
    assert walk.go(1000, -back_ms, pose_ahead_ms=-back_ms) == (True, "OK", "")
    assert abs(walk.demands[-1] - before) < 2e-4


@pytest.mark.parametrize("back_ms", [150, 300, 800])
def test_poses_that_are_given_twice_are_followed_when_the_clock_is_set_back(back_ms):
    """GIVEN a caller that gives the last report at every tick WHEN all clocks go back THEN it is followed."""
    walk = Walk()
    pose = walk.f.pose

    def twice(t_ns, tool):
        return pose(t_ns, tool) or pose(t_ns, tool)

    walk.f.pose = twice
    walk.go(2000)
    before = walk.demands[-1]
    walk.go(150, -back_ms, pose_ahead_ms=-back_ms)
    assert "CLOCK" in walk.f.state()["faults"]
    assert walk.go(1000, -back_ms, pose_ahead_ms=-back_ms) == (True, "OK", "")
    assert abs(walk.demands[-1] - before) < 2e-4


@pytest.mark.parametrize("back_ms", [150, 300, 800])
def test_a_clock_of_poses_alone_that_is_set_back_ends_no_demand_for_good(back_ms):
    """GIVEN readings of another clock WHEN poses and steps without one go back THEN it follows again."""
    walk = Walk()
    for now in range(6000):
        t_ns, back_ns = 10**13 + now * MS, back_ms * MS * (now > 2000)
        if now % 4 == 0:
            tool = (1e-4 * now, 0.0, STANDOFF_M + 1e-5 * now, 0.0, 0.0, 0.0, 1.0)
            walk.f.pose(t_ns - back_ns, tool)
        elif now % 4 == 2:
            walk.f.step(t_ns, [STANDOFF_M + 1e-4 * walk.rng.standard_normal()])
        elif now % 4 == 3:
            walk.f.step(t_ns - back_ns, [np.nan])
    assert "VALID" in walk.f.state()["status"]


def test_a_clock_that_is_right_again_soon_is_waited_for():
    """GIVEN clocks that go back by less than two drop-outs THEN the estimate does not begin anew."""
    walk = Walk()
    walk.go(2000)
    walk.go(500, -90, pose_ahead_ms=-90)
    assert walk.f.state()["faults"] == []


def test_two_late_poses_in_a_row_are_refused_where_poses_are_rare():
    """GIVEN poses every 0.1 s WHEN two come late THEN the history goes on; with a third it begins anew."""
    f = Follower({"sensors": [{"near_m": NEAR_M, "far_m": FAR_M}]}, STANDOFF_M)
    tool = (0.0, 0.0, STANDOFF_M, 0.0, 0.0, 0.0, 1.0)
    assert all(f.pose(10**13 + 100 * k * MS, tool) for k in range(20))
    assert [f.pose(10**13 + 100 * k * MS, tool) for k in (14, 15, 16)] == [False, False, True]


def test_a_late_route_of_poses_does_not_take_over_in_a_pause_of_the_other():
    """GIVEN a second route of poses 0.2 s late WHEN the first one pauses for 0.15 s THEN it stays refused."""
    walk = Walk()
    walk.go(2000)
    for _ in range(20):
        for poses in [False] * 15 + [True] * 30:
            walk.go(10, poses=poses)
            late_ms = walk.ms - 200
            tool = (1e-4 * late_ms, 0.0, STANDOFF_M + 1e-5 * late_ms, 0.0, 0.0, 0.0, 1.0)
            assert not walk.f.pose(10**13 + late_ms * MS, tool)
    assert walk.f.state()["faults"] == []


def test_poses_that_were_overtaken_do_not_begin_anything_anew():
    """GIVEN two routes of poses WHEN poses of one are 0.2 s late THEN these are refused, without a fault."""
    walk = Walk()
    for _ in range(100):
        walk.go(10)
        late_ms = walk.ms - 200
        walk.f.pose(
            10**13 + late_ms * MS, (1e-4 * late_ms, 0.0, STANDOFF_M + 1e-5 * late_ms, 0.0, 0.0, 0.0, 1.0)
        )
    assert walk.f.state()["poses_refused"] == 100
    assert walk.f.state()["faults"] == []
    assert walk.seen[-1] == (True, "OK", "")


def test_poses_that_stop_for_a_while_do_not_change_the_usual_lead():
    """GIVEN readings without a pose for 1.6 s WHEN the sensor clock is set back later THEN it is followed."""
    walk = Walk(others=False)
    walk.go(1000)
    walk.go(1600, poses=False)
    assert walk.go(1000) == (True, "OK", "")
    assert walk.go(1000, -1500) == (True, "SUSPECT", BACK)


@pytest.mark.parametrize("others", [True, False])
@pytest.mark.parametrize("ahead_ms", [700, 3000, -1500])
def test_stamps_that_become_right_after_wrong_ones_from_the_first_are_used(ahead_ms, others):
    walk = Walk(others=others)
    assert not walk.go(1500, ahead_ms)[0]
    assert walk.go(1500) == (True, "OK", "")


def test_a_state_without_a_demand_has_a_reason_at_once():
    """GIVEN a clock of everything that is set back WHEN the estimate is discarded THEN there is a reason."""
    walk, lost = Walk(), 0
    walk.go(2000)
    for _ in range(500):
        valid, health, reason = walk.go(1, -5000, pose_ahead_ms=-5000)
        if "SENSOR_LOST" in walk.f.state()["status"]:
            lost += 1
            assert not valid
            assert health == "DROPOUT"
            assert reason
    assert lost > 0
