"""Read fields and latches of a mapped board: bounded, load-only, never waiting."""

from __future__ import annotations

import struct
from typing import Any

from surffollow.client.fence import fence
from surffollow.errors import ClosedError
from surffollow.shm.latch_shape import HEAD_BYTES, MAX_TRIES, SLOTS, stride
from surffollow.shm.schema import Schema


def unpack_schema(schema: type[Schema], data: Any, at: int = 0) -> dict[str, Any]:
    """The fields of one structure as Python values: numbers, lists, text, nested dictionaries."""
    out: dict[str, Any] = {}
    for f in schema.FIELDS:
        start = at + f.offset
        if f.nested is not None:
            items = [unpack_schema(f.nested, data, start + k * f.item_size) for k in range(f.count)]
            out[f.name] = items if f.count > 1 else items[0]
            continue
        values = struct.unpack_from("<" + f.struct_format, data, start)
        if f.is_text:
            out[f.name] = values[0].split(b"\0", 1)[0].decode("utf-8", "replace")
        else:
            out[f.name] = list(values) if f.count > 1 else values[0]
    return out


CLOSED_TEXT = "this client was closed; attach again"


class _Closed:
    """In the place of the words of a closed attachment: every access raises ClosedError."""

    def __getitem__(self, _: int) -> int:
        raise ClosedError(CLOSED_TEXT)

    def __setitem__(self, _: int, value: int) -> None:
        raise ClosedError(CLOSED_TEXT)


CLOSED = _Closed()


class LatchReader:
    """Reads one latch of a mapped object: bounded, load-only, never waits (steps R1-R4)."""

    def __init__(self, words: memoryview, memory: Any, offset: int, schema: type[Schema]) -> None:
        self._words, self._memory = words, memory
        self._index, self._base = offset // 8, offset + HEAD_BYTES
        self._stride, self.schema = stride(schema.SIZE), schema

    def copy(self) -> bytes | None:
        """The newest payload; None when nothing was published or every try was torn.

        Raises
        ------
        ClosedError   the board was closed
        """
        words, index = self._words, self._index
        try:
            for _ in range(MAX_TRIES):
                g = words[index]
                if g == 0:
                    return None
                start = self._base + (g & (SLOTS - 1)) * self._stride
                fence()
                data = bytes(self._memory[start : start + self.schema.SIZE])
                fence()
                if words[index] - g <= SLOTS - 2:
                    return data
        except ValueError:  # `words` or `memory` was released
            raise ClosedError(CLOSED_TEXT) from None
        return None

    def read(self) -> dict[str, Any] | None:
        """The newest payload as a dictionary; None as for `copy`."""
        data = self.copy()
        return None if data is None else unpack_schema(self.schema, data)
