"""Causes of the latched stop by name: what [stop] `on` of a configuration may list, and its bits."""

from __future__ import annotations

from collections.abc import Sequence

from surffollow.errors import ConfigError

# bit k of a word of causes is STOP_NAMES[k]
STOP_NAMES = (
    "request",
    "pose_stale",
    "sensor_lost",
    "stuck",
    "too_close",
    "pose_lost",
    "driver",
    "start",
    "restart",
    "descent",
)
ALWAYS = ("request", "restart")  # need not be named


def stop_causes(names: Sequence[str]) -> int:
    """The causes that a configuration names, as bits.

    Raises
    ------
    ConfigError  an unknown cause
    """
    choices = [name for name in STOP_NAMES if name not in ALWAYS]
    for name in names:
        if name not in choices:
            raise ConfigError(f"configuration key stop.on names {name!r}; it may name {', '.join(choices)}")
    return sum({1 << STOP_NAMES.index(name) for name in names})


def stop_names(causes: int) -> tuple[str, ...]:
    """The names of causes given as bits."""
    return tuple(name for k, name in enumerate(STOP_NAMES) if causes >> k & 1)
