"""Wired drivers for tests: made from settings, and the distances that they deliver."""

from __future__ import annotations

from typing import Any

from surffollow.hw.driver import ConversionQueue, Driver
from surffollow.hw.registry import make_driver
from surffollow.shm.conversion import FLAG_INVALID, conversion_channel, conversion_counts, conversion_flags

MS = 1_000_000


def made(settings: dict, name: str = "x") -> Any:
    """A driver with all that its kind has beyond the protocol."""
    return make_driver(settings, name)


def ranges(driver: Driver, queue: ConversionQueue) -> list[tuple[int, int, float | None]]:
    """(time, channel, distance or None) of what was delivered since the last look."""
    out = []
    for t_ns, word in queue.drain().tolist():
        c = conversion_channel(word)
        bad = conversion_flags(word) & FLAG_INVALID
        range_m = driver.info.zero_m[c] + driver.info.scale_m[c] * conversion_counts(word)
        out.append((t_ns, c, None if bad else range_m))
    return out
