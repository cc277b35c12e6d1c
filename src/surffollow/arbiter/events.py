"""The history of an arbiter: who asked, held, lost and commanded what, and what was rejected."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from surffollow.arbiter import layout as al
from surffollow.arbiter.table import EVENTS
from surffollow.client.fence import FENCED, fence
from surffollow.shm.layout_board import LogHead

_EVENT = al.Event.struct_of("seq", "command")
_RESERVED, _HEAD = LogHead.offset("reserved") // 8, LogHead.offset("head") // 8
_WORDS = LogHead.SIZE


class HistoryEvent(NamedTuple):
    """One record.

    Attributes
    ----------
    seq : int
        number of the record; a gap means that records were overwritten before they were read
    t_ns : int
        when, CLOCK_MONOTONIC [ns]
    client : int
        number of the client, never used twice; 0: none
    resource : str
        "" for none
    token : int
    event : str
        GRANT, REVOKE, FORWARD, SAFE, … (`layout.EVENT_NAMES`)
    reason : str
        what led to it: REQUEST, GONE, LATE, …
    item : int
        sequence number of the client's message, 0: none
    command : tuple of 8 floats
    """

    seq: int
    t_ns: int
    client: int
    resource: str
    token: int
    event: str
    reason: str
    item: int
    command: tuple[float, ...]


class History:
    """An iterator over the records of one server; it ends at the newest and can be asked again.

    Attributes
    ----------
    lost : int
        records that were overwritten before they were read

    Examples
    --------
    >>> from surffollow.arbiter import attach
    >>> with attach("cell", "go") as arbiter:
    ...     history = arbiter.history()                       # from now on
    ...     _ = arbiter.resource("robot").request(timeout_s=5.0)
    ...     events = [(event.event, event.resource) for event in history]
    >>> ("GRANT", "robot") in events
    True
    """

    def __init__(
        self, memory: Any, offset: int, capacity: int, resources: tuple[str, ...], oldest: bool
    ) -> None:
        self._memory, self._offset, self._capacity = memory, offset, capacity
        self._words = memoryview(memory).cast("q")
        self._base, self._resources = offset // 8, resources
        self.lost = 0
        head = self._words[self._base + _HEAD] // al.EVENT_WORDS
        self._next = max(0, head - capacity + 1) if oldest else head

    def __iter__(self) -> Iterator[HistoryEvent]:
        return self

    def __next__(self) -> HistoryEvent:
        while True:
            head = self._words[self._base + _HEAD] // al.EVENT_WORDS
            if self._next >= head:
                raise StopIteration
            if FENCED:
                fence()
            at = self._offset + _WORDS + (self._next & (self._capacity - 1)) * al.Event.SIZE
            values = _EVENT.unpack_from(self._memory, at)
            if FENCED:
                fence()
            behind = self._words[self._base + _RESERVED] // al.EVENT_WORDS - self._next
            if behind <= self._capacity:
                self._next += 1
                return self._event(values)
            skip = behind - self._capacity + self._capacity // 8
            self.lost += skip
            self._next += skip

    def _event(self, values: tuple[Any, ...]) -> HistoryEvent:
        seq, t_ns, client, resource, token, event, reason, item, *command = values
        name = self._resources[resource] if 0 <= resource < len(self._resources) else ""
        about = EVENTS[reason] if name and 0 <= reason < len(EVENTS) else ""
        text = al.EVENT_NAMES.get(event, str(event))
        return HistoryEvent(seq, t_ns, client, name, token, text, about, item, tuple(command))

    def newest(self, count: int) -> list[HistoryEvent]:
        """The newest records, oldest of them first.

        Parameters
        ----------
        count : int
            most records

        Returns
        -------
        list of HistoryEvent
            oldest of them first
        """
        head = self._words[self._base + _HEAD] // al.EVENT_WORDS
        self._next = max(0, head - min(count, self._capacity - 1))
        return list(self)
