"""Protocol-buffer messages without a library: declare fields, encode and decode values.

The encoding specification of protocol buffers (proto3). Only what recordings need is here: scalars,
text, bytes, nested messages, packed numbers. `protobuf_types` describes the types for readers.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
# kind → (number of the type in a descriptor, wire type, struct letter)
KINDS: dict[str, tuple[int, int, str]] = {
    "double": (1, FIXED64, "d"),
    "float": (2, FIXED32, "f"),
    "int64": (3, VARINT, ""),
    "int32": (5, VARINT, ""),
    "fixed32": (7, FIXED32, "I"),
    "bool": (8, VARINT, ""),
    "string": (9, BYTES, ""),
    "message": (11, BYTES, ""),
    "bytes": (12, BYTES, ""),
    "enum": (14, VARINT, ""),
    "sfixed32": (15, FIXED32, "i"),
    "fixed64": (6, FIXED64, "Q"),
    "sfixed64": (16, FIXED64, "q"),
}


@dataclass(frozen=True)
class Field:
    """One field; `of` is the nested message or the enumeration."""

    name: str
    number: int
    kind: str
    repeated: bool = False
    of: Message | Enum | None = None


@dataclass(frozen=True)
class Enum:
    """An enumeration, declared inside the message that uses it."""

    name: str
    values: tuple[str, ...]


@dataclass(frozen=True)
class Message:
    """A message type: package and name, fields, enumerations declared inside."""

    package: str
    name: str
    fields: tuple[Field, ...]
    enums: tuple[Enum, ...] = ()
    by_name: dict[str, Field] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        self.by_name.update({f.name: f for f in self.fields})

    @property
    def full_name(self) -> str:
        """Name with the package, as schema records have it."""
        return f"{self.package}.{self.name}"

    def encode(self, values: Mapping[str, Any]) -> bytes:
        """The message with these values; an absent or None field is left out, and so reads as its default.

        Raises
        ------
        KeyError  a value of a field that the message does not have
        """
        out = bytearray()
        for name, value in values.items():
            if value is not None:
                _encode_field(out, self.by_name[name], value)
        return bytes(out)

    def decode(self, data: bytes) -> dict[str, Any]:
        """The values in an encoded message; fields that are absent are absent, unknown ones passed over.

        Raises
        ------
        ValueError  the data is cut short or no such message
        """
        numbers = {f.number: f for f in self.fields}
        out: dict[str, Any] = {f.name: [] for f in self.fields if f.repeated}
        at = 0
        while at < len(data):
            tag, at = _read_varint(data, at)
            value, at = _read_value(data, at, tag & 7)
            f = numbers.get(tag >> 3)
            if f is None:
                continue
            values = (
                _unpacked(f, value) if f.repeated and KINDS[f.kind][1] != BYTES else [_as_value(f, value)]
            )
            if f.repeated:
                out[f.name] += values
            else:
                out[f.name] = values[0]
        return out


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while at < len(data) and shift < 64:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
    raise ValueError("a message is cut short")


def _read_value(data: bytes, at: int, wire: int) -> tuple[Any, int]:
    if wire == VARINT:
        return _read_varint(data, at)
    if wire == BYTES:
        length, at = _read_varint(data, at)
    elif wire in (FIXED64, FIXED32):
        length = 8 if wire == FIXED64 else 4
    else:
        raise ValueError(f"a message has a field of the unknown wire type {wire}")
    if at + length > len(data):
        raise ValueError("a message is cut short")
    return data[at : at + length], at + length


def _as_value(f: Field, value: Any) -> Any:
    _, wire, letter = KINDS[f.kind]
    if wire == VARINT:
        return value - (1 << 64) if value >= 1 << 63 else value
    if wire in (FIXED64, FIXED32):
        try:
            return struct.unpack(f"<{letter}", value)[0]
        except struct.error as e:
            raise ValueError(f"field {f.name}: {e}") from None
    if f.kind == "string":
        return value.decode("utf-8", "replace")
    return f.of.decode(value) if isinstance(f.of, Message) else value


def _unpacked(f: Field, value: Any) -> list[Any]:
    _, wire, letter = KINDS[f.kind]
    if not isinstance(value, bytes):
        return [_as_value(f, value)]
    if wire != VARINT:
        size = struct.calcsize(letter)
        if len(value) % size:
            raise ValueError(f"field {f.name} does not hold whole numbers")
        return list(struct.unpack(f"<{len(value) // size}{letter}", value))
    out, at = [], 0
    while at < len(value):
        number, at = _read_varint(value, at)
        out.append(_as_value(f, number))
    return out


def varint(value: int) -> bytes:
    """A whole number in groups of seven bits; negative ones as two's complement of 64 bits."""
    value &= (1 << 64) - 1
    out = bytearray()
    while value > 0x7F:
        out.append((value & 0x7F) | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def tag(number: int, wire: int) -> bytes:
    return varint(number << 3 | wire)


def _encode_field(out: bytearray, f: Field, value: Any) -> None:
    _, wire, letter = KINDS[f.kind]
    if f.repeated and wire != BYTES:
        data = value if isinstance(value, bytes) else _packed(wire, letter, value)
        out += tag(f.number, BYTES) + varint(len(data)) + data
        return
    for item in value if f.repeated else (value,):
        out += tag(f.number, wire)
        if wire == BYTES:
            data = _as_bytes(f, item)
            out += varint(len(data)) + data
        elif wire == VARINT:
            out += varint(int(item))
        else:
            out += struct.pack(f"<{letter}", item)


def _packed(wire: int, letter: str, values: Iterable[Any]) -> bytes:
    if wire == VARINT:
        return b"".join(varint(int(v)) for v in values)
    items = list(values)
    return struct.pack(f"<{len(items)}{letter}", *items)


def _as_bytes(f: Field, item: Any) -> bytes:
    if isinstance(item, bytes):
        return item
    if isinstance(item, str):
        return item.encode()
    assert isinstance(f.of, Message)
    return f.of.encode(item)
