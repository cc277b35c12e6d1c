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


def __getattr__(name: str) -> Any:
    """Load what is asked for: the kernels behind a queue take a moment to import."""
    if name not in _WHERE:
        raise AttributeError(f"module 'surffollow.hw' has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(f"surffollow.hw.{_WHERE[name]}"), name)
