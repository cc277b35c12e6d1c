"""The robot's vertical axis and its 100 Hz controller: one step function for benchmark and live simulator.

The axis is the benchmark's: a sqrt controller makes the demanded velocity from the distance to the set
point, speed and acceleration are limited. The controller adds each demand to the pose report that the
demand refers to, never to a newer one.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from numpy.typing import NDArray

from surffollow.config.input_file import contents_are_read
from surffollow.config.key_errors import key_error_text
from surffollow.config.toml_file import read_toml
from surffollow.errors import ConfigError, UsageError
from surffollow.shm.jit import jit
from surffollow.units import parse_quantity

T = TypeVar("T", bound=msgspec.Struct)


class PlantConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A robot's vertical axis and controller; every field may be set in a TOML file.

    Attributes
    ----------
    tau_s : time constant of the position loop [s]; its gain is 1/τ
    v_max_mps, a_max_mps2 : limits of the vertical velocity [m/s] and acceleration [m/s²]
    tick_hz : rate of the controller [Hz]
    """

    tau_s: float = 0.040
    v_max_mps: float = 0.2
    a_max_mps2: float = 2.0
    tick_hz: float = 100.0

    def __post_init__(self) -> None:
        for name in ("tau_s", "v_max_mps", "a_max_mps2", "tick_hz"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ConfigError(f"plant {name} = {value}, expected a number above 0")
        if not 1.0 <= self.tick_hz <= 1000.0:
            raise ConfigError(f"plant tick_hz = {self.tick_hz}, expected 1 to 1000 (the axis steps in 1 ms)")


_UNITS = {"_mps2": "m/s^2", "_mps": "m/s", "_hz": "Hz", "_m": "m", "_s": "s"}
_OF_THE_BENCHMARK = ("pose", "sensor", "standoff", "standoff_m")


def _ending(name: str) -> str:
    """Unit ending of a field's name, "" if it has none."""
    return next((e for e in _UNITS if name.endswith(e)), "")


def from_table(table: dict[str, Any], kind: type[T], source: str) -> T:
    """Make a frozen configuration from a TOML table.

    Parameters
    ----------
    table : keys are the fields, with or without their unit ending; values SI numbers or text with a unit
    kind, source : the msgspec struct, and what error messages call the table

    Raises
    ------
    ConfigError
        unknown key, wrong unit, value out of range, a value given under two names
    """
    if not isinstance(table, dict):
        raise ConfigError(f"{source} is {table!r}; expected a table")
    fields = kind.__struct_fields__
    full = {name.removesuffix(_ending(name)): name for name in fields} | {name: name for name in fields}
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key not in full:
            raise ConfigError(f"{source} has the key '{key}'; its keys are {', '.join(fields)}")
        name = full[key]
        if name in values:
            other = next(k for k in table if full[k] == name)
            raise ConfigError(f"{source} gives '{name}' twice, as '{other}' and as '{key}'; give one of them")
        try:
            unit = _ending(name)
            values[name] = parse_quantity(value, _UNITS[unit]) if unit and isinstance(value, str) else value
        except UsageError as error:
            raise ConfigError(f"{source}, key '{key}': {error}") from None
    try:
        return msgspec.convert(values, kind)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{source}: {key_error_text(error, kind)}") from None


def read_tables(path: str | Path) -> dict[str, Any]:
    """Read a TOML file; ConfigError or InputFileError says why not."""
    return read_toml(path, "plant", ConfigError)


@contents_are_read()
def load_plant(path: str | Path) -> PlantConfig:
    """Read a `PlantConfig` from a TOML file; its keys are the fields, at top level or under [plant].

    Tables [pose] and [sensor] and the key `standoff` belong to the benchmark
    (`surffollow.benchmark.conditions`) and are passed over: one file serves both.

    Values are SI numbers or text with a unit (`tau = "40 ms"`).

    Raises
    ------
    InputFileError
        the file cannot be read
    ConfigError
        when it is not TOML, has an unknown key or table, a key both at top level and
        under [plant], or a value out of range
    """
    return plant_of(read_tables(path), path)


def plant_of(tables: dict[str, Any], path: str | Path) -> PlantConfig:
    """Plant of the tables that `read_tables` gave for a file; ConfigError as `load_plant`."""
    if not isinstance(tables.get("plant", {}), dict):
        raise ConfigError(f"plant '{path}': plant is no table; write [plant], or its keys at top level")
    twice = sorted(set(tables) & set(tables.get("plant", {})))
    if twice:
        raise ConfigError(f"plant '{path}' has '{twice[0]}' at top level and under [plant]; keep one of them")
    axis = {k: v for k, v in plant_keys(tables).items() if k not in _OF_THE_BENCHMARK}
    return from_table(axis, PlantConfig, f"plant '{path}'")


def plant_keys(table: dict[str, Any]) -> dict[str, Any]:
    """Return the keys at the top level and under [plant] of a plant file."""
    own: dict[str, Any] = table.get("plant", {})
    return {k: v for k, v in table.items() if k != "plant"} | own


@jit
def sqrt_velocity(distance_m: float, gain_hz: float, a_max_mps2: float, dt_s: float) -> float:
    """Velocity from which the axis can still stop at the setpoint with `a_max` (sqrt controller).

    Proportional near the setpoint, square root beyond: there a constant deceleration of a_max leads
    into the proportional part without a jump of acceleration.

    Parameters
    ----------
    distance_m : float64, setpoint − position [m]
    gain_hz : float64, 1/τ [1/s]
    a_max_mps2, dt_s : float64 [m/s²], [s]

    Returns
    -------
    float64 velocity [m/s]
    """
    linear_m = a_max_mps2 / (gain_hz * gain_hz)
    if distance_m > linear_m:
        v = math.sqrt(2.0 * a_max_mps2 * (distance_m - 0.5 * linear_m))
    elif distance_m < -linear_m:
        v = -math.sqrt(2.0 * a_max_mps2 * (-distance_m - 0.5 * linear_m))
    else:
        v = distance_m * gain_hz
    reach = abs(distance_m) / dt_s
    return min(max(v, -reach), reach)


@jit
def axis_step(
    axis: NDArray[Any], setpoint_m: float, tau_s: float, v_max_mps: float, a_max_mps2: float, dt_s: float
) -> None:
    """Advance the vertical axis by one step.

    Parameters
    ----------
    axis : (2,) float64, position [m] and velocity [m/s], updated in place
    setpoint_m : float64 [m]
    tau_s, v_max_mps, a_max_mps2 : float64, see `PlantConfig`
    dt_s : float64 [s]; the benchmark and the live robot use 1 ms
    """
    v = axis[1]
    desired = sqrt_velocity(setpoint_m - axis[0], 1.0 / tau_s, a_max_mps2, dt_s)
    desired = min(max(desired, -v_max_mps), v_max_mps)
    change = a_max_mps2 * dt_s
    v += min(max(desired - v, -change), change)
    axis[1] = v
    axis[0] += v * dt_s


@jit
def setpoint_for(report_m: float, demand_m: float) -> float:
    """Setpoint from a demand and the report it refers to; a demand that is not finite holds the report.

    Parameters
    ----------
    report_m : float64, height in the report that the demand refers to [m]
    demand_m : float64, what the follower asks to add to it [m]
    """
    if math.isfinite(demand_m):
        return report_m + demand_m
    return report_m
