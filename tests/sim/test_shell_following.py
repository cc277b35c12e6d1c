"""Robot, simulated sensors and the follower's kernels over a curved shell, without processes or clocks."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from shell_loop import ShellLoop
from surffollow.hw.fault_schedule import FaultConfig
from surffollow.shm.layout_follow import VALID
from surffollow.sim.robot_config import RobotConfig
from surffollow.sim.world_surface import WorldConfig

DOME = WorldConfig(surface="dome", region=(0.0, 0.0, 1.2, 1.0), grid_m=2e-3)
# down the steep side, round the turn and back
REGION = (0.63, 0.35, 0.99, 0.65)


def follow(
    seconds: float, sensors: int = 4, faults: tuple[FaultConfig, ...] = (), seed: int = 3
) -> ShellLoop:
    task = RobotConfig(
        world=DOME,
        path="raster",
        region=REGION,
        speed_mps=0.1,
        lane_m=0.1,
        seconds=seconds,
        turn=True,
        unscored_m=0.03,
    )
    loop = ShellLoop(task, sensors, faults, seed)
    loop.run(seconds + 3.0)
    return loop


def scored(loop: ShellLoop) -> dict[str, Any]:
    trace = loop.core.trace()
    return {k: v[trace["scored"] > 0] for k, v in trace.items()}


def changes(loop: ShellLoop) -> tuple[np.ndarray, np.ndarray]:
    """Changes of the demand from cycle to cycle of one pose, after the start: z [m], rotation [rad]."""
    demand, pose, status = (loop.column(n) for n in ("demand", "pose_t_ns", "status"))
    same = (pose[1:] == pose[:-1]) & (status[1:] & status[:-1] & VALID != 0)
    same &= np.arange(1, len(pose)) > 1500
    step = np.diff(demand, axis=0)[same]
    return np.abs(step[:, 2]), np.linalg.norm(step[:, 3:], axis=1)


@pytest.mark.parametrize("sensors", [3, 4])
def test_the_tool_keeps_its_stand_off_and_stays_normal_to_a_shell(sensors: int) -> None:
    loop = follow(5.0, sensors)
    summary, trace = loop.core.summary(), scored(loop)
    assert np.degrees(trace["tilt_rad"]).max() > 17.0
    # a ring alone cannot tell the shell's bulge, 0.45 mm
    assert summary["standoff_rms_m"] <= (0.42e-3 if sensors == 4 else 0.7e-3)
    assert math.degrees(summary["angle_rms_rad"]) <= 0.4
    assert loop.controller.held < 20


def test_sensors_that_drop_out_one_by_one_and_come_back_make_no_jump_on_a_shell() -> None:
    faults = (
        FaultConfig("dropout", 1.8, 4.6, channel=0),
        FaultConfig("invalid", 2.4, 4.2, channel=3),
        FaultConfig("dropout", 3.0, 3.8, channel=1),
    )
    loop = follow(5.5, 4, faults)
    beams = loop.column("beams")
    assert {0b0100, 0b0110, 0b1110, 0b1111} <= set(beams.tolist())
    rise, turn = changes(loop)
    assert rise.max() < 1e-3
    assert turn.max() <= 1.02e-3  # max_turn_speed_radps at 1 kHz, as a rotation vector
    demand = loop.column("demand")
    assert np.isfinite(demand).all()
    assert (loop.column("status")[1500:] & VALID != 0).all()
    trace = scored(loop)
    assert np.abs(trace["standoff_m"] - 0.1).max() < 5e-3
    assert np.degrees(trace["angle_rad"]).max() < 8.0
    settled = trace["t_s"] > 5.6
    assert np.degrees(trace["angle_rad"][settled]).max() < 1.0


def test_a_single_sensor_that_is_left_gives_the_slope_by_its_track() -> None:
    """GIVEN four sensors WHEN three drop out for good THEN the normal follows (6 degrees without)."""
    loop = follow(5.5, 4, tuple(FaultConfig("dropout", 1.8, 9.0, channel=c) for c in (0, 1, 3)))
    summary = loop.core.summary()
    assert set(loop.column("beams")[2500:].tolist()) == {0b0100}
    assert math.degrees(summary["angle_rms_rad"]) < 2.2
    assert summary["standoff_rms_m"] < 0.7e-3


def test_good_sensors_are_seldom_held_where_a_dome_steepens() -> None:
    """GIVEN a long descent WHEN the setpoint is shifted to test the range THEN most runs answer in time.

    While the delay did not count, seven of these eight runs were held, and their mean RMS was 0.34 mm.
    """
    errors = [scored(follow(5.0, seed=seed))["standoff_m"] - 0.1 for seed in range(1, 9)]
    rms_m = float(np.mean([np.sqrt(np.mean(e**2)) for e in errors]))
    held = sum(int(np.abs(e).max() > 1e-3) for e in errors)
    print(f"mean RMS {1e3 * rms_m:.2f} mm, {held} of {len(errors)} runs beyond 1 mm")
    assert rms_m < 0.33e-3
    assert held <= 6


@pytest.mark.parametrize("kind", ["stuck", "spike"])
def test_one_bad_sensor_of_four_hardly_moves_the_tool(kind: Any) -> None:
    highest_m, rms_m = [], []
    for seed in range(1, 9):
        loop = follow(4.0, 4, (FaultConfig(kind, 1.5, 5.0, channel=2),), seed=seed)
        trace, (rise, turn) = scored(loop), changes(loop)
        error_m = trace["standoff_m"] - 0.1
        assert error_m.min() > -1e-3
        assert np.degrees(trace["angle_rad"]).max() < 2.0
        assert rise.max() < 1e-3
        assert turn.max() <= 1.02e-3
        highest_m.append(error_m.max())
        rms_m.append(np.sqrt(np.mean(error_m**2)))
    print(f"highest {1e3 * np.array(highest_m)} mm, RMS {1e3 * np.array(rms_m)} mm")
    # where the dome steepens, a shift of the setpoint may stay unanswered, and the tool is held for a moment
    assert max(highest_m) < 6e-3
    assert np.median(highest_m) < 2e-3
    assert np.mean(rms_m) < 0.5e-3
