"""A private copy of one publication of a block."""

from __future__ import annotations

import time
from typing import Any

from surffollow.blocks.layout import HEAD, SlotHead
from surffollow.blocks.record import Record
from surffollow.shm.schema import Schema

_HEAD = SlotHead.struct_of("generation", "t_ns")


class Snapshot:
    """Result of `latest`: a whole publication, never a mixture of two.

    Attributes
    ----------
    generation : int
        number of the publication; 0: nothing was published yet, all values are zero
    stale : bool
        an older copy, because the newest could not be had: the writer was too fast for every
        try, or gave the block up, or has not published yet
    data : bytes
        slot head and payload

    Examples
    --------
    >>> import os
    >>> from surffollow.blocks import F64, Block, mem_attach
    >>> class Axes(Block):
    ...     speed = F64(unit="m/s")
    >>> with mem_attach(Axes, f"example-{os.getpid()}", write=True) as mem:
    ...     empty = mem.axes.latest()
    ...     with mem.axes.write() as slot:
    ...         slot.speed = 0.5
    ...     newest = mem.axes.latest()
    >>> empty.generation, newest.generation, newest["speed"], newest.values.speed
    (0, 1, 0.5, 0.5)
    >>> newest.stale, newest.age_ns(newest.t_ns + 1_000), len(newest.payload)
    (False, 1000, 8)
    """

    __slots__ = ("data", "generation", "schema", "stale")

    def __init__(self, schema: type[Schema], data: bytes, generation: int, stale: bool) -> None:
        self.schema, self.data, self.generation, self.stale = schema, data, generation, stale

    @property
    def values(self) -> Record:
        """The fields."""
        return Record(self.schema, self.data, HEAD)

    @property
    def payload(self) -> bytes:
        """The structure's bytes, as other machines get them."""
        return self.data[HEAD : HEAD + self.schema.SIZE]

    @property
    def epoch(self) -> int:
        """Number of the writer that published it."""
        return int(_HEAD.unpack_from(self.data)[1])

    @property
    def t_ns(self) -> int:
        """When it was published, CLOCK_MONOTONIC [ns]."""
        return int(_HEAD.unpack_from(self.data)[2])

    def age_ns(self, now_ns: int | None = None) -> int:
        """How long ago it was published [ns].

        Parameters
        ----------
        now_ns : int, optional
            CLOCK_MONOTONIC [ns]; now when absent

        Returns
        -------
        int
            time since the publication [ns]
        """
        return (time.monotonic_ns() if now_ns is None else now_ns) - self.t_ns

    def __getitem__(self, name: str) -> Any:
        return self.values[name]

    def __repr__(self) -> str:
        mark = ", stale" if self.stale else ""
        return f"<{self.values!r}, generation {self.generation}{mark}>"
