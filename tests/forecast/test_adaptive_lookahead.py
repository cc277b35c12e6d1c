"""Buffered ground of a look-ahead sensor counts only on the path: turns, stops, curves."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from surffollow import Follower

MS = 1_000_000
AHEAD = {"position_m": [0.05, 0.0, 0.0]}
UNDER_AND_AHEAD = [{}, AHEAD]

Way = Callable[[float], tuple[float, float, float]]  # time [s] → x [m], y [m], yaw [rad]


class Run:
    """A robot with τ = 40 ms that travels a way over ground(x, y), from its first stand-off of 100 mm.

    `blocked_m`: range of the last sensor from 1 s on.
    """

    def __init__(self, sensors, way: Way, ground, seconds: float, blocked_m: float | None = None):
        self.f = f = Follower({"memory": False, "orient": 0, "sensors": sensors}, offset_m=0.1)
        mounts = [s.get("position_m", [0.0, 0.0])[:2] for s in sensors]
        rng = np.random.default_rng(0)
        z, v, goal = 0.1 + ground(*way(0.0)[:2]), 0.0, 0.0
        errors = []
        for k in range(int(seconds * 1e3)):
            t, (x, y, yaw) = 10**10 + k * MS, way(1e-3 * k)
            if k % 10 == 0:
                f.pose(t, (x, y, z, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)))
                reported = z
            if k % 4 == 0 or k % 10 == 0:
                c, s = math.cos(yaw), math.sin(yaw)
                spots = [(x + c * ahead - s * aside, y + s * ahead + c * aside) for ahead, aside in mounts]
                ranges = [z - ground(*spot) for spot in spots]
                if blocked_m is not None and k > 1000:
                    ranges[-1] = blocked_m
                d = f.step(t, [r + 5e-5 * rng.standard_normal() for r in ranges])
            if k % 10 == 0:
                goal = reported + d[2]
            expected = np.clip((goal - z) / 0.04, -0.2, 0.2)
            v += float(np.clip(expected - v, -2e-3, 2e-3))
            z += 1e-3 * v
            errors.append(z - ground(x, y) - 0.1)
        self.errors = np.array(errors)

    def rms_m(self, from_s: float) -> float:
        return float(np.sqrt(np.mean(self.errors[int(from_s * 1e3) :] ** 2)))

    def least_m(self, from_s: float = 1.0) -> float:
        return float(self.errors[int(from_s * 1e3) :].min())


def there_and_back(speed_mps: float, turn_m: float, rest_s: float = 0.0) -> Way:
    """Along x to `turn_m`, with 2 m/s² to a stop, a rest, and back."""
    brake_s = speed_mps / 2.0
    cruise_s = turn_m / speed_mps
    end_m = turn_m + 0.5 * speed_mps * brake_s

    def way(t: float) -> tuple[float, float, float]:
        if t < cruise_s:
            return speed_mps * t, 0.0, 0.0
        stopping = min(t - cruise_s, brake_s)
        x = turn_m + speed_mps * stopping - stopping**2
        back = t - cruise_s - brake_s - rest_s
        if back > 0.0:
            quick = min(back, brake_s)
            x = end_m - quick**2 - speed_mps * (back - quick)
        return x, 0.0, 0.0

    return way


def corner(speed_mps: float, turn_m: float) -> Way:
    """Along x, then along y; the tool does not yaw."""

    def way(t: float) -> tuple[float, float, float]:
        s = speed_mps * t
        return min(s, turn_m), max(s - turn_m, 0.0), 0.0

    return way


def hollow_from(edge_m: float, depth_m: float = 0.02):
    return lambda x, y: -depth_m if x > edge_m else 0.0


@pytest.mark.parametrize(
    ("speed_mps", "before_m", "rest_s"), [(0.1, 0.02, 0.0), (0.2, 0.04, 0.0), (0.1, 0.02, 1.0)]
)
def test_a_hollow_seen_ahead_is_not_followed_on_the_way_back(speed_mps, before_m, rest_s):
    way = there_and_back(speed_mps, 0.3, rest_s)
    end_m = 0.3 + speed_mps**2 / 4
    run = Run(UNDER_AND_AHEAD, way, hollow_from(end_m + before_m), 0.3 / speed_mps + rest_s + 1.5)
    assert run.least_m() > -1e-3
    assert max(abs(run.f._state["adaptive"][0]["known"]["bias_m"])) < 2e-4, "the sensors never differed"


def test_a_hollow_seen_ahead_is_not_followed_round_a_corner():
    run = Run(UNDER_AND_AHEAD, corner(0.1, 0.3), hollow_from(0.32), 4.5)
    assert run.least_m() > -1e-3


@pytest.mark.parametrize("speed_mps", [0.1, 0.2])
def test_a_corner_just_before_a_hollow_stops_the_dive_that_has_begun(speed_mps):
    run = Run(UNDER_AND_AHEAD, corner(speed_mps, 0.3), hollow_from(0.305), 0.3 / speed_mps + 1.0)
    assert run.least_m() > -10e-3


def test_a_trench_that_a_lone_sensor_saw_ahead_is_not_followed_round_a_corner():
    trench = lambda x, y: -0.02 if 0.32 < x < 0.34 else 0.0  # noqa: E731
    run = Run([AHEAD], corner(0.1, 0.3), trench, 4.5)
    assert run.least_m() > -1e-3


def test_a_sensor_ahead_that_stops_leads_no_longer():
    run = Run(UNDER_AND_AHEAD, lambda t: (min(0.1 * t, 0.3), 0.0, 0.0), lambda x, y: 0.0, 3.05)
    assert run.f._state["adaptive"][0]["lookahead"]["ahead_m"] == pytest.approx(0.05, abs=5e-3)
    run = Run(UNDER_AND_AHEAD, lambda t: (min(0.1 * t, 0.3), 0.0, 0.0), lambda x, y: 0.0, 3.3)
    assert run.f._state["adaptive"][0]["lookahead"]["ahead_m"] == 0.0


@pytest.mark.parametrize("blocked_m", [0.12, 0.15, 0.2])
def test_a_second_sensor_ahead_cannot_lead_the_tool_where_none_is_under_it(blocked_m):
    """GIVEN two sensors ahead WHEN the farther one is blocked THEN nothing changes on level ground.

    Its ground was buffered with that of the first, and fell with the tool: down to the ground, health OK.
    """
    sensors = [{"position_m": [x, 0.0, 0.0], "near_m": 0.03, "far_m": 0.25} for x in (0.02, 0.15)]
    run = Run(sensors, lambda t: (0.4 * t, 0.0, 0.0), lambda x, y: 0.0, 3.0, blocked_m)
    assert run.least_m() > -1e-3


@pytest.mark.parametrize("sensors", [UNDER_AND_AHEAD, [AHEAD]])
def test_on_a_gentle_curve_what_is_seen_ahead_still_helps(sensors):
    radius_m, speed_mps = 0.5, 0.1

    def way(t: float) -> tuple[float, float, float]:
        turned = speed_mps * t / radius_m
        return radius_m * math.sin(turned), radius_m * (1.0 - math.cos(turned)), turned

    def slopes(x: float, y: float) -> float:
        turned = math.atan2(x, radius_m - y)
        return 0.004 * math.tanh(3.0 * math.sin(2.0 * math.pi * turned * radius_m / 0.17))

    alone = Run([{}], way, slopes, 12.0).rms_m(6.0)
    assert Run(sensors, way, slopes, 12.0).rms_m(6.0) < 0.6 * alone


@pytest.mark.parametrize("height_m", [-0.02, 0.02])
def test_a_high_step_that_no_robot_can_follow_at_once_does_not_end_preview(height_m):
    run = Run(UNDER_AND_AHEAD, lambda t: (0.1 * t, 0.0, 0.0), lambda x, y: height_m if x > 0.3 else 0.0, 4.5)
    assert run.f.state()["preview_share"] == 1.0


@pytest.mark.parametrize("speed_mps", [0.05, 0.1, 0.3])
def test_a_hollow_seen_ahead_is_not_entered_before_its_edge(speed_mps):
    run = Run(UNDER_AND_AHEAD, lambda t: (speed_mps * t, 0.0, 0.0), hollow_from(0.3), 0.3 / speed_mps)
    assert run.least_m(0.1 / speed_mps) > -3e-3
    run = Run(UNDER_AND_AHEAD, lambda t: (speed_mps * t, 0.0, 0.0), hollow_from(0.3, 0.003), 0.5 / speed_mps)
    assert run.rms_m(0.2 / speed_mps) < 0.7e-3, "a low step is still taken half before"


def ahead_share(slope: float, interval_ms: int, noise_m: float, noise_ahead_m: float) -> float:
    """Mean share of preview with a second sensor 50 mm ahead, over a slope with waves, at 100 mm/s."""
    f = Follower({"memory": False, "orient": 0, "sensors": UNDER_AND_AHEAD}, offset_m=0.1)
    rng, shares, z, goal = np.random.default_rng(1), [], 0.1, 0.1

    def ground(x: float) -> float:
        return slope * x + 2e-3 * math.sin(2.0 * math.pi * x / 0.2)

    for k in range(8000):
        t, x = 10**10 + k * MS, 1e-4 * k
        if k % 10 == 0:
            f.pose(t, (x, 0.0, z, 0.0, 0.0, 0.0, 1.0))
            reported = z
        if k % interval_ms == 0:
            under = z - ground(x) + noise_m * rng.standard_normal()
            f.step(t, [under, z - ground(x + 0.05) + noise_ahead_m * rng.standard_normal()])
        if k % 10 == 0:
            goal = reported + f.step(t, [math.nan, math.nan])[2]
            shares.append(f.state()["preview_share"])
        z += 1e-3 * float(np.clip((goal - z) / 0.04, -0.2, 0.2))
    return float(np.mean(shares[400:]))


@pytest.mark.parametrize(
    ("slope", "interval_ms", "noise_m"), [(0.2, 4, 0.25e-3), (0.2, 40, 0.25e-3), (0.05, 20, 1e-3)]
)
def test_a_slow_or_noisy_sensor_ahead_is_used_on_slopes(slope, interval_ms, noise_m):
    """Heights of two samples that differed by more than 1.5 mm were left out, and with them the sensor."""
    share = ahead_share(slope, interval_ms, noise_m, noise_m)
    print(f"share {share:.2f}")
    assert share > 0.9


def test_a_sensor_ahead_with_much_noise_is_not_used():
    """Each of its heights agreed with the ground under the tool; the error was three times that of none."""
    shares = [ahead_share(0.05, 4, 0.25e-3, noise_m) for noise_m in (0.25e-3, 3e-3)]
    print(f"shares {shares}")
    assert shares[0] > 0.9
    assert shares[1] < 0.2


def test_no_channel_leads_once_three_of_them_give_a_plane():
    """GIVEN a channel that leads WHEN the tool begins to be rotated THEN its heights serve no preview."""
    f = Follower(
        {"memory": False, "orient": 0, "sensors": [*UNDER_AND_AHEAD, {"position_m": [0.0, 0.05, 0.0]}]},
        offset_m=0.1,
    )
    leads = []
    for k in range(400):
        t = 10**10 + 4 * k * MS
        f.pose(t, (4e-4 * k, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
        if k == 300:
            f.set_params(orient="on")
        f.step(t, [0.1, 0.1, 0.1])
        leads.append(float(f._state["adaptive"]["lookahead"]["ahead_m"][0]))
    assert leads[299] > 0.04
    assert leads[-1] == 0.0


def test_a_sensor_beside_the_path_does_not_lead():
    """GIVEN a ridge 20 mm beside the path WHEN a channel ahead sees it THEN the tool does not rise for it."""

    def ridge_beside(x, y):
        return 0.02 if y > 0.01 and x > 0.15 else 0.0

    run = Run([{}, {"position_m": [0.05, 0.02, 0.0]}], lambda t: (0.1 * t, 0.0, 0.0), ridge_beside, 3.0)
    assert np.abs(run.errors[1000:]).max() < 5e-4
    assert run.f.state()["preview_share"] == 0.0
