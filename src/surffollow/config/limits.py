"""Limits of a configuration on clients: values [limits] and permissions [access]."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from surffollow.config.params import PARAMS, check_param, names_given
from surffollow.config.trusted_users import user_id
from surffollow.errors import ConfigError

# users who may call SFReset and set parameters (access.parameters), and change the map (access.map)
CHANGED_BY = ("any", "holder", "holder-only")
ANY_USER, NO_OTHER_USER = -1, -2


def range_user(text: str) -> int:
    """User that may push ranges beside root and the service's own: a number, or one of the two above.

    Parameters
    ----------
    text : `access.ranges`: "" for no other user, "any", or a user's number or name

    Raises
    ------
    ConfigError  there is no such user
    """
    if text in ("", "any"):
        return ANY_USER if text else NO_OTHER_USER
    try:
        return user_id(text, "give a user by number or name, 'any', or '' for no other user")
    except ConfigError as e:
        raise ConfigError(f"configuration key access.ranges: {e}") from None


def client_limits(limits: Mapping[str, Mapping[str, Any]]) -> dict[str, tuple[float, float]]:
    """Least and most that clients may set: full name → bounds in the parameter's unit.

    Parameters
    ----------
    limits : name → {"min": value, "max": value}, either may be missing; values as in [follow]

    Raises
    ------
    ConfigError  unknown parameter or key, a value that the parameter cannot have, min above max, given twice
    """
    out: dict[str, tuple[float, float]] = {}
    for full, name in names_given(limits, " under [limits]").items():
        ends = limits[name]
        if not isinstance(ends, Mapping) or not ends or not set(ends) <= {"min", "max"}:
            raise ConfigError(
                f"configuration key limits.{name} is {ends!r}; write for example "
                f'{name} = {{ max = "20 mm" }}, with min, max or both'
            )
        spec = PARAMS[full]
        low, high = (
            check_param(name, ends[end]) if end in ends else bound
            for end, bound in (("min", spec.low), ("max", spec.high))
        )
        if low > high:
            raise ConfigError(f"configuration key limits.{name}: min {low:g} is above max {high:g}")
        out[full] = (low, high)
    return out


def check_within_limits(params: Mapping[str, float], limits: Mapping[str, tuple[float, float]]) -> None:
    """See that the parameters at the start keep the limits that clients must keep.

    Parameters
    ----------
    params : full name → value; the others are not looked at
    limits : of `client_limits`

    Raises
    ------
    ConfigError  one does not; the text says which and what to set
    """
    for name, (low, high) in limits.items():
        if name in params and not low <= params[name] <= high:
            raise ConfigError(
                f"parameter {name} is {params[name]:g}, and [limits] allows {low:g} to {high:g}; "
                f"set it under [follow], or widen limits.{name}"
            )
