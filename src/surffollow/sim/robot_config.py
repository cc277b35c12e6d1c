"""Configuration of the simulated robot, and its path over a field."""

from __future__ import annotations

import math

import msgspec

from surffollow.errors import ConfigError
from surffollow.sim.plant import PlantConfig
from surffollow.sim.raster import FILES, KINDS, Path, file_path, line_path, raster_path, refuse_outside
from surffollow.sim.surfaces import HeightField, Region
from surffollow.sim.world_surface import WorldConfig

FOR_EVER_S = 86_400.0
_UNITS = {
    "mps": "m/s",
    "mps2": "m/s²",
    "m": "m",
    "s": "s",
    "seconds": "s",
    "rad": "rad",
}  # by the ending of a name

# the tool starts so much above the desired stand-off, and no greater part of it: a small window is left soon
APPROACH_M, APPROACH_PART = 0.010, 0.1
_OPTIONS = {  # of `surffollow simulate`
    "speed_mps": "--speed",
    "lane_m": "--lane",
    "seconds": "--seconds",
    "standoff_m": "--standoff",
    "report_latency_s": "--latency",
    "report_sigma_m": "--sigma",
}


class RobotConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A simulated robot and its task.

    Attributes
    ----------
    world : the ground, the same as the service's simulated sensors have
    path : "line" (to and fro through the middle), "raster", or a file (see `raster.file_path`): its times,
        heights and attitudes are kept, a demand corrects the height (with `turn` the attitude, too)
    region : part of the ground that the path keeps to; None: all of it
    speed_mps, accel_mps2 : along the path [m/s], [m/s²]
    lane_m : distance of a raster's lanes [m]
    seconds : of motion along the path; 0: to its end (a line: for ever)
    standoff_m : desired distance of the tool above the ground [m]
    unscored_m : first piece of the path, where the follower still learns [m]; None: as long as the stand-off
    report_latency_s, report_sigma_m : of pose reports [s], noise of x, y and z [m]
    retract_m : without a valid demand, rise so far above the held height [m]; 0: hold it
    command_timeout_s : a controller that says nothing for so long is dead: the drives stop by themselves [s]
    turn, report_turn_sigma_rad : apply the demanded rotations, too; noise of the reported attitude [rad]
    seed : of that noise
    plant : vertical axis and rate of controller and reports
    """

    world: WorldConfig = WorldConfig()
    path: str = "line"
    region: Region | None = None
    speed_mps: float = 0.05
    accel_mps2: float = 0.2
    lane_m: float = 0.02
    seconds: float = 20.0
    standoff_m: float = 0.1
    unscored_m: float | None = None
    report_latency_s: float = 0.010
    report_sigma_m: float = 0.05e-3
    retract_m: float = 0.0
    command_timeout_s: float = 0.05
    turn: bool = False
    report_turn_sigma_rad: float = 0.1e-3
    seed: int = 1
    plant: PlantConfig = PlantConfig()

    def __post_init__(self) -> None:
        if self.path not in KINDS and not self.path.lower().endswith(FILES):
            raise ConfigError(
                f"path '{self.path}' is unknown; one of: {', '.join(KINDS)}, or a file that ends in "
                f"{' or '.join(FILES)}"
            )
        bounds = {
            "speed_mps": (1e-3, 2.0),
            "accel_mps2": (1e-2, 10.0),
            "lane_m": (2e-3, 10.0),
            "seconds": (0.0, FOR_EVER_S),
            "standoff_m": (1e-3, 10.0),
            "unscored_m": (0.0, 1e3),
            "report_latency_s": (0.0, 0.09),
            "report_sigma_m": (0.0, 0.1),
            "retract_m": (0.0, 1.0),
            "command_timeout_s": (0.01, 10.0),
            "report_turn_sigma_rad": (0.0, 0.1),
        }
        for name, (low, high) in bounds.items():
            value = getattr(self, name)
            if value is None:
                continue
            if not low <= value <= high:
                unit = _UNITS[name.rpartition("_")[2]]
                option = f" ({_OPTIONS[name]})" if name in _OPTIONS else ""
                raise ConfigError(
                    f"robot {name} = {value:g} {unit}, expected {low:g} to {high:g} {unit}{option}; a number "
                    f"without a unit is in {unit}"
                )

    @property
    def approach_m(self) -> float:
        """Height above the desired stand-off at which the tool starts [m]."""
        return min(APPROACH_M, APPROACH_PART * self.standoff_m)

    @property
    def score_from_m(self) -> float:
        """Length of the first piece of the path, which is not scored [m]."""
        return self.standoff_m if self.unscored_m is None else self.unscored_m

    @property
    def unscored_s(self) -> float:
        """Time that a line or a raster from rest takes to the end of its unscored piece [s]."""
        v, a, way = self.speed_mps, self.accel_mps2, self.score_from_m
        return math.sqrt(2.0 * way / a) if way < 0.5 * v * v / a else way / v + 0.5 * v / a


def make_path(config: RobotConfig, field: HeightField) -> Path:
    """Lay the path of a configuration over a field."""
    region = config.region if config.region is not None else field.region
    refuse_outside(region, field.region)
    if config.path not in KINDS:
        return file_path(config.path, config.speed_mps, config.accel_mps2, field.region)
    if config.path == "raster":
        return raster_path(region, config.speed_mps, config.accel_mps2, config.lane_m)
    seconds = config.seconds if config.seconds > 0.0 else 3600.0
    return line_path(region, config.speed_mps, config.accel_mps2, config.speed_mps * seconds)
