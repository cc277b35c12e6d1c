"""Make a driver from its part of a configuration file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import msgspec

from surffollow.errors import ConfigError
from surffollow.hw.driver import Driver
from surffollow.hw.faults import FaultConfig, FaultyDriver
from surffollow.hw.replayed import ReplayedDriver
from surffollow.hw.rig import SimulatedConfig
from surffollow.hw.silent import SilentDriver
from surffollow.hw.simulated import SimulatedDriver
from surffollow.units import parse_quantity


class _NoSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class _Replay(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    file: str


class _Faults(msgspec.Struct, frozen=True):
    faults: tuple[FaultConfig, ...] = ()
    fault_seed: int = 0


def _simulated(settings: dict[str, Any], name: str) -> Driver:
    return SimulatedDriver(name, msgspec.convert(settings, SimulatedConfig))


def _none(settings: dict[str, Any], name: str) -> Driver:
    msgspec.convert(settings, _NoSettings)
    return SilentDriver()


def _replay(settings: dict[str, Any], name: str) -> Driver:
    return ReplayedDriver.from_file(msgspec.convert(settings, _Replay).file)


KINDS: dict[str, Callable[[dict[str, Any], str], Driver]] = {
    "simulated": _simulated,
    "none": _none,
    "replay": _replay,
}


_SUFFIX_UNITS = {"_m": "m", "_s": "s", "_hz": "Hz", "_deg": "deg"}


def _in_si(value: Any, key: str = "") -> Any:
    """Replace quantities written with units, in keys that end in one, by numbers."""
    if isinstance(value, Mapping):
        return {k: _in_si(v, str(k)) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_in_si(v, key) for v in value]
    unit = next((u for suffix, u in _SUFFIX_UNITS.items() if key.endswith(suffix)), None)
    if unit is None or not isinstance(value, str):
        return value
    try:
        return parse_quantity(value, unit)
    except ValueError as error:
        raise ConfigError(f"driver setting {key}: {error}") from error


def make_driver(config: Mapping[str, Any], name: str) -> Driver:
    """Make the driver that a configuration describes; it is not started.

    Parameters
    ----------
    config : `kind` ("simulated", "none" or "replay"; default "simulated"), the settings of that kind
        (`SimulatedConfig`; `file` of a replay), and for any kind `faults` (list of `FaultConfig`) and
        `fault_seed`; values of keys that end in _m, _s, _hz or _deg may be written with a unit ("0.1 in")
    name : of the service

    Raises
    ------
    ConfigError
        unknown kind or key, or a value out of range
    RecordingError
        the file of a replay cannot be read
    """
    settings: dict[str, Any] = _in_si(config)
    kind = settings.pop("kind", "simulated")
    if kind not in KINDS:
        raise ConfigError(f"driver kind '{kind}' is unknown; one of: {', '.join(KINDS)}")
    try:
        order = msgspec.convert(
            {k: settings.pop(k) for k in ("faults", "fault_seed") if k in settings}, _Faults
        )
        driver = KINDS[kind](settings, name)
    except msgspec.ValidationError as error:
        raise ConfigError(f"driver '{kind}': {error}") from error
    return FaultyDriver(driver, order.faults, order.fault_seed) if order.faults else driver
