"""Start service and arbiter once and scan a little, alone: both processors compile what is then loaded."""

from __future__ import annotations

import os
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from arbiter.running import Running
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
        reported = PlanSettings(region, 0.05, disc(0.05), scheme=scheme, base_m=base)
        path = plan_scan(ground, reported)
    tip = np.nan_to_num(path.position_m)
    tip_deflection(tip, 100.0, np.array(base), Compliance())
    laser_range(field, tip, np.ascontiguousarray(path.normal))
    robot = ScanRobot(path.changed(position_m=tip), ScanRobotConfig(), 0)
    robot.advance(10_000_000)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor() as beside:
        service, arbiter = Service(Path(folder), config_text(kind="simulated")), Running(Path(folder))
        arbiter.program = ("-m", "surffollow.cli.main")  # as the service's options: two processes, not forked
        try:
            started = beside.submit(arbiter.start)
            service.start(env=dict(os.environ)).terminate()
            started.result()
        finally:
            service.purge()
            arbiter.purge()
    warm_scan()
