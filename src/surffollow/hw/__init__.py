"""Range sensors: what a driver is, and what helps to write one.

`Driver`, `DriverInfo`, `ConversionQueue`: the interface to the service. `metre_info`, `pack_range`,
`RangeWriter`: distances in metres. `PolledDriver`, `Source`: a thread with health states and reconnection.
`surffollow.hw.contract` checks any driver. See docs/reference/drivers.md. Other modules here are not public.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surffollow.hw.driver import ConversionQueue, Driver, DriverInfo
    from surffollow.hw.polled import PolledDriver, Source
    from surffollow.hw.ranges import RangeWriter, metre_info, pack_range

_WHERE = {
    "ConversionQueue": "driver",
    "Driver": "driver",
    "DriverInfo": "driver",
    "PolledDriver": "polled",
    "RangeWriter": "ranges",
    "Source": "polled",
    "metre_info": "ranges",
    "pack_range": "ranges",
}
__all__ = [
    "ConversionQueue",
    "Driver",
    "DriverInfo",
    "PolledDriver",
    "RangeWriter",
    "Source",
    "metre_info",
    "pack_range",
]


def __dir__() -> list[str]:
    """Names that can be used here."""
    return sorted({*(n for n in globals() if n.startswith("__")), *__all__})


def __getattr__(name: str) -> Any:
    """Load a name on its first use: the kernels behind a queue take a moment to import."""
    if name not in _WHERE:
        raise AttributeError(f"module 'surffollow.hw' has no attribute {name!r}")
    from surffollow.extras import attribute_of

    return attribute_of(f"surffollow.hw.{_WHERE[name]}", name)
