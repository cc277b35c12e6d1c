"""The service's configuration file (TOML) as frozen, validated structures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from surffollow.config.driver_files import with_absolute_files
from surffollow.config.input_file import contents_are_read
from surffollow.config.key_errors import key_error_text
from surffollow.config.limits import CHANGED_BY, check_within_limits, client_limits, range_user
from surffollow.config.names import check_service_name
from surffollow.config.params import PARAMS, check_param, names_given
from surffollow.config.stop_causes import stop_causes
from surffollow.config.toml_file import naming_source, read_toml
from surffollow.errors import ConfigError, UsageError
from surffollow.units import parse_quantity

_PAPER_MODE = PARAMS["mode"].choices.index("paper")


class Realtime(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Scheduling; what is not permitted is reported and gone without, unless `strict` is set."""

    priority: int = 80
    cpu: int = -1
    lock_memory: bool = True
    dma_latency: bool = True
    spin: str | float = "120 us"
    strict: bool = False
    overrun: str = "skip"


class MapConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The map's memory and accuracy."""

    grids: int = 1_000_000
    finest_grid: str | float = "0.1 in"
    quantum: str | float = "standoff"
    rounding: str = "mode"
    gate: str | float = 0.0
    queue_seconds: float = 60.0
    access_lease: str | float = "30 s"


MAX_SLOTS = 16  # that a service has (shm.layout_board.CLIENTS)


class AccessConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Modes and group of what is shared, slots that one user or process may have, who may do what."""

    board_mode: str = "0640"
    socket_mode: str = "0660"
    map_mode: str = "0640"
    group: str = ""
    slots_per_user: int = 8
    slots_per_process: int = 4
    parameters: str = "holder"
    map: str = "holder"
    ranges: str = ""


class StopConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Causes that latch the stop, beside a client's request."""

    on: list[str] = []


class ServiceConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Configuration of `surffollow start`."""

    name: str = "surf"
    period: str | float = "1 ms"
    log_words: int = 1 << 20
    snapshot: str | float = "1 s"
    watchdog: str | float = "1 s"
    realtime: Realtime = Realtime()
    map: MapConfig = MapConfig()
    access: AccessConfig = AccessConfig()
    limits: dict[str, Any] = {}
    stop: StopConfig = StopConfig()
    driver: dict[str, Any] = {}
    follow: dict[str, Any] = {}


def seconds(value: str | float, key: str, low: float, high: float) -> float:
    """A duration of the configuration [s].

    Parameters
    ----------
    value : str or float   text with a unit, or a number [s]
    key : str              named in the error
    low, high : float [s]  bounds

    Raises
    ------
    ConfigError
        no duration, or out of bounds
    """
    return _quantity(value, "s", key, low, high)


def metres(value: str | float, key: str, low: float, high: float) -> float:
    """A length of the configuration [m].

    Parameters
    ----------
    value : str or float   text with a unit, or a number [m]
    key : str              named in the error
    low, high : float [m]  bounds

    Raises
    ------
    ConfigError
        no length, or out of bounds
    """
    return _quantity(value, "m", key, low, high)


def _quantity(value: str | float, unit: str, key: str, low: float, high: float) -> float:
    try:
        number = parse_quantity(value, unit)
    except ValueError as e:
        raise ConfigError(f"configuration key {key}: {e}") from None
    if not low <= number <= high:
        raise ConfigError(
            f"configuration key {key} is {number:g} {unit}; it must be between {low:g} and {high:g} {unit}"
        )
    return number


def parse_config(data: dict[str, Any], source: str = "configuration") -> ServiceConfig:
    """Check a configuration given as nested dictionaries.

    Raises
    ------
    ConfigError
        unknown key, wrong type, unknown unit, value out of bounds; the text names the key
    InvalidNameError
        `name` cannot name a service
    """
    try:
        config = msgspec.convert(data, ServiceConfig)
    except msgspec.ValidationError as e:
        raise ConfigError(
            f"{source}: {key_error_text(e, ServiceConfig)}; see docs/reference/configuration.md of the "
            "source distribution"
        ) from None
    with naming_source(source, UsageError):
        _check(config)
    return config


WATCHDOG_PERIODS = 5  # fewer, and a cycle that is only late counts as stalled


def _check(c: ServiceConfig) -> None:
    seconds(c.snapshot, "snapshot", 0.01, 3600.0)
    watchdog_s, period_s = (
        seconds(c.watchdog, "watchdog", 0.01, 60.0),
        seconds(c.period, "period", 20e-6, 1.0),
    )
    if watchdog_s < WATCHDOG_PERIODS * period_s:
        raise ConfigError(
            f"configuration key watchdog is {watchdog_s:g} s, less than {WATCHDOG_PERIODS} periods of "
            f"{period_s:g} s: a cycle in good order would count as stalled; set watchdog to "
            "more, or period to less"
        )
    seconds(c.realtime.spin, "realtime.spin", 0.0, 0.01)
    if c.realtime.overrun not in ("skip", "catch-up"):
        raise ConfigError(
            f"configuration key realtime.overrun is {c.realtime.overrun!r}; use 'skip' or 'catch-up'"
        )
    if not 1 <= c.realtime.priority <= 98:
        raise ConfigError(
            f"configuration key realtime.priority is {c.realtime.priority}; it must be between 1 and 98"
        )
    if c.log_words < 1 << 16 or c.log_words & (c.log_words - 1) or c.log_words > 1 << 30:
        raise ConfigError("configuration key log_words must be a power of two between 65536 and 2^30 words")
    if not 1 <= c.map.grids <= 1_000_000_000:
        raise ConfigError("configuration key map.grids must be between 1 and 1000000000 grids")
    if c.map.rounding not in ("mode", "unbiased", "paper"):
        raise ConfigError(
            f"configuration key map.rounding is {c.map.rounding!r}; use 'mode', 'unbiased' or 'paper'"
        )
    metres(c.map.finest_grid, "map.finest_grid", 1e-6, 1e4)
    map_quantum_m(c)
    metres(c.map.gate, "map.gate", 0.0, 1e4)
    seconds(c.map.access_lease, "map.access_lease", 0.01, 3600.0)
    if not 1.0 <= c.map.queue_seconds <= 600.0:
        raise ConfigError("configuration key map.queue_seconds must be between 1 and 600 s")
    for key in ("board_mode", "socket_mode", "map_mode"):
        mode(getattr(c.access, key), f"access.{key}")
    for key in ("slots_per_user", "slots_per_process"):
        if not 1 <= getattr(c.access, key) <= MAX_SLOTS:
            raise ConfigError(f"configuration key access.{key} must be a whole number from 1 to {MAX_SLOTS}")
    follow_params(c)
    for key in ("parameters", "map"):
        if getattr(c.access, key) not in CHANGED_BY:
            raise ConfigError(
                f"configuration key access.{key} is {getattr(c.access, key)!r}; use one of "
                f"{', '.join(repr(n) for n in CHANGED_BY)}"
            )
    range_user(c.access.ranges)
    check_within_limits(follow_params(c), client_limits(c.limits))
    stop_causes(c.stop.on)
    check_service_name(c.name)


def mode(text: str, key: str) -> int:
    """An access mode written in octal; only the owner may write board and map.

    Raises
    ------
    ConfigError
        no octal mode, executable, or write bits of group or others on board or map
    """
    try:
        value = int(text, 8)
    except ValueError:
        value = -1
    if not 0 <= value <= 0o777:
        raise ConfigError(f"configuration key {key} is {text!r}; write an octal mode like '0640'")
    writable = 0 if key == "access.socket_mode" else value & 0o022
    if writable or value & 0o111:
        raise ConfigError(
            f"configuration key {key} is {text!r}; "
            + ("group and others may read it only" if writable else "clear the execute bits")
            + ", for example '0640'"
        )
    return value


def follow_params(c: ServiceConfig) -> dict[str, float]:
    """The parameters set by the configuration: full name → value in the parameter's unit.

    Raises
    ------
    ConfigError  unknown name, value that the parameter cannot have, a parameter given twice
    """
    given = names_given(c.follow, " under [follow]")
    return {full: check_param(name, c.follow[name]) for full, name in given.items()}


def _is_paper(c: ServiceConfig) -> bool:
    """Whether the follower begins in paper mode."""
    return follow_params(c).get("mode") == _PAPER_MODE


def map_rounding(c: ServiceConfig) -> str:
    """The map's rounding: as configured, or by default that of the follower's mode at the start."""
    if c.map.rounding != "mode":
        return c.map.rounding
    return "paper" if _is_paper(c) else "unbiased"


def map_quantum_m(c: ServiceConfig) -> float:
    """Height of one count of the map [m]; 0.0: it follows from the stand-off at each MapReset.

    With the follower in paper mode it is the paper's thousandth of an inch, unless it is configured.

    Raises
    ------
    ConfigError  neither a length that a map can have nor "standoff"
    """
    if c.map.quantum == "standoff" and not _is_paper(c):
        return 0.0
    given = "0.001 in" if c.map.quantum == "standoff" else c.map.quantum
    return metres(given, "map.quantum", 1e-9, 10.0)


@contents_are_read()
def load_config(path: str | Path) -> ServiceConfig:
    """Read a configuration file; relative paths in it are relative to its folder.

    Raises
    ------
    InputFileError
        the file cannot be read
    ConfigError
        it is not TOML, or says something wrong
    """
    tables = read_toml(path, "configuration", ConfigError)
    if isinstance(tables.get("driver"), dict):
        tables["driver"] = with_absolute_files(tables["driver"], Path(path).parent)
    return parse_config(tables, str(path))
