"""The arbiter's configuration file (TOML): clients with their priorities, resources, combinations."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec

from surffollow.arbiter.layout import RESOURCES, VALUES
from surffollow.config.input_file import contents_are_read
from surffollow.config.key_errors import key_error_text
from surffollow.config.names import check_name, check_service_name
from surffollow.config.service import mode, seconds
from surffollow.config.toml_file import read_toml
from surffollow.errors import ConfigError, InvalidNameError

TEXT = 255  # bytes of all names, or all units, of a command
CLIENT_NAME = 47  # letters; the message in which a client names itself holds a 0 behind them
MAX_PRIORITY = 1_000_000
# commands that are converted from one reported pose to another, and their units
DISPLACEMENT = ("x", "y", "z", "rx", "ry", "rz")
DISPLACEMENT_UNITS = ("m", "m", "m", "rad", "rad", "rad")


class ResourceSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Declaration of one resource; as many numbers in `safe`, `low`, `high` as names in `command`."""

    command: tuple[str, ...]
    safe: tuple[float, ...]
    units: tuple[str, ...] = ()
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    status: str = ""
    policy: str = "fence"
    equal: str = "incumbent"
    ttl: str | float = "250 ms"
    safe_period: str | float = "50 ms"
    grace: str | float = "50 ms"


class CombinationSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A command that is the sum of the parts' commands; the first part that is held gives the pose."""

    parts: tuple[str, ...]
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    required: tuple[str, ...] = ()


class ArbiterConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Configuration of `surffollow arbiter start`."""

    clients: dict[str, int]
    resources: dict[str, ResourceSpec]
    combine: dict[str, CombinationSpec] = {}
    name: str = "cell"
    period: str | float = "1 ms"
    lease: str | float = "300 ms"
    history: int = 4096
    mode: str = "0640"
    group: str = ""
    users: tuple[str, ...] = ()

    @property
    def lease_ns(self) -> int:
        """Lease of a client without a heartbeat [ns]."""
        return round(seconds(self.lease, "lease", 0.02, 60.0) * 1e9)

    @property
    def period_ns(self) -> int:
        """Time between looks at the mailboxes while a resource is held [ns]."""
        return round(seconds(self.period, "period", 1e-4, 0.1) * 1e9)


def limits(spec: ResourceSpec | CombinationSpec) -> tuple[list[float], list[float]]:
    """Lower and upper limit of each of the VALUES values; infinite where none is declared."""
    low = [*spec.low, *(-math.inf,) * VALUES][:VALUES]
    high = [*spec.high, *(math.inf,) * VALUES][:VALUES]
    return low, high


def is_displacement(spec: ResourceSpec) -> bool:
    """Whether a command is a translation [m], or one and a rotation vector [rad], by its names and units."""
    n = len(spec.command)
    named = n in (3, 6) and spec.command == DISPLACEMENT[:n]
    return named and spec.units in ((), ("",) * n, DISPLACEMENT_UNITS[:n])


def reach(config: ArbiterConfig, spec: CombinationSpec) -> tuple[float, float]:
    """How far apart two poses of one sum may be: translation [m] and turn [rad].

    It is the widest range of a value of any part, or that of the sum where it is narrower.
    """
    widest = [0.0, 0.0]
    for part in spec.parts:
        resource = config.resources[part]
        for k in range(len(resource.command)):
            ranges = [high[k] - low[k] for low, high in (limits(resource), limits(spec))]
            widest[k > 2] = max(widest[k > 2], min(ranges))
    return widest[0], widest[1]


def parse_config(data: dict[str, Any], source: str = "configuration") -> ArbiterConfig:
    """Check a configuration given as nested dictionaries.

    Raises
    ------
    ConfigError
        unknown key, wrong type, a number out of bounds; the text names the key
    """
    try:
        config = msgspec.convert(data, ArbiterConfig)
        _check(config)
    except (msgspec.ValidationError, ConfigError, InvalidNameError) as e:
        text = key_error_text(e, ArbiterConfig, data) if isinstance(e, msgspec.ValidationError) else e
        raise ConfigError(
            f"{source}: {text}; see docs/reference/arbiter.md of the source distribution"
        ) from None
    return config


def _check(c: ArbiterConfig) -> None:
    check_name(f"{c.name}.arbiter")
    if c.lease_ns < 2 * c.period_ns:
        raise ConfigError(
            f"lease is {c.lease!r}, less than two periods ({c.period!r}); "
            "it would expire before the server checks it"
        )
    mode(c.mode, "mode")
    if c.history < 64 or c.history & (c.history - 1) or c.history > 1 << 20:
        raise ConfigError(f"history is {c.history}; it must be a power of two from 64 to 1048576 records")
    if not 1 <= len(c.resources) <= RESOURCES:
        raise ConfigError(f"{len(c.resources)} resources are declared; it must be 1 to {RESOURCES}")
    if len(c.clients) > 1024 or not c.clients:
        raise ConfigError("declare 1 to 1024 clients under [clients], each with its priority")
    for name, priority in c.clients.items():
        check_name(name)
        if len(name) > CLIENT_NAME:
            raise ConfigError(f"client {name!r} has {len(name)} letters; the most is {CLIENT_NAME}")
        if abs(priority) > MAX_PRIORITY:
            raise ConfigError(f"clients.{name} has priority {priority}; the most is {MAX_PRIORITY}")
    for name, spec in c.resources.items():
        _check_resource(c, name, spec)
    parts: set[str] = set()
    for name, combination in c.combine.items():
        _check_combination(c, name, combination)
        if parts & set(combination.parts):
            raise ConfigError(f"combine.{name}: a resource can be part of one combination only")
        parts |= set(combination.parts)


def _check_resource(c: ArbiterConfig, name: str, spec: ResourceSpec) -> None:
    key = f"resources.{name}"
    check_service_name(f"{c.name}.{name}")
    n = len(spec.command)
    if name == "arbiter":
        raise ConfigError(f"{key}: the name is taken by the board; choose another")
    if not 1 <= n <= VALUES:
        raise ConfigError(f"{key}.command names {n} values; it must be 1 to {VALUES}")
    for value in spec.command:
        check_name(value)
    if len(set(spec.command)) < n:
        raise ConfigError(f"{key}.command names a value twice: {spec.command!r}")
    if spec.status:
        check_name(spec.status)
    for what, texts in (("command", spec.command), ("units", spec.units)):
        if len(",".join(texts).encode()) > TEXT or any("," in t or not t.isprintable() for t in texts):
            raise ConfigError(
                f"{key}.{what} holds a comma, a control character or more than {TEXT} bytes in all: {texts!r}"
            )
    if not all(math.isfinite(value) for value in spec.safe):
        raise ConfigError(f"{key}.safe is {spec.safe!r}; every value must be finite")
    for what, values in (("safe", spec.safe), ("low", spec.low), ("high", spec.high), ("units", spec.units)):
        if len(values) != n and (what == "safe" or values):
            raise ConfigError(f"{key}.{what} holds {len(values)} values; {n} are needed, as in command")
    low, high = limits(spec)
    for k, safe in enumerate(spec.safe):
        if not low[k] <= safe <= high[k]:
            raise ConfigError(f"{key}.safe[{k}] is {safe:g}, outside its limits {low[k]:g} to {high[k]:g}")
    if spec.policy not in ("fence", "cooperative"):
        raise ConfigError(f"{key}.policy is {spec.policy!r}; use 'fence' or 'cooperative'")
    if spec.equal not in ("incumbent", "newcomer"):
        raise ConfigError(f"{key}.equal is {spec.equal!r}; use 'incumbent' or 'newcomer'")
    for what in ("ttl", "safe_period", "grace"):
        seconds(getattr(spec, what), f"{key}.{what}", 0.001, 60.0)
    if seconds(spec.ttl, f"{key}.ttl", 0.001, 60.0) < 2e-9 * c.period_ns:
        raise ConfigError(f"{key}.ttl is {spec.ttl!r}, less than two periods ({c.period!r}): late when seen")


def _check_combination(c: ArbiterConfig, name: str, spec: CombinationSpec) -> None:
    key = f"combine.{name}"
    check_service_name(f"{c.name}.{name}")
    if name in c.resources or name == "arbiter":
        raise ConfigError(f"{key}: the name is taken; choose another")
    for part in (*spec.parts, *spec.required):
        if part not in c.resources or part not in spec.parts:
            raise ConfigError(f"{key} names {part!r}, which is no resource, or not one of its parts")
    if len(set(spec.parts)) != len(spec.parts):
        raise ConfigError(f"{key}.parts names a resource twice: {spec.parts!r}; a part counts once")
    sizes = {len(c.resources[p].command) for p in spec.parts}
    if len(sizes) != 1:
        raise ConfigError(f"{key}.parts must have commands of one length, not {sorted(sizes)}")
    (n,) = sizes
    for what, values in (("low", spec.low), ("high", spec.high)):
        if len(values) not in (0, n):
            raise ConfigError(f"{key}.{what} holds {len(values)} values; {n} are needed, as in its parts")
    for what in ("command", "units"):
        texts = {getattr(c.resources[p], what) for p in spec.parts}
        if len(texts) > 1:
            raise ConfigError(f"{key}.parts must have the same {what} to be summed, not {sorted(texts)}")
    for k, (low, high) in enumerate(zip(*limits(spec))):
        if not low <= 0.0 <= high:
            raise ConfigError(
                f"{key}: limits {low:g} to {high:g} of value {k} exclude zero, the sum of no part"
            )


@contents_are_read()
def load_config(path: str | Path) -> ArbiterConfig:
    """Read an arbiter's configuration file; raises `ConfigError` as `config.service.load_config`."""
    return parse_config(read_toml(path, "configuration", ConfigError), str(path))
