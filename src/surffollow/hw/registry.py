"""Make a driver from its part of a configuration file: a built-in one, or another package's."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from typing import Any

import msgspec

from surffollow.config.key_errors import convert_table, key_error_text
from surffollow.errors import ConfigError, SurffollowError
from surffollow.hw.calibrated import calibrated
from surffollow.hw.calibration import load_calibration
from surffollow.hw.driver import Driver
from surffollow.hw.fault_injection import FaultyDriver
from surffollow.hw.fault_schedule import FaultConfig
from surffollow.hw.replayed import ReplayConfig, ReplayedDriver
from surffollow.hw.silent import SilentDriver
from surffollow.hw.simulation.led_config import LedConfig
from surffollow.hw.simulation.sensor_rig import SimulatedConfig
from surffollow.hw.simulation.simulated import SimulatedDriver
from surffollow.units import parse_quantity


class _NoSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class _Faults(msgspec.Struct, frozen=True):
    faults: tuple[FaultConfig, ...] = ()
    fault_seed: int = 0
    calibration: str = ""


def _simulated(settings: dict[str, Any], name: str) -> Driver:
    return SimulatedDriver(name, convert_table(settings, SimulatedConfig))


def _none(settings: dict[str, Any], name: str) -> Driver:
    convert_table(settings, _NoSettings)
    return SilentDriver()


def _replay(settings: dict[str, Any], name: str) -> Driver:
    config = convert_table(settings, ReplayConfig)
    return ReplayedDriver.from_file(config.file, config)


Factory = Callable[[dict[str, Any], str], Driver]
ENTRY_POINTS = "surffollow.drivers"


def _lazily(module: str) -> Factory:
    """A built-in kind whose module, and the extra that it needs, are loaded when it is asked for."""

    def make(settings: dict[str, Any], name: str) -> Driver:
        driver: Driver = importlib.import_module(f"surffollow.hw.{module}").make(settings, name)
        return driver

    return make


KINDS: dict[str, Factory] = {
    "simulated": _simulated,
    "none": _none,
    "replay": _replay,
    "serial": _lazily("wire.serial_port"),
    "iio": _lazily("wire.iio"),
    "can": _lazily("wire.can_bus"),
    "udp": _lazily("wire.udp"),
    "unix": _lazily("wire.unix_socket"),
    "external": _lazily("external"),
}


_SUFFIX_UNITS = {
    "_m": "m",
    "_s": "s",
    "_hz": "Hz",
    "_deg": "deg",
    "_share": "1",
    "_rate": "1",
    "_counts": "1",
}
# names that may lack their ending, as in `window = ["1 in", "5 in"]`
_ENDINGS = {field.rpartition("_")[0]: field for field in LedConfig.__struct_fields__ if "_" in field}


def _in_si(value: Any, key: str = "") -> Any:
    """Replace quantities written with units, in keys that end in one, by numbers."""
    if isinstance(value, Mapping):
        if key == "led":
            twice = [f"{k} and {full}" for k, full in _ENDINGS.items() if k in value and full in value]
            if twice:
                raise ConfigError(f"driver.led has {', '.join(twice)}; give one of them")
            value = {_ENDINGS.get(str(k), k): v for k, v in value.items()}
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


def _in_other_package(kind: str) -> Factory:
    """The factory that "package.module:factory" names.

    Raises
    ------
    ConfigError
        no such module or no such factory
    """
    module, _, attribute = kind.partition(":")
    try:
        found: Any = importlib.import_module(module)
        for part in attribute.split("."):
            found = getattr(found, part)
    except Exception as error:  # also any exception while the module is imported
        raise ConfigError(
            f"driver kind '{kind}' cannot be loaded: {error}; install its package into the service's "
            'environment and write kind = "package.module:factory"'
        ) from error
    return _checked(found, kind)


def _installed(kind: str) -> Factory | None:
    """The factory that an installed package offers under that name in the group surffollow.drivers."""
    found = [p for p in entry_points(group=ENTRY_POINTS) if p.name == kind]
    if not found:
        return None
    if len({p.value for p in found}) > 1:
        raise ConfigError(
            f"driver kind '{kind}' is offered by several packages ({', '.join(p.value for p in found)}); "
            "write the one that is meant as kind"
        )
    try:
        return _checked(found[0].load(), kind)
    except ConfigError:
        raise
    except Exception as error:  # also any exception while the module is imported
        raise ConfigError(
            f"driver kind '{kind}' ({found[0].value}) cannot be loaded: {error}; mend or "
            "reinstall its package"
        ) from error


def _checked(factory: Any, kind: str) -> Factory:
    if not callable(factory):
        raise ConfigError(
            f"driver kind '{kind}' is {factory!r}; it must be callable: factory(settings, name)"
        )

    def make(settings: dict[str, Any], name: str) -> Driver:
        try:
            driver = factory(settings, name)
        except (msgspec.ValidationError, SurffollowError, KeyboardInterrupt):
            raise  # `make_driver` adds the kind, or the text is complete already
        except BaseException as error:  # another package's: any exception ends the start in one line
            raise ConfigError(
                f"driver kind '{kind}' could not be made: {type(error).__name__}: {error}; mend its factory "
                "or its settings"
            ) from error
        if not isinstance(driver, Driver):
            raise ConfigError(
                f"driver kind '{kind}' made a {type(driver).__name__}, which lacks one of info, start, stop, "
                "faults; see surffollow.hw.Driver"
            )
        return driver

    return make


def factory_of(kind: str) -> Factory:
    """Factory of drivers of a kind: built in, installed by another package, or named by its module.

    Raises
    ------
    ConfigError
        there is none
    """
    if kind in KINDS:
        return KINDS[kind]
    if ":" in kind:
        return _in_other_package(kind)
    factory = _installed(kind)
    if factory is None:
        others = sorted({p.name for p in entry_points(group=ENTRY_POINTS)} - set(KINDS))
        raise ConfigError(
            f"driver kind '{kind}' is unknown; one of: {', '.join((*KINDS, *others))}; or "
            '"package.module:factory"'
        )
    return factory


def make_driver(config: Mapping[str, Any], name: str) -> Driver:
    """Make the driver that a configuration describes; it is not started.

    Parameters
    ----------
    config : `kind` (default "simulated"; see `factory_of`), the settings of that kind (`SimulatedConfig`;
        `file` of a replay), and for any kind `faults` (list of `FaultConfig`), `fault_seed` and `calibration`
        (a file of `surffollow calibrate`); values of keys that end in _m, _s, _hz, _deg, _share or _rate may
        be written with a unit ("0.1 in")
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
    factory = factory_of(str(kind))
    try:
        order = msgspec.convert(
            {k: settings.pop(k) for k in ("faults", "fault_seed", "calibration") if k in settings}, _Faults
        )
        driver = factory(settings, name)
    except msgspec.ValidationError as error:
        raise ConfigError(f"driver '{kind}': {key_error_text(error)}") from error
    if order.faults:
        driver = FaultyDriver(driver, order.faults, order.fault_seed)
    if not order.calibration:
        return driver
    found = load_calibration(order.calibration)
    if not found.tables and not found.mounts and found.latency_s is None:
        raise ConfigError(
            f"calibration {order.calibration} has no table, no latency and no mounts; write one with "
            "`surffollow calibrate`, or take `calibration` out of [driver]"
        )
    return calibrated(driver, found)
