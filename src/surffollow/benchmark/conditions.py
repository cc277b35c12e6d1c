"""Conditions of a benchmark run: plant, pose reports, sensor, lead, and how a demand is used."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import msgspec

from surffollow.config.input_file import contents_are_read
from surffollow.errors import ConfigError
from surffollow.sim.plant import PlantConfig, from_table, plant_keys, plant_of, read_tables

STANDOFF_M = 0.1016  # the middle of the sensor's 2-6 in window
UNSCORED_M = 0.1  # the first 100 mm of a path do not count


def _check(config: object, positive: tuple[str, ...], not_negative: tuple[str, ...]) -> None:
    for name in positive + not_negative:
        value = getattr(config, name)
        if not math.isfinite(value) or value < 0.0 or (name in positive and value == 0.0):
            kind = "above" if name in positive else "at least"
            raise ConfigError(f"{type(config).__name__}.{name} = {value}, expected a number {kind} 0")


class PoseConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Pose reports: rate [Hz], how late they arrive [s], noise of x and z [m]."""

    rate_hz: float = 100.0
    latency_s: float = 0.010
    sigma_m: float = 0.05e-3

    def __post_init__(self) -> None:
        _check(self, positive=("rate_hz",), not_negative=("latency_s", "sigma_m"))


class SensorConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The range sensor: a new reading `rate_hz` times a second, with timestamps, `latency_s` late.

    Attributes
    ----------
    rate_hz, latency_s, sigma_m : [Hz], [s], [m]
    near_m, far_m, bits : window [m] and the A/D converter's bits over it; outside there is no reading
    glitch_rate, glitch_m : share of readings that are off by a uniform error in ±glitch_m [m]
    """

    rate_hz: float = 250.0
    latency_s: float = 0.030
    sigma_m: float = 0.25e-3
    near_m: float = 0.0508
    far_m: float = 0.1524
    bits: int = 12
    glitch_rate: float = 0.01
    glitch_m: float = 0.03

    def __post_init__(self) -> None:
        _check(self, positive=("rate_hz",), not_negative=("latency_s", "sigma_m", "near_m", "glitch_m"))
        if not self.near_m < self.far_m < math.inf:
            raise ConfigError(f"sensor window {self.near_m} to {self.far_m} m, expected near_m < far_m")
        if not 0.0 <= self.glitch_rate <= 1.0 or not 1 <= self.bits <= 32:
            raise ConfigError("sensor glitch_rate must be 0 to 1 and bits 1 to 32")


class Conditions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything about a run but its surface, speed, seed and method.

    Attributes
    ----------
    lead_m : how far the sensor looks ahead of the tool [m]; results of different leads do not compare
    reference : what the controller adds a demand to: the newest report the follower had ("report"),
        or the newest report there is ("newest", which costs every method)
    nominal_tau_s : time constant that the follower is configured with [s]
    standoff_m : desired distance between tool and ground [m], inside the sensor's window
    unscored_m : so much of the path does not count at first [m]
    """

    plant: PlantConfig = PlantConfig()
    pose: PoseConfig = PoseConfig()
    sensor: SensorConfig = SensorConfig()
    lead_m: float = 0.0
    reference: Literal["report", "newest"] = "report"
    nominal_tau_s: float = 0.040
    standoff_m: float = STANDOFF_M
    unscored_m: float = UNSCORED_M

    def __post_init__(self) -> None:
        _check(self, positive=("nominal_tau_s", "standoff_m"), not_negative=("lead_m", "unscored_m"))
        near_m, far_m = self.sensor.near_m, self.sensor.far_m
        if not near_m < self.standoff_m < far_m:
            raise ConfigError(
                f"the stand-off {self.standoff_m:g} m is outside the window {near_m:g} to {far_m:g} m; "
                "in a plant file set standoff, or near and far under [sensor]"
            )

    def but(self, **changes: object) -> Conditions:
        """Return a copy in which some fields differ."""
        return msgspec.structs.replace(self, **changes)


PAPER_PROFILE = Conditions(pose=PoseConfig(rate_hz=32.0))


class _Standoff(msgspec.Struct, frozen=True):
    standoff_m: float | None = None


def default_standoff_m(sensor: SensorConfig) -> float:
    """Stand-off of a sensor [m]: that of the default sensor, or the middle of a window without it."""
    inside = sensor.near_m < STANDOFF_M < sensor.far_m
    return STANDOFF_M if inside else 0.5 * (sensor.near_m + sensor.far_m)


@contents_are_read()
def load_conditions(path: str | Path) -> Conditions:
    """Read plant, [pose], [sensor] and `standoff` from a TOML file; what it leaves out keeps its default.

    The follower is configured with the τ of the file; the plant sweep covers a wrong one. A file without
    `standoff` has that of `default_standoff_m`.

    Raises
    ------
    InputFileError
        it cannot be read
    ConfigError
        unknown key, value out of range, stand-off outside the sensor's window
    """
    table = read_tables(path)  # once: what a pipe gives is gone then
    plant = plant_of(table, path)
    pose = from_table(table.get("pose", {}), PoseConfig, f"[pose] of '{path}'")
    sensor = from_table(table.get("sensor", {}), SensorConfig, f"[sensor] of '{path}'")
    own = {k: v for k, v in plant_keys(table).items() if k in ("standoff", "standoff_m")}
    standoff_m = from_table(own, _Standoff, f"plant '{path}'").standoff_m
    if standoff_m is None:
        standoff_m = default_standoff_m(sensor)
    try:
        return Conditions(
            plant=plant, pose=pose, sensor=sensor, nominal_tau_s=plant.tau_s, standoff_m=standoff_m
        )
    except ConfigError as error:
        raise ConfigError(f"plant '{path}': {error}") from None
