"""Types of protocol-buffer messages: their description for readers, and types that follow declared layouts.

A reader of an MCAP file decodes a message by the `FileDescriptorSet` in its schema record, which is itself
made of messages (google/protobuf/descriptor.proto).
"""

from __future__ import annotations

from surffollow.record.protobuf import BYTES, KINDS, VARINT, Enum, Field, Message, tag, varint
from surffollow.shm.schema import Schema

_PROTO3 = "proto3"
# types of declared scalars: fixed widths, which every language reads back exactly
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


def _text(number: int, value: str) -> bytes:
    return _blob(number, value.encode())


def _blob(number: int, data: bytes) -> bytes:
    return tag(number, BYTES) + varint(len(data)) + data


def _whole(number: int, value: int) -> bytes:
    return tag(number, VARINT) + varint(value)


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
