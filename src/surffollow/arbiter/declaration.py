"""Declare resources as Python classes: the same table as in TOML, checked by the same code.

class Robot(Declaration):
    speed = Value("m/s", low=-0.5, high=0.5)
    turn_rate = Value("rad/s", low=-1.0, high=1.0)
    status = "cell.base"

serve(declare("cell", {"avoid": 40, "go": 10}, [Robot]))
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, NamedTuple

from surffollow.arbiter.config import ArbiterConfig, ResourceSpec, parse_config
from surffollow.errors import ConfigError


class Value(NamedTuple):
    """One value of a resource's command.

    Attributes
    ----------
    unit : str
    safe : float
        its part of the safe command
    low, high : float
        limits; a command beyond them is brought within

    Examples
    --------
    >>> from surffollow.arbiter.declaration import Value
    >>> Value("m/s", low=-0.5, high=0.5)
    Value(unit='m/s', safe=0.0, low=-0.5, high=0.5)
    """

    unit: str = ""
    safe: float = 0.0
    low: float = -math.inf
    high: float = math.inf


class Declaration:
    """Base of declared resources; what is a `Value` is a value of the command, in the order declared.

    Attributes
    ----------
    resource : str
        its name; absent: the class's, `PanCamera` → `pan-camera`
    status : str
        block that its controller publishes
    policy, equal, ttl, safe_period, grace : as in TOML (docs/reference/arbiter.md)

    Examples
    --------
    >>> from surffollow.arbiter.declaration import Declaration, Value
    >>> class PanCamera(Declaration):
    ...     pan = Value("rad", low=-1.5, high=1.5)
    ...     policy = "cooperative"
    >>> PanCamera.resource, PanCamera.table()["command"], PanCamera.table()["units"]
    ('pan-camera', ('pan',), ('rad',))
    """

    resource: ClassVar[str] = ""
    status: ClassVar[str] = ""
    policy: ClassVar[str] = "fence"
    equal: ClassVar[str] = "incumbent"
    ttl: ClassVar[str | float] = "250 ms"
    safe_period: ClassVar[str | float] = "50 ms"
    grace: ClassVar[str | float] = "50 ms"
    VALUES: ClassVar[dict[str, Value]] = {}

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        own = {n: v for n, v in vars(cls).items() if isinstance(v, Value)}
        unknown = [n for n in vars(cls) if not (n in own or n.startswith("_") or hasattr(Declaration, n))]
        if unknown:
            raise ConfigError(
                f"resource class {cls.__name__} has {unknown[0]!r}; it must be a Value, or one of "
                f"{', '.join(_OPTIONS)}"
            )
        # those of the bases come first
        cls.VALUES = {**cls.VALUES, **own}
        if "resource" not in vars(cls):
            cls.resource = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", cls.__name__).lower()

    @classmethod
    def table(cls) -> dict[str, Any]:
        """The same as TOML."""
        values = list(cls.VALUES.values())
        columns = {c: tuple(getattr(v, c) for v in values) for c in ("safe", "low", "high")}
        units = tuple(v.unit for v in values)
        options = {n: getattr(cls, n) for n in _OPTIONS if n != "resource"}
        return {"command": tuple(cls.VALUES), **columns, "units": units if any(units) else (), **options}


_OPTIONS = ("resource", *(f for f in ResourceSpec.__struct_fields__ if f in vars(Declaration)))


def declare(
    name: str,
    clients: Mapping[str, int],
    resources: Iterable[type[Declaration]],
    *,
    combine: Mapping[str, Mapping[str, Any]] | None = None,
    **options: Any,
) -> ArbiterConfig:
    """Put an arbiter's configuration together.

    Parameters
    ----------
    name : str
        of the arbiter
    clients : mapping
        who may attach → priority
    resources : classes derived from `Declaration`
    combine : mapping
        combinations as in TOML: name → parts, required, low, high
    options
        period, lease, history, mode, group, users, as in TOML

    Returns
    -------
    ArbiterConfig
        for `server.serve`

    Raises
    ------
    ConfigError
        as of a file that says the same

    Examples
    --------
    >>> from surffollow.arbiter.declaration import Declaration, Value, declare
    >>> class Robot(Declaration):
    ...     speed = Value("m/s", low=-0.5, high=0.5)
    >>> config = declare("cell", {"avoid": 40, "go": 10}, [Robot])
    >>> config.name, sorted(config.resources)
    ('cell', ['robot'])
    """
    tables: dict[str, Any] = {}
    for one in resources:
        if one.resource in tables:
            raise ConfigError(f"two resources are called {one.resource!r}; give one of them `resource = ...`")
        tables[one.resource] = one.table()
    data = {"name": name, "clients": dict(clients), "resources": tables, **options}
    return parse_config(data | {"combine": dict(combine or {})}, f"declaration of arbiter {name!r}")
