"""Compile what the tests load: the kernels of service, arbiter, robot, scan, sonar, records and benchmark.

The service compiles the follower; the work that needs no follower is done beside it, the rest afterwards.
Both processors are busy all the time, and no kernel is compiled twice.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from arbiter.arbiter_process import ArbiterProcess
from running_service import Service, config_text


def warm_scan() -> None:
    """Compile the kernels of mapping, planning, the simulated field and the arm on a path."""
    from surffollow.apps.scan_robot import ScanRobot
    from surffollow.apps.scan_robot_config import ScanRobotConfig
    from surffollow.scan.body import disc
    from surffollow.scan.camera import Camera, looking_down
    from surffollow.scan.image_files import DepthImage
    from surffollow.scan.plan import PlanSettings, plan_scan
    from surffollow.scan.surveying import SurveySettings, survey
    from surffollow.sim.field_ground import make_ground
    from surffollow.sim.field_sensors import laser_range
    from surffollow.sim.flexible_tip import Compliance, tip_deflection
    from surffollow.sim.stereo_camera import render_depth, stereo_disparity

    lens, place = (60.0, 60.0, 31.5, 23.5), looking_down(0.5, 0.5, 1.2)
    field = make_ground("hump", (0.0, 0.0, 1.0, 1.0), 1, grid_m=0.02, hump_at_m=(0.5, 0.5))
    depth = render_depth(field, place, lens, (48, 64), baseline_m=0.1)
    camera = Camera(*lens, place, baseline_m=0.1)
    disparity = stereo_disparity(depth, 6.0, np.random.default_rng(1))
    for which in ("cpf", "cpf-fast", "gaussian", "median"):
        settings = SurveySettings(grid_m=0.02, filter=which, min_pixels=5, average_m=0.02, fill_m=0.1)
        ground, _ = survey([DepthImage(disparity, "disparity", camera)], [], settings)
    region, base = (0.4, 0.4, 0.6, 0.6), (-0.5, 0.5, 0.5)
    for scheme in ("lanes", "arcs"):
        plan = PlanSettings(region, 0.05, disc(0.05), scheme=scheme, base_m=base)
        path = plan_scan(ground, plan)
    tip = np.nan_to_num(path.position_m)
    tip_deflection(tip, 100.0, np.array(base), Compliance())
    laser_range(field, tip, np.ascontiguousarray(path.normal))
    robot = ScanRobot(path.changed(position_m=tip), ScanRobotConfig(), 0)
    robot.advance(10_000_000)


def warm_sonar() -> None:
    """Walls from a ring, and the base that carries it."""
    from surffollow.apps.wall_following import run_experiment
    from surffollow.sonar import fused_pose

    fused_pose([(0.35, 0.0), (0.35, 0.0)], (0.0, 0.26), (0.8, 0.8), 0.2, sigma_m=0.01)
    run_experiment("paper", laps=1)


def warm_table() -> None:
    """The exploration of the arbiter's table."""
    from surffollow.arbiter.check import check_table

    check_table()


def warm_map() -> None:
    """Refocus and reading of a height map."""
    from surffollow.map import HeightMap

    ground = HeightMap.from_heights(np.zeros((20, 20)), origin_m=(0.0, 0.0), grid_m=0.01)
    ground.add(np.array([[0.05, 0.05, 0.0]]))
    ground.refocus((0.05, 0.05, 0.3, 0.3))


def warm_robot() -> None:
    """The simulated robot on its path."""
    from surffollow.sim.robot import RobotConfig, RobotCore

    settings = RobotConfig(path="line", seconds=1.0)
    RobotCore(settings, settings.world.make(), 10**12).advance(10**12 + 10_000_000)


def warm_recorder() -> None:
    """A log, its channels, and the map of its points."""
    from surffollow.record.channel_feed import ChannelFeed
    from surffollow.record.map_rebuild import rebuild_map
    from surffollow.record.recorder import Recorder
    from surffollow.record.recording_writer import RecordingWriter
    from surffollow.record.synthetic_log import SyntheticLog

    with tempfile.TemporaryDirectory() as folder:
        log, path = SyntheticLog(), Path(folder, "log.mcap")
        writer = RecordingWriter(path, {"name": "log"}, force=True)
        feed = ChannelFeed(writer, 10_000_000)
        recorder = Recorder(log, writer, feed)
        log.run(1000)
        recorder.poll()
        feed.work()
        recorder.finish()
        rebuild_map(path)


def warm_replay() -> None:
    """The replay of a recording."""
    from surffollow.record.replay import warm_up

    warm_up()


def warm_limit() -> None:
    """The path of the theoretical limit."""
    from surffollow.benchmark.limit import bounded_path

    path = np.zeros(100)
    bounded_path(path, 1e-3, 1e-3, np.empty_like(path))


def warm_baselines() -> None:
    """A baseline of the benchmark."""
    from surffollow.benchmark.conditions import Conditions
    from surffollow.benchmark.runner import run_method
    from surffollow.benchmark.scene import make_scene
    from surffollow.sim.profiles import SHAPES

    run_method("p", make_scene(SHAPES["flat"](0), 0.2, 0, Conditions()))


# the longest first; one process does what needs no kernel of the follower, two do the rest
BESIDE = (warm_sonar, warm_table, warm_baselines, warm_scan, warm_limit, warm_robot, warm_map)
AFTER = (warm_recorder, warm_replay)


def start_and_stop(folder: Path) -> None:
    """Start the service, which has a helper, and the arbiter beside each other."""
    service, arbiter = Service(folder, config_text(kind="simulated")), ArbiterProcess(folder)
    arbiter.program = ("-m", "surffollow.cli.main")  # as the service's options: two processes, not forked
    try:
        with ThreadPoolExecutor() as beside:
            started = beside.submit(arbiter.start)
            service.start(env=dict(os.environ)).terminate()
            started.result()
    finally:
        service.purge()
        arbiter.purge()


def in_turn(works: Sequence[Callable[[], None]]) -> None:
    """One after the other."""
    for work in works:
        work()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder, ProcessPoolExecutor(2, get_context("spawn")) as pool:
        beside = pool.submit(in_turn, BESIDE)
        start_and_stop(Path(folder))
        after = [pool.submit(work) for work in AFTER]
        for done in (beside, *after):
            done.result()
