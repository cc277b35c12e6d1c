"""Wrong readings, refused configurations, and the state that the follower publishes."""

import math

import numpy as np
import pytest

from surffollow import Follower
from surffollow.benchmark.hazard_scenarios import FAR_M, NEAR_M, STANDOFF_M, Scenario, draw
from surffollow.benchmark.hazards import PLoop, play
from surffollow.errors import ConfigError
from surffollow.shm.layout_adaptive import REASON_NAMES, REASON_TESTED

MS = 1_000_000
WINDOW = {"near_m": NEAR_M, "far_m": FAR_M}


def standard(**more):
    return Follower({"sensors": [WINDOW], **more}, offset_m=STANDOFF_M)


def drive(follower, readings, z=STANDOFF_M, speed=0.1, period_ms=4):
    """Feed readings on a level path; yields the state after each."""
    for k, r in enumerate(readings):
        t = k * period_ms * MS
        if k % 3 == 0:
            follower.pose(t, (speed * t * 1e-9, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        demand = follower.step(t, [r])
        yield t, demand, follower.state()


def noisy(count, seed=0, sigma=2.5e-4):
    return STANDOFF_M + sigma * np.random.default_rng(seed).standard_normal(count)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("size_m", [2.5e-3, -2.5e-3])
def test_a_sensor_stuck_with_one_count_of_flicker_does_not_lead_the_tool_to_the_ground(seed, size_m):
    scenario = Scenario("stuck", seed, 0.1, size_m, 1.5)
    found = play(standard(), scenario)
    assert not found.contact
    assert found.clearance_m > 0.07
    if size_m > 0.0:  # else a P loop climbs away from the ground that it does not see
        assert found.clearance_m > play(PLoop(), scenario).clearance_m - 5e-3


@pytest.mark.parametrize("family", ["near", "burst", "glitches", "lost", "biased"])
@pytest.mark.parametrize("seed", range(3))
def test_wrong_readings_bring_the_tool_hardly_nearer_than_a_p_loop_would(family, seed):
    scenario = draw(family, seed)
    ours, plain = play(standard(), scenario), play(PLoop(), scenario)
    assert not ours.contact_valid
    assert ours.clearance_m > plain.clearance_m - 5e-3, scenario


def test_a_demand_is_never_valid_while_nothing_entered_the_estimate():
    rng = np.random.default_rng(4)
    follower = standard(loss_timeout="0.4 s")
    readings = list(noisy(300)) + [
        float(rng.uniform(NEAR_M + 0.005, FAR_M - 0.005)) if k % 2 else math.nan for k in range(600)
    ]
    entered_ns, samples, longest = 0, 0, 0
    for t, _, state in drive(follower, readings):
        accepted = follower._state["adaptive"][0]["estimate"]["accepted_ns"]
        if accepted != samples:
            samples, entered_ns = accepted, t
        if "VALID" in state["status"]:
            longest = max(longest, t - entered_ns)
        else:
            assert state["reason"]
    assert longest <= 410 * MS


def test_a_lost_sensor_ends_in_no_demand_and_says_so():
    follower = standard(loss_timeout="0.2 s")
    states = list(drive(follower, [*noisy(200), *[math.nan] * 200]))
    _, demand, last = states[-1]
    assert "SENSOR_LOST" in last["status"]
    assert "VALID" not in last["status"]
    assert (demand == 0.0).all()
    assert last["health"] == "DROPOUT"
    assert last["reason"]
    assert "LOST" in last["faults"]
    early = [s for t, _, s in states if t < 200 * 4 * MS + 100 * MS]
    assert all("VALID" in s["status"] for s in early[10:])


def test_every_state_but_ok_has_a_reason():
    rng = np.random.default_rng(7)
    readings = noisy(900, 2)
    readings[300:306] += 0.02
    readings[400:460] = np.nan
    readings[600:660] = NEAR_M - 0.01
    seen = set()
    for _, _, state in drive(standard(), readings + 1e-6 * rng.standard_normal(900)):
        seen.add(state["health"])
        assert (state["health"] == "OK") == (state["reason"] in ("", REASON_NAMES[REASON_TESTED]))
    assert {"OK", "SUSPECT", "DROPOUT"} <= seen


def test_a_torch_at_4_mm_is_not_called_too_close_at_its_stand_off():
    follower = Follower(
        {"sensors": [{"near_m": 0.5e-3, "far_m": 15e-3}], "plant": {"tau_s": 0.03}},
        offset_m=4e-3,
    )
    for _, _, state in drive(follower, 4e-3 + 5e-5 * np.random.default_rng(1).standard_normal(400), z=4e-3):
        assert "TOO_CLOSE" not in state["status"]
    assert state["status"] == ["VALID"]
    assert state["health"] == "OK"


@pytest.mark.parametrize("mode", ["adaptive"])
def test_the_threshold_of_too_close_lies_between_the_window_and_the_stand_off(mode):
    follower = Follower({"mode": mode, "sensors": [{"near_m": 0.5e-3, "far_m": 15e-3}]}, offset_m=4e-3)
    states = [s for _, _, s in drive(follower, [4e-3] * 20 + [0.6e-3] * 8, z=4e-3)]
    assert "TOO_CLOSE" not in states[19]["status"]
    assert "TOO_CLOSE" in states[-1]["status"]
    assert states[-1]["demand"][2] > 0.0


@pytest.mark.parametrize("mode", ["paper", "adaptive"])
@pytest.mark.parametrize(
    ("config", "offset_m", "word"),
    [
        ({"sensors": [{"near_m": 0.05, "far_m": 0.15}]}, 0.2, "outside the sensor's window"),
        ({"sensors": [{"near_m": 0.05, "far_m": 0.15}]}, 0.04, "outside the sensor's window"),
        ({"sensors": [{"near_m": 0.05, "far_m": 0.15}], "too_close_m": 0.1}, 0.1, "too_close_m"),
    ],
)
def test_a_stand_off_that_cannot_be_kept_is_refused(mode, config, offset_m, word):
    with pytest.raises(ConfigError, match=word):
        Follower({"mode": mode, **config}, offset_m=offset_m)


def test_a_reset_to_an_impossible_stand_off_changes_nothing():
    follower = standard()
    with pytest.raises(ConfigError, match="outside the sensor's window"):
        follower.reset(offset_m=0.3)
    assert follower.state()["offset_m"] == STANDOFF_M


def test_a_wavy_path_there_and_back_is_followed_after_the_turn():
    """The slope along the path changes its sign with the direction of travel."""
    follower, z, errors = standard(), STANDOFF_M, []
    rng = np.random.default_rng(3)
    x, direction = 0.0, 1.0
    for k in range(2500):
        t = k * 4 * MS
        direction = 1.0 if k < 1250 else -1.0
        x += direction * 0.1 * 4e-3
        ground = 0.15 * x
        if k % 2 == 0:
            follower.pose(t, (x, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        demand = follower.step(t, [z - ground + 2e-4 * rng.standard_normal()])[2]
        if k % 2 == 0:
            z += 0.18 * demand
        errors.append(z - ground - STANDOFF_M)
    rms = float(np.sqrt(np.mean(np.square(errors[1400:]))))
    assert np.abs(errors[1250:1400]).max() < 4e-3
    assert rms < 0.4e-3, rms


@pytest.mark.parametrize("seed", range(3))
def test_timestamps_that_go_back_are_noticed_and_corrected(seed):
    """On a rising path old timestamps put the ground elsewhere; readings count as old as usual instead."""
    rng, late_ms, speed, slope = np.random.default_rng(seed), 30, 0.3, 0.15
    z, errors, reasons, health = STANDOFF_M, [], set(), ""
    follower, queue = standard(), []
    for ms in range(3000):
        ground = slope * speed * ms * 1e-3
        if ms % 10 == 0:
            follower.pose(ms * MS, (speed * ms * 1e-3, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        if ms % 4 == 0:
            wrong = 100 if 1500 <= ms < 2200 else 0
            queue.append((ms + late_ms, ms - wrong, z - ground + 2e-4 * rng.standard_normal()))
        while queue and queue[0][0] <= ms:
            follower.step(queue[0][1] * MS, [queue[0][2]])
            queue.pop(0)
        if ms % 10 == 0:
            target = z + follower.step(ms * MS, [math.nan])[2]
        z += (target - z) / 40.0
        errors.append(z - ground - STANDOFF_M)
        state = follower.state()
        if 1700 < ms < 2200:
            reasons.add(state["reason"])
        health = state["health"]
    assert any("timestamps" in r for r in reasons), reasons
    assert health == "OK"
    assert np.abs(errors[1000:]).max() < 2e-3, np.abs(errors[1000:]).max()
