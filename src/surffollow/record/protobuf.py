"""Protocol-buffer messages without a library: declare fields, encode values, describe the type for readers.

A reader of an MCAP file decodes a message by the `FileDescriptorSet` in its schema record
(encoding specification of protocol buffers, proto3). Only what recordings need is here: scalars,
text, bytes, nested messages, packed numbers.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from surffollow.shm.schema import Schema

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
# kind → (number of the type in a descriptor, wire type, struct letter)
KINDS: dict[str, tuple[int, int, str]] = {
    "double": (1, _FIXED64, "d"),
    "float": (2, _FIXED32, "f"),
    "int64": (3, _VARINT, ""),
    "int32": (5, _VARINT, ""),
    "fixed32": (7, _FIXED32, "I"),
    "bool": (8, _VARINT, ""),
    "string": (9, _BYTES, ""),
    "message": (11, _BYTES, ""),
    "bytes": (12, _BYTES, ""),
    "enum": (14, _VARINT, ""),
    "sfixed32": (15, _FIXED32, "i"),
    "fixed64": (6, _FIXED64, "Q"),
    "sfixed64": (16, _FIXED64, "q"),
}
_PROTO3 = "proto3"
# what a declared scalar becomes: fixed widths, which every language reads back exactly
_OF_CODE = {
    "f8": "double",
    "f4": "float",
    "i8": "sfixed64",
    "u8": "fixed64",
    "i4": "sfixed32",
    "u4": "fixed32",
    "i2": "sfixed32",
    "u2": "fixed32",
    "i1": "sfixed32",
    "u1": "fixed32",
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
                _unpacked(f, value) if f.repeated and KINDS[f.kind][1] != _BYTES else [_as_value(f, value)]
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
    if wire == _VARINT:
        return _read_varint(data, at)
    if wire == _BYTES:
        length, at = _read_varint(data, at)
    elif wire in (_FIXED64, _FIXED32):
        length = 8 if wire == _FIXED64 else 4
    else:
        raise ValueError(f"a message has a field of the unknown wire type {wire}")
    if at + length > len(data):
        raise ValueError("a message is cut short")
    return data[at : at + length], at + length


def _as_value(f: Field, value: Any) -> Any:
    _, wire, letter = KINDS[f.kind]
    if wire == _VARINT:
        return value - (1 << 64) if value >= 1 << 63 else value
    if wire in (_FIXED64, _FIXED32):
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
    if wire != _VARINT:
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


def _tag(number: int, wire: int) -> bytes:
    return varint(number << 3 | wire)


def _encode_field(out: bytearray, f: Field, value: Any) -> None:
    _, wire, letter = KINDS[f.kind]
    if f.repeated and wire != _BYTES:
        data = value if isinstance(value, bytes) else _packed(wire, letter, value)
        out += _tag(f.number, _BYTES) + varint(len(data)) + data
        return
    for item in value if f.repeated else (value,):
        out += _tag(f.number, wire)
        if wire == _BYTES:
            data = _as_bytes(f, item)
            out += varint(len(data)) + data
        elif wire == _VARINT:
            out += varint(int(item))
        else:
            out += struct.pack(f"<{letter}", item)


def _packed(wire: int, letter: str, values: Iterable[Any]) -> bytes:
    if wire == _VARINT:
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


# -- the description of a type, itself made of messages (google/protobuf/descriptor.proto) ------------


def _text(number: int, value: str) -> bytes:
    return _blob(number, value.encode())


def _blob(number: int, data: bytes) -> bytes:
    return _tag(number, _BYTES) + varint(len(data)) + data


def _whole(number: int, value: int) -> bytes:
    return _tag(number, _VARINT) + varint(value)


def _file_name(message: Message) -> str:
    return f"{message.package.replace('.', '/')}/{message.name}.proto"


def _describe_field(message: Message, f: Field) -> bytes:
    out = _text(1, f.name) + _whole(3, f.number) + _whole(4, 3 if f.repeated else 1)
    out += _whole(5, KINDS[f.kind][0])
    if isinstance(f.of, Message):
        out += _text(6, f".{f.of.full_name}")
    elif isinstance(f.of, Enum):
        out += _text(6, f".{message.full_name}.{f.of.name}")
    return out


def _describe_message(message: Message) -> bytes:
    out = _text(1, message.name)
    out += b"".join(_blob(2, _describe_field(message, f)) for f in message.fields)
    for e in message.enums:
        values = b"".join(_blob(2, _text(1, v) + _whole(2, k)) for k, v in enumerate(e.values))
        out += _blob(4, _text(1, e.name) + values)
    return out


def _needed(message: Message) -> dict[str, Message]:
    """The message types that one is made of, those that others need first."""
    found: dict[str, Message] = {}
    for f in message.fields:
        if isinstance(f.of, Message):
            found |= {k: v for k, v in _needed(f.of).items() if k not in found}
    return found | {message.full_name: message}


def descriptor_set(message: Message) -> bytes:
    """The `FileDescriptorSet` of a message and all that it is made of, one file per message."""
    out = b""
    for m in _needed(message).values():
        files = dict.fromkeys(_file_name(f.of) for f in m.fields if isinstance(f.of, Message))
        out += _blob(
            1,
            _text(1, _file_name(m))
            + _text(2, m.package)
            + b"".join(_text(3, name) for name in files)
            + _blob(4, _describe_message(m))
            + _text(12, _PROTO3),
        )
    return out


# -- messages from declared layouts -------------------------------------------------------------------


def message_of(schema: type[Schema], package: str, before: tuple[Field, ...] = ()) -> Message:
    """The message type of a declared layout: the same names in the same order, behind the fields `before`.

    Arrays and nested arrays become repeated fields, texts strings; whole numbers keep their sign.
    """
    fields, number = list(before), len(before)
    taken = {f.name for f in before}
    for f in schema.FIELDS:
        if f.name in taken:
            continue
        number += 1
        of = message_of(f.nested, f"{package}.{schema.__name__.lower()}") if f.nested is not None else None
        kind = "message" if of is not None else "string" if f.is_text else _OF_CODE[f.code]
        fields.append(Field(f.name, number, kind, f.count > 1 and not f.is_text, of))
    return Message(package, schema.__name__, tuple(fields))
