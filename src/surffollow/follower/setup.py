"""Configuration of a follower in process: a dictionary or a TOML file, read and checked."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from surffollow.config.params import PARAMS, check_param, param_name
from surffollow.config.toml_file import read_toml
from surffollow.errors import ConfigError
from surffollow.forecast.pose import QUATERNION_TOLERANCE
from surffollow.forecast.reference_scales import scaled_defaults
from surffollow.shm.layout_follow import CHANNELS, MODE_ADAPTIVE
from surffollow.units import parse_quantity

Config = Mapping[str, Any] | str | Path | None

TOO_CLOSE_BEYOND_M = 0.15 * 0.0254  # beyond the near limit of a sensor given by its window
TOO_CLOSE_EXIT_M = 0.3 * 0.0254  # but no more than the shares of the way to the stand-off
MAX_MOUNT_M = 1e3
# what differs from the service's defaults: readings come ready-made with timestamps of their own
IN_PROCESS: dict[str, float] = {"mode": MODE_ADAPTIVE, "sensor_latency_ns": 0, "sensor_readings": 1}
# thresholds of too_close: of the way from the near limit to the stand-off
TOO_CLOSE_SHARE, TOO_CLOSE_EXIT_SHARE = 0.075, 0.15
_MODES = {"default": "adaptive", "ours": "adaptive"}
_PLANT = {"tau_s": "plant_tau_s", "v_max_mps": "plant_v_max_mps", "a_max_mps2": "plant_a_max_mps2"}


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
    ConfigError  file not readable, unknown key, wrong unit, value out of bounds
    """
    data = _read(config)
    use_memory = data.pop("memory", True)
    if not isinstance(use_memory, bool):
        raise ConfigError(f"memory is {use_memory!r}; it must be true or false")
    values = {name: spec.default for name, spec in PARAMS.items()} | IN_PROCESS
    mounts = _mounts(data.pop("sensors", [{}]))
    near = [check_param("range_min_m", m["near_m"]) for m in mounts if "near_m" in m]
    if near:
        values["range_min_m"] = min(near)
    far = [check_param("range_max_m", m["far_m"]) for m in mounts if "far_m" in m]
    if far:
        values["range_max_m"] = max(far)
    plant = data.pop("plant", {})
    if not isinstance(plant, Mapping) or not set(plant) <= set(_PLANT):
        raise ConfigError(f"plant is {plant!r}; its keys are {', '.join(_PLANT)}")
    for key, value in plant.items():
        values[_PLANT[key]] = check_param(_PLANT[key], value)
    if offset_m is not None:
        data = {k: v for k, v in data.items() if k not in ("offset", "offset_m")} | {"offset_m": offset_m}
    desired = check_param("offset_m", data.get("offset_m", data.get("offset", values["offset_m"])))
    if data.get("mode", "adaptive") in ("adaptive", *_MODES, MODE_ADAPTIVE):
        tau = next((data[k] for k in ("plant_tau_s", "plant_tau") if k in data), values["plant_tau_s"])
        values.update(scaled_defaults(desired, check_param("plant_tau_s", tau)))
    if near:
        values["too_close_m"], values["too_close_exit_m"] = default_too_close(min(near), desired)
    if isinstance(data.get("mode"), str):
        data["mode"] = _MODES.get(data["mode"], data["mode"])
    for name, value in data.items():
        values[param_name(name)] = check_param(name, value)
    check_window(values["range_min_m"], values["range_max_m"])
    return FollowerSetup(values, [m["pose"] for m in mounts], use_memory)


def check_window(low_m: float, high_m: float) -> None:
    """Raise ConfigError when no reading could ever be valid."""
    if not low_m < high_m:
        raise ConfigError(f"range_min_m is {low_m:g} m and range_max_m {high_m:g} m; the first must be less")


def check_standoff(params: Any) -> None:
    """Raise ConfigError when the stand-off could never be kept.

    Parameters
    ----------
    params : record of `Params`   `too_close_m` below 0: it follows from window and stand-off
    """
    offset, near, far = float(params["offset_m"]), float(params["range_min_m"]), float(params["range_max_m"])
    if not near < offset < far:
        raise ConfigError(
            f"offset_m is {offset:g} m, outside the sensor's window of {near:g} to {far:g} m; "
            "give the sensor's near_m and far_m, or another offset_m"
        )
    if float(params["too_close_m"]) >= offset:
        raise ConfigError(
            f"too_close_m is {float(params['too_close_m']):g} m and offset_m {offset:g} m; "
            "the first must be less, or every reading would be too close"
        )


def default_too_close(near_m: float, offset_m: float) -> tuple[float, float]:
    """`too_close_m` and `too_close_exit_m` of a window that begins at `near_m`, for a stand-off."""
    room = max(offset_m - near_m, 0.0)
    return (
        near_m + min(TOO_CLOSE_BEYOND_M, TOO_CLOSE_SHARE * room),
        near_m + min(TOO_CLOSE_EXIT_M, TOO_CLOSE_EXIT_SHARE * room),
    )


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
        if abs(float(np.linalg.norm(q)) - 1.0) > QUATERNION_TOLERANCE:
            raise ConfigError(
                f"{where}.orientation is {q.tolist()}; it must be a unit quaternion qx qy qz qw"
            )
        position = _numbers(s.get("position_m", (0.0, 0.0, 0.0)), 3, "m", f"{where}.position_m")
        if not all(abs(v) <= MAX_MOUNT_M for v in position):
            raise ConfigError(f"{where}.position_m is {position}; it must be within {MAX_MOUNT_M:g} m")
        mounts.append({"pose": [*position, *(q / np.linalg.norm(q)).tolist()], **s})
    return mounts
