"""Configuration of a follower in process: a dictionary or a TOML file, read and checked."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from surffollow.config.params import PARAMS, add_given, check_param, names_given, param_name
from surffollow.config.pose_limits import NORM_TOLERANCE
from surffollow.config.toml_file import read_toml
from surffollow.config.window_fit import check_fit, default_too_close
from surffollow.errors import ConfigError
from surffollow.forecast.reference_scales import scaled_defaults
from surffollow.shm.layout_follow import CHANNELS, MODE_ADAPTIVE
from surffollow.units import parse_quantity

Config = Mapping[str, Any] | str | Path | None

MAX_MOUNT_M = 1e3
TABLES = ("sensors", "plant", "memory")  # keys of the configuration that are no parameters
# what differs from the service's defaults: readings come ready-made with timestamps of their own
IN_PROCESS: dict[str, float] = {"mode": MODE_ADAPTIVE, "sensor_latency_ns": 0, "sensor_readings": 1}
_MODES = {"default": "adaptive", "ours": "adaptive"}
_PLANT = {"tau_s": "plant_tau_s", "v_max_mps": "plant_v_max_mps", "a_max_mps2": "plant_a_max_mps2"}
_WINDOW = {"near_m": "range_min_m", "far_m": "range_max_m"}


class FollowerSetup(NamedTuple):
    """A checked configuration.

    Attributes
    ----------
    values : dict          every parameter by its full name, in the parameter's unit
    mounts : list          per channel x y z [m], unit quaternion qx qy qz qw: tool from sensor
    use_memory : bool       use ground seen on earlier passes
    """

    values: dict[str, float]
    mounts: list[list[float]]
    use_memory: bool


def read_setup(config: Config, offset_m: float | None = None) -> FollowerSetup:
    """Read and check what `Follower` is given.

    Parameters
    ----------
    config : dict, path of a TOML file, or None     see `Follower`
    offset_m : float, optional                      instead of that of the configuration [m]

    Raises
    ------
    ConfigError  file not readable, unknown key, wrong unit, value out of bounds, a value given in two ways,
        sensors with different windows, window, stand-off and fold-back that do not fit each other
    """
    data = _read(config)
    use_memory = data.pop("memory", True)
    if not isinstance(use_memory, bool):
        raise ConfigError(f"memory is {use_memory!r}; it must be true or false")
    mounts = _mounts(data.pop("sensors", [{}]))
    plant = data.pop("plant", {})
    if not isinstance(plant, Mapping) or not set(plant) <= set(_PLANT):
        raise ConfigError(f"plant is {plant!r}; its keys are {', '.join(_PLANT)}")
    if isinstance(data.get("mode"), str):
        data["mode"] = _MODES.get(data["mode"], data["mode"])
    if offset_m is not None:
        names_given(data, others=TABLES)  # else two names of the stand-off would pass
        data = {k: v for k, v in data.items() if param_name(k) != "offset_m"} | {"offset_m": offset_m}
    given = _given(data, plant, mounts)
    values = {name: spec.default for name, spec in PARAMS.items()} | IN_PROCESS
    desired = given.get("offset_m", values["offset_m"])
    if given.get("mode", values["mode"]) == MODE_ADAPTIVE:
        values.update(scaled_defaults(desired, given.get("plant_tau_s", values["plant_tau_s"])))
    near, far = (given.get(name, values[name]) for name in ("range_min_m", "range_max_m"))
    values["too_close_m"], values["too_close_exit_m"] = default_too_close(near, far, desired)
    values.update(given)
    check_fit(values)
    return FollowerSetup(values, [m["pose"] for m in mounts], use_memory)


def _given(
    data: Mapping[str, Any], plant: Mapping[str, Any], mounts: list[dict[str, Any]]
) -> dict[str, float]:
    """The parameters that are given, in whichever way: full name → value; none in two ways."""
    names, values = names_given(data, others=TABLES), {}
    for full, name in names.items():
        values[full] = check_param(name, data[name])
    for key, value in plant.items():
        add_given(names, _PLANT[key], f"plant.{key}")
        values[_PLANT[key]] = check_param(_PLANT[key], value)
    for key, full in _WINDOW.items():
        found = {n: check_param(full, m[key]) for n, m in enumerate(mounts) if key in m}
        if not found:
            continue
        (first, number), *others = found.items()
        for n, other in others:
            if other != number:
                raise ConfigError(
                    f"sensors[{first}].{key} is {number:g} m and sensors[{n}].{key} {other:g} m; "
                    "all sensors have one window: give each of them the part that is common to all"
                )
        add_given(names, full, f"sensors[{first}].{key}")
        values[full] = number
    return values


def _read(config: Config) -> dict[str, Any]:
    """The configuration as a dictionary; of a service's file its [follow]."""
    if config is None:
        return {}
    if isinstance(config, (str, Path)):
        data = read_toml(config, "configuration", ConfigError)
    elif isinstance(config, Mapping):
        data = dict(config)
    else:
        raise ConfigError(f"config is {config!r}; it must be a dictionary, a TOML file's path or None")
    if not all(isinstance(key, str) for key in data):
        raise ConfigError("keys of the configuration must be text")
    if not isinstance(data.get("follow"), Mapping):
        return data
    beside = sorted(str(k) for k in data if k != "follow")
    if beside and not isinstance(config, (str, Path)):
        raise ConfigError(f"give {', '.join(beside)} inside 'follow', or no 'follow' at all")
    return dict(data["follow"])


def _numbers(value: object, count: int, unit: str, key: str) -> list[float]:
    if not isinstance(value, (list, tuple, np.ndarray)) or len(value) != count:
        raise ConfigError(f"{key} is {value!r}; it must be {count} numbers")
    try:
        return [parse_quantity(float(v) if isinstance(v, np.number) else v, unit) for v in value]
    except ValueError as e:
        raise ConfigError(f"{key}: {e}") from None


def _mounts(sensors: object) -> list[dict[str, Any]]:
    """Check the `sensors` list: mount and window of every channel."""
    if not isinstance(sensors, (list, tuple)) or not 1 <= len(sensors) <= CHANNELS:
        raise ConfigError(f"sensors must be a list of 1 to {CHANNELS} tables, not {sensors!r}")
    mounts: list[dict[str, Any]] = []
    for n, s in enumerate(sensors):
        where = f"sensors[{n}]"
        known = {"position_m", "orientation", "near_m", "far_m"}
        if not isinstance(s, Mapping) or not set(s) <= known:
            raise ConfigError(f"{where} is {s!r}; its keys are {', '.join(sorted(known))}")
        q = np.array(_numbers(s.get("orientation", (0.0, 0.0, 0.0, 1.0)), 4, "1", f"{where}.orientation"))
        if abs(float(np.linalg.norm(q)) - 1.0) > NORM_TOLERANCE:
            raise ConfigError(
                f"{where}.orientation is {q.tolist()}; it must be a unit quaternion qx qy qz qw"
            )
        position = _numbers(s.get("position_m", (0.0, 0.0, 0.0)), 3, "m", f"{where}.position_m")
        if not all(abs(v) <= MAX_MOUNT_M for v in position):
            raise ConfigError(f"{where}.position_m is {position}; it must be within {MAX_MOUNT_M:g} m")
        mounts.append({"pose": [*position, *(q / np.linalg.norm(q)).tolist()], **s})
    return mounts
