"""Follow and map surfaces with a stand-off sensor.

Contents; each part is loaded when it is used first:

- `surffollow.Follower`: the follower in process, without a service
- `surffollow.client`: attach to a running service: poses in, demands out
- `surffollow.blocks`: share state between programs
- `surffollow.arbiter`: share a robot among clients by priority
- `surffollow.map`: height maps
- `surffollow.scan`: terrain from depth images, planned scan paths
- `surffollow.sonar`: wall poses from beam-spread sonars
- `surffollow.hw`: drivers of range sensors
- `surffollow.errors`, `surffollow.units`: exceptions; quantities with units

The client, blocks and the arbiter's client need the standard library alone.
The rest needs the extra `service`.
The service itself is the command `surffollow`.
"""

from __future__ import annotations

import importlib
import sys

TYPE_CHECKING = False  # not typing's: its import takes as long as all before `cli.entry` handles Ctrl-C
if TYPE_CHECKING:
    from typing import Any

    from surffollow.follower import Follower

__all__ = ["Follower"]
_LIGHT = ("arbiter", "blocks", "client", "errors", "units")
_HEAVY = ("hw", "map", "scan", "sonar")


def __dir__() -> list[str]:
    """Names that can be used here; those that compute are left out of a client-only installation."""
    import importlib.util

    computes = importlib.util.find_spec("numba") is not None
    own = (n for n in globals() if n.startswith("__") or f"{__name__}.{n}" in sys.modules)
    return sorted({*own, "__version__", *_LIGHT, *((*__all__, *_HEAVY) if computes else ())})


def __getattr__(name: str) -> Any:
    """Load a part on its first use."""
    if name in _LIGHT or name in _HEAVY:
        return importlib.import_module(f"{__name__}.{name}")
    if name == "__version__":
        from surffollow.release import program_version

        return program_version()
    if name == "Follower":
        from surffollow.extras import attribute_of

        return attribute_of("surffollow.follower", name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
