"""Logical sensors: named quantities computed from raw readings, with tolerance, age and alternatives.

A logical sensor has sources in order of preference. The first one that gives a recent value is used.
When it fails, the next takes over and the published tolerance is that of the source in use (Henderson and
Shilcrat's scheme, as the paper cites it). Raw readings stay readable in their own blocks.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from numbers import Integral, Real

from surffollow.blocks import F64, I64, AttachedBlock, Block, Memory, Text, mem_attach
from surffollow.errors import UsageError
from surffollow.units import real_number

MAX_VALUES, MAX_NAME_BYTES = 8, 31


class LogicalReading(Block):
    """A quantity as its logical sensor publishes it."""

    valid = I64(doc="1: a source gave a value that is recent")
    t_ns = I64(unit="ns", doc="when the value was true, CLOCK_MONOTONIC")
    n = I64(doc="values used")
    value = F64(MAX_VALUES, doc="in the units of the quantity")
    tolerance = F64(MAX_VALUES, doc="one standard deviation of each value")
    source = I64(doc="index of the source in use; -1: none")
    source_name = Text(32)
    failed = I64(doc="bit per source that gave no value")


@dataclass(frozen=True)
class Quantity:
    """Values of a source.

    Attributes
    ----------
    t_ns : int
        when they were true, CLOCK_MONOTONIC
    values, tolerances : tuple
        up to 8 numbers each; tolerances are standard deviations
    """

    t_ns: int
    values: tuple[float, ...]
    tolerances: tuple[float, ...]


@dataclass(frozen=True)
class Source:
    """One way to compute a quantity.

    Attributes
    ----------
    name : str
        up to 31 bytes
    read : callable
        gives a Quantity, or None when its raw readings do not allow one
    max_age_s : float
        older values count as a failure
    """

    name: str
    read: Callable[[], Quantity | None]
    max_age_s: float


@dataclass(frozen=True)
class Evaluated:
    """Output of a logical sensor: the quantity and its source, or neither."""

    quantity: Quantity | None
    source: int
    failed: int


class LogicalSensor:
    """A named quantity with its sources, published in the block NAME.QUANTITY.

    Parameters
    ----------
    quantity : str
        name of the quantity, such as "wall_pose" or "front_clearance"
    sources : sequence of Source in order of preference

    Raises
    ------
    UsageError
        no source, more than 62, or a name or an age that none can have
    """

    def __init__(self, quantity: str, sources: Sequence[Source]) -> None:
        if not sources or len(sources) > 62:
            raise UsageError(f"logical sensor {quantity!r} has {len(sources)} sources; give 1 to 62")
        for source in sources:  # here, not when an alternative is needed for the first time
            _check_source(source)
        self.quantity, self.sources = quantity, tuple(sources)
        self._memory: Memory | None = None

    def evaluate(self, now_ns: int | None = None) -> Evaluated:
        """The first source that gives a finite recent value.

        A source that raises, or gives what is no quantity, has failed.

        Parameters
        ----------
        now_ns : int, optional
            CLOCK_MONOTONIC; by default the time after each source was read
        """
        failed = 0
        for index, source in enumerate(self.sources):
            try:
                got = source.read()
                now = time.monotonic_ns() if now_ns is None else now_ns
                if got is not None and _is_usable(got, now, source.max_age_s):
                    return Evaluated(got, index, failed)
            except Exception:  # a failing source must not take its alternatives with it
                pass
            failed |= 1 << index
        return Evaluated(None, -1, failed)

    def publish(self, name: str, now_ns: int | None = None) -> Evaluated:
        """Evaluate and write the block `name`.`quantity`; the first call makes this process its writer.

        Raises
        ------
        BusyError
            another live process publishes this quantity
        """
        if self._memory is None:
            self._memory = mem_attach({self.quantity: LogicalReading}, name, write=True)
        said = self.evaluate(now_ns)
        block: AttachedBlock = self._memory[self.quantity]
        with block.write() as slot:
            slot.valid, slot.source, slot.failed = int(said.quantity is not None), said.source, said.failed
            slot.source_name = self.sources[said.source].name if said.source >= 0 else ""
            if said.quantity is not None:
                n, pad = len(said.quantity.values), MAX_VALUES - len(said.quantity.values)
                slot.t_ns, slot.n = said.quantity.t_ns, n
                slot.value = [*said.quantity.values, *[0.0] * pad]
                slot.tolerance = [*said.quantity.tolerances, *[0.0] * pad]
        return said

    def close(self) -> None:
        """Give the block back."""
        if self._memory is not None:
            self._memory.close()
            self._memory = None


def _check_source(source: Source) -> None:
    name = source.name
    try:
        fits = len(name.encode()) <= MAX_NAME_BYTES and name.isprintable()
    except (AttributeError, UnicodeEncodeError):
        fits = False
    if not fits:
        raise UsageError(
            f"a source is named {name!r}; a name has up to {MAX_NAME_BYTES} bytes of UTF-8 and no control "
            "character"
        )
    if not real_number(source.max_age_s, "max_age_s") >= 0.0:
        raise UsageError(f"max_age_s of source {name!r} is {source.max_age_s}; expected 0 s or more")


def _is_usable(quantity: Quantity, now_ns: int, max_age_s: float) -> bool:
    values, tolerances = quantity.values, quantity.tolerances
    return (
        # a time that the block cannot hold would leave the last value valid in it
        isinstance(quantity.t_ns, Integral)
        and 0 < len(values) == len(tolerances) <= MAX_VALUES
        and all(isinstance(x, Real) and math.isfinite(x) for x in (*values, *tolerances))
        and all(x >= 0.0 for x in tolerances)
        and 0 <= now_ns - quantity.t_ns <= max_age_s * 1e9
    )
