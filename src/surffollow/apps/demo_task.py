"""Task of a demonstration, as the service's configuration and the robot's command line."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path

from surffollow.errors import UsageError
from surffollow.hw.simulation.led_config import FAR_M, NEAR_M
from surffollow.sim.mounts import around_tool
from surffollow.sim.raster import MARGIN_M
from surffollow.sim.robot_config import RobotConfig
from surffollow.sim.world_surface import DEFAULT_REGION, SURFACES

SHELL_REGION = (0.0, 0.0, 1.2, 1.0)  # of the ground when the tool turns
SHELL_LANE_M = 0.1
SHELL_HALF_M = 0.39  # half a lane: 20 degrees on a radius of 1 m, and the way in and out of the turns


@dataclass(frozen=True)
class DemoConfig:
    """Settings of the demonstration; lengths [m], speeds [m/s]."""

    seconds: float = 20.0
    speed_mps: float = 0.05
    surface: str = "fy91"
    seed: int = 91
    path: str = "raster"
    lane_m: float = 0.03
    offset_m: float = 0.1
    follow: dict[str, object] = field(default_factory=dict)
    sensors: int = 1
    faults: tuple[dict[str, object], ...] = ()
    parameters: str = "holder"  # rights to set parameters meanwhile: `access.parameters` of the service

    @property
    def turns(self) -> bool:
        """Whether the tool turns to the normal: three sensors measure it."""
        return self.sensors >= 3

    @property
    def ground(self) -> tuple[float, float, float, float]:
        """The simulated ground [m]."""
        return SHELL_REGION if self.turns else DEFAULT_REGION

    @property
    def region(self) -> tuple[float, float, float, float]:
        """Extent of the path [m]."""
        return self._shell_region() if self.turns else self._field_region()

    def _shell_region(self) -> tuple[float, float, float, float]:
        """Lanes about the middle of the shell, as many as the time takes."""
        x0, y0, x1, y1 = self.ground
        x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
        lane = 2 * (SHELL_HALF_M - MARGIN_M) + 0.5 * math.pi * SHELL_LANE_M
        lanes = math.ceil(self.seconds * self.speed_mps / lane) + 1
        half = 0.5 * SHELL_LANE_M * (lanes - 1) + MARGIN_M + 1e-6
        if half > 0.4 * (y1 - y0):
            raise UsageError(
                f"{self.seconds:g} s at {self.speed_mps:g} m/s do not fit on the simulated shell; "
                f"at this speed ask for at most {7 * lane / self.speed_mps - 1:.0f} s"
            )
        return (x - SHELL_HALF_M, y - half, x + SHELL_HALF_M, y + half)

    def _field_region(self) -> tuple[float, float, float, float]:
        """As many lanes as the time takes, half as much again for the turns."""
        x0, x1, y0 = 0.15, 0.75, 0.3
        lanes = math.ceil(1.5 * self.seconds * self.speed_mps / (x1 - x0 - 2 * MARGIN_M)) + 1
        height = 2 * MARGIN_M + self.lane_m * (lanes - 1) + 1e-6
        if y0 + height > DEFAULT_REGION[3]:
            most = (DEFAULT_REGION[3] - y0 - 2 * MARGIN_M) / self.lane_m * (x1 - x0 - 2 * MARGIN_M) / 1.5
            raise UsageError(
                f"{self.seconds:g} s at {self.speed_mps:g} m/s do not fit on the simulated field; "
                f"at this speed ask for at most {max(2.0, most / self.speed_mps):.0f} s"
            )
        return (x0, y0, x1, y0 + height)


def check_task(config: DemoConfig) -> None:
    """Find out before anything starts whether robot, service and sensor can do what is asked.

    Raises
    ------
    UsageError  an unknown surface, a speed or a stand-off out of bounds, a path that does not fit
    """
    if config.surface not in SURFACES:
        raise UsageError(f"surface '{config.surface}' is unknown; one of: {', '.join(SURFACES)}")
    if not NEAR_M < config.offset_m < FAR_M:
        raise UsageError(
            f"a stand-off of {config.offset_m * 1e3:g} mm cannot be kept: the simulated sensor sees "
            f"{NEAR_M * 1e3:g} to {FAR_M * 1e3:g} mm"
        )
    RobotConfig(speed_mps=config.speed_mps, seconds=config.seconds, standoff_m=config.offset_m)
    _ = config.region


def config_file(config: DemoConfig, folder: Path) -> Path:
    """Write the service's configuration into a folder."""
    follow = ({"mode": "adaptive", "orient": "on"} if config.turns else {}) | config.follow
    lines = [
        "[driver]",
        'kind = "simulated"',
        *_driver_lines(config),
        "[driver.world]",
        f'surface = "{config.surface}"',
        f"seed = {config.seed}",
        f"region = {list(config.ground)}",
        "[access]",
        f'parameters = "{config.parameters}"',
        "[follow]",
        f"offset = {config.offset_m!r}",
        *(f"{k} = {json.dumps(v)}" for k, v in follow.items()),
    ]
    path = folder / "service.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def _driver_lines(config: DemoConfig) -> list[str]:
    lines = []
    if config.sensors > 1:
        mounts = ", ".join(str(list(m)) for m in around_tool(config.sensors))
        lines += [f"channels = {config.sensors}", f"mounts = [{mounts}]"]
    if config.faults:
        tables = (
            "{" + ", ".join(f"{k} = {json.dumps(v)}" for k, v in f.items()) + "}" for f in config.faults
        )
        lines.append(f"faults = [{', '.join(tables)}]")
    return lines


def robot_words(config: DemoConfig, name: str, trace: Path) -> list[str]:
    """Command line of the robot's process; its trace goes to a file."""
    x0, y0, x1, y1 = (repr(v) for v in config.region)
    turn = ["--turn", "--field", *(repr(v) for v in config.ground)] if config.turns else []
    return [
        *("simulate", "--name", name, "--json", "--trace", str(trace), "--path", config.path),
        *turn,
        *("--speed", repr(config.speed_mps), "--seconds", repr(config.seconds), "--surface", config.surface),
        *("--seed", str(config.seed), "--region", x0, y0, x1, y1),
        *("--lane", repr(SHELL_LANE_M if config.turns else config.lane_m)),
        *("--standoff", repr(config.offset_m)),
    ]
