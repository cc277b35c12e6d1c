"""The simulated robot without a valid demand: how it comes to rest, and within what time."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from robots import MS, REGION, drive, robot

from surffollow.errors import ConfigError
from surffollow.sim.robot_config import RobotConfig
from surffollow.sim.robot_stop import REST_MPS, clearance_m, stopping_distance_m, time_to_rest_s
from surffollow.sim.surfaces import sine_field

TOOLS = Path(__file__).parents[2] / "tools"


def speeds(core: Any) -> tuple[float, float]:
    return float(core.motion["speed_mps"][0]), float(core.motion["axis"][0, 1])


@pytest.mark.parametrize("settings", [{}, {"speed_mps": 0.2, "accel_mps2": 0.5}, {"report_latency_s": 0.05}])
@pytest.mark.parametrize("retract_m", [0.0, 0.02])
def test_without_a_demand_it_is_at_rest_in_the_stated_time_and_within_the_stated_way(
    settings: dict[str, float], retract_m: float
) -> None:
    core, controller, service = robot(sine_field(REGION), seconds=60.0, retract_m=retract_m, **settings)
    drive(core, controller, 300)
    config = core.config
    assert speeds(core)[0] == pytest.approx(config.speed_mps, rel=0.2)
    service.silent = True
    began_m = float(core.motion["path_m"][0])
    z_m = float(core.motion["axis"][0, 0])
    ticks = math.ceil(time_to_rest_s(config) * config.plant.tick_hz)
    drive(core, controller, ticks)

    def rests() -> None:
        along, up = speeds(core)
        assert along == 0.0
        assert up > -REST_MPS, "never down"

    rests()
    drive(core, controller, 100, rests)
    way_m = float(core.motion["path_m"][0]) - began_m
    assert 0.0 < way_m <= stopping_distance_m(config, 1.0 / config.plant.tick_hz) * 1.01
    # as last reported: late by the reports' latency
    late_m = config.plant.v_max_mps * config.report_latency_s
    assert float(core.motion["axis"][0, 0]) == pytest.approx(z_m + retract_m, abs=1e-3 + late_m)


@pytest.mark.parametrize("latency_s", [0.0, 0.05])
def test_losses_in_a_row_do_not_lead_the_tool_out_of_its_window(latency_s: float) -> None:
    """GIVEN a demand that is lost again before the tool is back THEN it retracts no farther.

    On a busy machine a tool climbed out of its sensor's window, and stayed there.
    """
    core, controller, service = robot(seconds=60.0, retract_m=0.02, report_latency_s=latency_s)
    drive(core, controller, 300)
    heights: list[float] = []
    for lost_ticks in [10] * 10 + [2] * 30:
        service.silent = True
        drive(core, controller, lost_ticks, lambda: heights.append(core.standoff_m))
        service.silent = False
        drive(core, controller, 2)
    assert max(heights) == pytest.approx(core.desired_m + 0.02, abs=1e-3)
    drive(core, controller, 100)
    assert core.standoff_m == pytest.approx(core.desired_m, abs=1e-3)
    service.silent = True
    drive(core, controller, 100)
    assert core.standoff_m == pytest.approx(core.desired_m + 0.02, abs=1e-3), "back, it retracts again"


def test_drives_whose_controller_says_nothing_more_stop_by_themselves() -> None:
    core, controller, _ = robot(seconds=60.0, command_timeout_s=0.05)
    drive(core, controller, 300)
    assert speeds(core)[0] > 0.04

    def tick() -> None:
        core.watch_commands()
        core.advance(core.t_ns + 10 * MS)

    for _ in range(4):
        tick()
    assert not core.holding, "not before its time"
    for _ in range(3 + math.ceil(time_to_rest_s(core.config) * 100)):
        tick()
    assert core.holding
    assert speeds(core)[0] == 0.0


def test_a_steep_way_needs_more_clearance_than_a_flat_one() -> None:
    config = RobotConfig(speed_mps=0.1, accel_mps2=0.2)
    assert stopping_distance_m(config, 0.03) == pytest.approx(0.1 * 0.03 + 0.1**2 / 0.4)
    assert clearance_m(config, 0.03, 0.0) == 0.0
    assert clearance_m(config, 0.03, math.pi / 4) == pytest.approx(stopping_distance_m(config, 0.03))


@pytest.mark.parametrize("settings", [{"retract_m": -0.1}, {"command_timeout_s": 0.0}])
def test_a_robot_that_cannot_stop_is_refused(settings: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(settings))):
        RobotConfig(**settings)


def test_the_tool_is_at_rest_in_time_whatever_is_taken_away() -> None:
    words = [
        sys.executable,
        str(TOOLS / "bench_stop.py"),
        "--json",
        "--trials",
        "5",
        "--seed",
        "3",
        "--retract",
    ]
    done = subprocess.run(words, capture_output=True, text=True, timeout=400)
    assert done.stdout, done.stderr
    result = json.loads(done.stdout)
    assert (done.returncode, result["failed"]) == (0, []), "\n".join(result["failed"])
    assert [row["trials"] for row in result["kinds"].values()] == [1] * 5


POLICIES = """
import os, threading
from surffollow.sim.hardware_priority import hardware_priority
with hardware_priority():
    seen = [os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK]
    thread = threading.Thread(target=lambda: seen.append(os.sched_getscheduler(0)))
    thread.start()
    thread.join()
    child = os.fork()
    if child == 0:
        os._exit(os.sched_getscheduler(0))
    seen.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
print(*seen, os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK)
"""


def test_a_robot_neither_hands_its_priority_on_nor_keeps_it() -> None:
    """GIVEN a robot under SCHED_FIFO WHEN it starts a program or a thread THEN that has the usual priority.

    Services that loaded their kernels under SCHED_FIFO kept a processor for ever.
    """
    done = subprocess.run([sys.executable, "-c", POLICIES], capture_output=True, text=True, check=True)
    own, thread, child, afterwards = map(int, done.stdout.split())
    if own != os.SCHED_FIFO:
        pytest.skip("this user may not use SCHED_FIFO")
    assert (thread, child, afterwards) == (os.SCHED_OTHER, os.SCHED_OTHER, os.SCHED_OTHER)
