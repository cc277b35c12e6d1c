"""Sensors that give the surface normal and do not respond to the tool's own rotation."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow import Follower
from surffollow.benchmark.hazard_ground import quaternion
from surffollow.benchmark.hazard_scenarios import FAR_M, FOUR, NEAR_M, STANDOFF_M

MS = 1_000_000
TAU_S, SIGMA_M = 0.06, 0.25e-3
DOES_NOT_ROTATE = "readings do not respond to the tool's rotation; the tool does not rotate"


def turned(read, seconds: float, seed: int) -> tuple[float, set[str]]:
    """Last tilt [rad] and reasons of a tool that obeys the rotations demanded; `read(t, tilt)` in m."""
    rng = np.random.default_rng(seed)
    sensors = [{"near_m": NEAR_M, "far_m": FAR_M, "position_m": [x, y, 0.0]} for x, y in FOUR]
    f = Follower({"sensors": sensors}, offset_m=STANDOFF_M)
    tilt, reasons = np.zeros(2), set()
    for ms in range(0, int(1e3 * seconds), 4):
        t_ns = (1000 + ms) * MS
        f.pose(t_ns, (0.05e-3 * ms, 0.0, STANDOFF_M, *quaternion(tilt)))
        demand = f.step(t_ns, read(1e-3 * ms, tilt) + SIGMA_M * rng.standard_normal(4))
        tilt = tilt + np.array(demand[3:5]) * (4e-3 / TAU_S)
        reasons.add(f.state()["reason"])
    return float(np.hypot(*tilt)), reasons


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_ranges_that_do_not_respond_turn_the_tool_only_a_little(seed):
    """GIVEN four blocked sensors that seem to see a slope WHEN the tool turns THEN it stops, and says why."""
    slope_m = 0.05 * np.array([x for x, _ in FOUR])
    last, reasons = turned(lambda t, tilt: STANDOFF_M - (slope_m if t > 1.0 else 0.0), 4.0, seed)
    assert last < 0.4  # half of `max_tilt_rad`, which it reaches without the test
    assert DOES_NOT_ROTATE in reasons


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("slope", [0.05, 0.3])
def test_ranges_that_respond_pass_the_test(seed, slope):
    """GIVEN a plane WHEN the tool turns to its normal THEN the response is never called missing."""
    lever_x, lever_y = np.array(FOUR).T

    def read(t, tilt):
        rise = (slope if t > 1.0 else 0.0) + np.tan(tilt[1])
        return STANDOFF_M + lever_y * np.tan(tilt[0]) - lever_x * rise

    last, reasons = turned(read, 4.0, seed)
    assert last == pytest.approx(np.arctan(slope), abs=0.02)
    assert DOES_NOT_ROTATE not in reasons


@pytest.mark.parametrize("seed", [1, 2])
def test_ground_that_turns_steadily_is_followed(seed):
    """GIVEN a normal that turns by 0.2 rad/s WHEN the tool follows it with a lag THEN it is not stopped."""
    lever_x, lever_y = np.array(FOUR).T

    def read(t, tilt):
        turned_ground = np.tan(0.2 * max(t - 1.0, 0.0))
        return STANDOFF_M + lever_y * np.tan(tilt[0]) - lever_x * (turned_ground + np.tan(tilt[1]))

    last, _ = turned(read, 4.0, seed)
    assert last == pytest.approx(0.6, abs=0.03)
