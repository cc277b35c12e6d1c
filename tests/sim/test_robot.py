"""The simulated robot: its path, its late noisy reports, its response to demands."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from robots import FLAT, MS, REGION, START, PerfectService, drive, robot

from surffollow.errors import (
    ConfigError,
    FaultError,
    LayoutMismatchError,
    NoPermissionError,
    NotRunningError,
    PoseError,
    RefusedError,
    UsageError,
)
from surffollow.sim.plant import PlantConfig
from surffollow.sim.raster import MARGIN_M, line_path, raster_path, slow_down
from surffollow.sim.robot import RobotCore
from surffollow.sim.robot_config import APPROACH_M, RobotConfig
from surffollow.sim.robot_run import Controller, held_too_long, run_robot
from surffollow.sim.surfaces import sine_field, step_field
from surffollow.sim.world import WorldReader
from surffollow.sim.world_surface import WorldConfig


def test_robot_starts_above_the_desired_stand_off_settles_and_only_then_moves() -> None:
    core, controller, _ = robot(seconds=5.0)
    drive(core, controller, 1)
    assert core.standoff_m == pytest.approx(0.1 + APPROACH_M, abs=1e-6)
    drive(core, controller, 300)
    trace = core.trace()
    moved = np.argmax(trace["x_m"] > trace["x_m"][0] + 1e-6)
    assert abs(trace["standoff_m"][moved] - 0.1) < 1e-3
    assert 0.3 < trace["t_s"][moved] < 1.5


def test_robot_moves_at_its_speed_and_stops_when_its_time_is_over() -> None:
    core, controller, _ = robot(seconds=4.0, speed_mps=0.1)
    while not core.done:
        drive(core, controller, 1)
    summary = core.summary()
    assert summary["moving_s"] == pytest.approx(4.0, abs=0.02)
    assert summary["path_m"] == pytest.approx(0.4 - 0.1**2 / (2 * 0.2), abs=2e-3)


def test_reports_are_100_hz_stamped_10_ms_late_and_noisy_as_asked() -> None:
    core, controller, service = robot(seconds=60.0, report_sigma_m=1e-4)
    arrived: list[tuple[int, int]] = []

    def note() -> None:
        # the tick that posted it was 10 ms before the body got here
        arrived.append((core.t_ns - 10 * MS, service.poses[-1][0] if service.poses else 0))

    drive(core, controller, 1500, note)
    stamps = np.array([t for t, _ in service.poses])
    assert set(np.diff(stamps)) == {10 * MS}
    assert {now - stamp for now, stamp in arrived[5:]} == {10 * MS}
    trace = core.trace()
    rows = np.array([round((t - START) / MS) - 1 for t in stamps[20:]])
    for k, column in enumerate(("x_m", "y_m", "z_m")):
        error = np.array([pose[k] for _, pose in service.poses[20:]]) - trace[column][rows]
        assert error.std() == pytest.approx(1e-4, rel=0.1)
        assert abs(error.mean()) < 2e-5


def test_demand_is_added_to_the_report_it_refers_to_not_to_the_newest() -> None:
    core, controller, service = robot(report_sigma_m=0.0)
    drive(core, controller, 50)
    old_t, old_pose = service.poses[-8]
    core.command(0.003, old_t)
    assert core.motion["setpoint_m"][0] == pytest.approx(old_pose[2] + 0.003, abs=1e-12)


def test_demand_for_a_pose_that_was_never_sent_makes_the_robot_hold() -> None:
    core, controller, _ = robot()
    drive(core, controller, 100)
    core.command(0.01, 12345)
    assert core.holding
    assert core.motion["moving"][0] == 0


@pytest.mark.parametrize("z_m", [math.nan, math.inf])
def test_demand_that_is_no_number_makes_the_robot_hold(z_m: float) -> None:
    core, controller, service = robot()
    drive(core, controller, 100)
    core.command(z_m, service.poses[-1][0])
    assert core.holding


def test_without_a_valid_demand_the_robot_stops_where_it_is_and_goes_on_later() -> None:
    core, controller, service = robot(sine_field(REGION), seconds=20.0)
    drive(core, controller, 300)
    service.silent = True
    drive(core, controller, 60)
    x, z = core.world["pose"][0, 0], core.world["pose"][0, 2]
    drive(core, controller, 200)
    assert core.world["pose"][0, 0] == x
    assert core.world["pose"][0, 2] == pytest.approx(z, abs=1e-4)
    service.silent = False
    drive(core, controller, 100)
    assert core.world["pose"][0, 0] > x + 0.01
    assert 250 <= controller.held <= 265


def test_a_service_that_fails_is_attached_to_again() -> None:
    core, controller, service = robot(seconds=20.0)
    drive(core, controller, 200)
    good = service.dev_vector
    service.dev_vector = lambda: (_ for _ in ()).throw(NotRunningError("gone"))  # type: ignore[method-assign]
    drive(core, controller, 5)
    assert service.closed
    assert core.holding
    assert controller.fault == "gone"
    service.dev_vector = good  # type: ignore[method-assign]
    drive(core, controller, 60)
    assert controller.attachments == 2
    assert not core.holding


def test_a_service_that_started_anew_gets_the_stand_off_again() -> None:
    core, controller, service = robot(seconds=20.0, standoff_m=0.08)
    drive(core, controller, 200)
    assert service.resets == 1
    service.epoch, service.offset_m = 2, 0.1
    drive(core, controller, 100)
    assert service.resets == 2
    assert core.standoff_m == pytest.approx(0.08, abs=1e-3)


def test_a_refused_report_is_counted_and_changes_nothing() -> None:
    core, controller, service = robot(seconds=20.0)
    drive(core, controller, 100)
    service.ee_pos = lambda *a: (_ for _ in ()).throw(PoseError("too old"))  # type: ignore[method-assign]
    drive(core, controller, 10)
    assert controller.refused == 10
    assert not core.holding


def test_no_service_within_the_wait_is_an_error_that_says_why() -> None:
    def nobody() -> PerfectService:
        raise NotRunningError("no live service of that name")

    core = RobotCore(RobotConfig(), FLAT, START)
    with pytest.raises(NotRunningError, match="no live service"):
        Controller(core, nobody).connect(0.0)


@pytest.mark.parametrize("kind", [RefusedError, NoPermissionError, LayoutMismatchError])
def test_what_no_further_attempt_can_change_is_raised_at_once_and_as_it_is(
    kind: type[FaultError],
) -> None:
    error = kind("refused for good")

    def refuse() -> PerfectService:
        raise error

    core = RobotCore(RobotConfig(), FLAT, START)
    with pytest.raises(type(error)) as raised:
        Controller(core, refuse).connect(600.0)
    assert raised.value is error


def test_score_is_the_trace_s_own_after_the_first_100_mm_and_knows_rolling_ground() -> None:
    field = step_field(REGION, 0.4, 0.01)
    field.parts[:, 400:450] = 1
    core, controller, _ = robot(field, seconds=9.0)
    while not core.done:
        drive(core, controller, 1)
    trace, summary = core.trace(), core.summary()
    scored = trace["scored"] == 1
    assert trace["x_m"][scored].min() == pytest.approx(MARGIN_M + 0.1, abs=2e-4)
    error = trace["standoff_m"] - 0.1
    np.testing.assert_allclose(trace["standoff_m"], trace["z_m"] - trace["surface_m"], atol=1e-12)
    assert summary["n"] == scored.sum()
    assert summary["standoff_rms_m"] == pytest.approx(np.sqrt(np.mean(error[scored] ** 2)))
    assert summary["standoff_peak_m"] == pytest.approx(abs(error[scored]).max())
    rolling = scored & (trace["rolling"] == 1)
    assert summary["standoff_rms_rolling_m"] == pytest.approx(np.sqrt(np.mean(error[rolling] ** 2)))
    assert summary["standoff_peak_m"] > 5 * summary["standoff_peak_rolling_m"]
    near = abs(trace["x_m"] - 0.425) < 0.0445
    assert not rolling[near].any()
    assert rolling[scored & (abs(trace["x_m"] - 0.425) > 0.0465)].all()


def test_published_velocity_is_that_of_the_published_positions() -> None:
    core, controller, _ = robot(sine_field(REGION), path="raster", lane_m=0.05, seconds=0.0, speed_mps=0.2)
    rows = []
    for _ in range(800):
        controller.tick()
        for _ in range(10):
            core.advance(core.t_ns + MS)
            rows.append([*core.world["pose"][0, :3], *core.world["velocity"][0, :3]])
    table = np.array(rows)
    assert np.ptp(table[:, 1]) > 0.02
    # the path is a polygon: in a turn the direction changes by a millimetre's worth from point to point
    np.testing.assert_allclose(np.diff(table[:, :3], axis=0) / 1e-3, table[1:, 3:], atol=4e-3)


def test_line_goes_to_and_fro_and_slows_down_for_its_ends() -> None:
    path = line_path(REGION, 0.1, 0.2, 2.0)
    x, y, limit = path.points[:, :3].T
    assert path.length_m >= 2.0
    assert (x.min(), x.max()) == pytest.approx((MARGIN_M, 1.0 - MARGIN_M), abs=1e-3)
    assert (y == 0.15).all()
    turns = np.flatnonzero(np.diff(np.sign(np.diff(x))))
    assert len(turns) == 2
    assert all(limit[k : k + 3].min() == 0.0 for k in turns)
    assert limit.max() == 0.1
    assert (np.diff(limit**2) >= -2 * 0.2 * path.spacing_m - 1e-12).all()


def test_raster_covers_the_region_with_smooth_turns_that_keep_the_acceleration() -> None:
    path = raster_path(REGION, 0.2, 0.2, 0.02)
    x, y, limit = path.points[:, :3].T
    steps = np.hypot(np.diff(x), np.diff(y))
    np.testing.assert_allclose(steps, path.spacing_m, rtol=2e-2)
    assert x.min() >= MARGIN_M - 1e-9
    assert x.max() <= 1.0 - MARGIN_M + 1e-9
    assert (y.min(), y.max()) == pytest.approx((0.05, 0.25), abs=1e-3)
    heading = np.unwrap(np.arctan2(np.diff(y), np.diff(x)))
    curvature = abs(np.diff(heading)) / path.spacing_m
    assert (limit[1:-1] ** 2 * curvature).max() < 0.2 * 1.3
    lanes = np.unique(np.round(y[abs(x - 0.5) < 0.3], 6))
    np.testing.assert_allclose(lanes, 0.05 + 0.02 * np.arange(11), atol=1e-6)


def test_speed_limits_are_lowered_as_a_slow_loop_would() -> None:
    rng = np.random.default_rng(3)
    limit = rng.uniform(0.0, 1.0, 300)
    naive = [
        min(math.sqrt(limit[j] ** 2 + 2 * 0.3 * 0.01 * (j - i)) for j in range(i, 300)) for i in range(300)
    ]
    slow_down(limit, 0.3, 0.01)
    np.testing.assert_allclose(limit, naive, atol=1e-12)


@pytest.mark.parametrize(
    "make",
    [
        lambda: line_path((0, 0, 0.1, 1), 0.1, 0.2, 1.0),
        lambda: raster_path(REGION, 0.1, 0.2, 0.0),
        lambda: raster_path((0, 0, 1, 0.05), 0.1, 0.2, 0.02),
        lambda: raster_path((0, 0, 1e3, 1e3), 0.1, 0.2, 0.02),
    ],
)
def test_paths_that_do_not_fit_are_refused(make: Callable[[], object]) -> None:
    with pytest.raises(UsageError):
        make()


@pytest.mark.parametrize("wrong", [{"path": "spiral"}, {"speed_mps": 0.0}, {"seconds": math.nan}])
def test_robot_configuration_out_of_range_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        RobotConfig(**wrong)


def test_a_speed_out_of_range_is_refused_with_its_unit() -> None:
    says = r"speed_mps = 50 m/s, expected 0\.001 to 2 m/s \(--speed\); a number without a unit is in m/s"
    with pytest.raises(ConfigError, match=says):
        RobotConfig(speed_mps=50.0)


def test_motion_equals_a_slow_twin() -> None:
    core, controller, _ = robot(sine_field(REGION), seconds=3.0, speed_mps=0.2, plant=PlantConfig(tau_s=0.02))
    points, ds = core.path.points, core.path.spacing_m
    path, speed = 0.0, 0.0
    for _ in range(250):
        controller.tick()
        moving = core.motion["moving"][0]
        for _ in range(10):
            desired = max(np.interp(path / ds, np.arange(len(points)), points[:, 2]), 1e-3) if moving else 0.0
            speed = min(max(desired, speed - 1.5 * 0.2e-3), speed + 0.2e-3)
            path += speed * 1e-3
        core.advance(core.t_ns + 10 * MS)
        assert core.motion["path_m"][0] == pytest.approx(path, abs=1e-9)
        assert core.motion["x_m"][0] == pytest.approx(
            np.interp(path / ds, np.arange(len(points)), points[:, 0]), abs=1e-9
        )


def test_live_run_publishes_its_true_pose_in_wall_time_and_cleans_up() -> None:
    name = f"test-robot-{os.getpid()}"
    config = RobotConfig(
        world=WorldConfig(surface="flat", region=(0.0, 0.0, 0.5, 0.2)), seconds=0.2, speed_mps=0.1
    )

    def run() -> tuple[Any, Any, PerfectService, list[Any]]:
        service = PerfectService(config.world.make())
        seen: list[Any] = []

        def stopped() -> bool:
            if service.poses:
                reader = WorldReader(name)
                seen.append(reader.latest())
                reader.close()
            return False

        return *run_robot(config, name, lambda: service, stopped), service, seen

    # a machine that stops the robot for 50 ms freezes its ways: another try
    tries = (run() for _ in range(5))
    core, summary, service, seen = next((t for t in tries if t[1]["frozen_s"] == 0.0), None) or run()
    assert core.done
    assert summary["finished"]
    assert summary["held_ticks"] < 10
    assert summary["frozen_s"] == 0.0
    assert (service.released, service.closed) == (True, True)
    stamps = [int(r["t_ns"][0]) for r in seen]
    assert stamps == sorted(stamps)
    assert not os.path.exists(f"/dev/shm/{name}.world")


def test_a_robot_whose_service_was_gone_for_most_of_the_run_has_not_finished() -> None:
    config = RobotConfig(
        world=WorldConfig(surface="flat", region=(0.0, 0.0, 0.5, 0.2)), seconds=1.5, speed_mps=0.1
    )
    service = PerfectService(config.world.make())

    def stopped() -> bool:
        service.silent = len(service.poses) > 50
        return False

    core, summary = run_robot(config, f"test-robot-{os.getpid()}", lambda: service, stopped)
    assert core.done
    assert held_too_long(summary["ticks"], summary["held_ticks"])
    assert not summary["finished"]
    assert not held_too_long(2000, 200)


@pytest.mark.parametrize("question", [1, 2, 3])
def test_a_stop_before_the_motion_leaves_no_block(question: int) -> None:
    config = RobotConfig(world=WorldConfig(surface="flat", region=(0.0, 0.0, 0.5, 0.2)), seconds=1.0)
    name = f"test-robot-{os.getpid()}"
    blocks: list[bool] = []

    def stopped() -> bool:
        blocks.append(os.path.exists(f"/dev/shm/{name}.world"))
        return len(blocks) == question

    def nobody() -> PerfectService:
        raise NotRunningError("no service")

    with pytest.raises(KeyboardInterrupt):
        run_robot(config, name, nobody, stopped)
    assert blocks == [False, True, True][:question]
    assert not os.path.exists(f"/dev/shm/{name}.world")
