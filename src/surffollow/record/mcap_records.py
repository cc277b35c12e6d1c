"""Decode the MCAP records made of texts: schemas, channels and metadata."""

from __future__ import annotations

import struct


def _text(body: memoryview, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", body, at)
    end = at + 4 + length
    if end > len(body):
        raise ValueError("a text is cut short")
    return bytes(body[at + 4 : end]).decode(), end


def read_schema(body: memoryview) -> tuple[int, str, str, bytes]:
    """Number, name, encoding and text of a schema record; empty when it is damaged."""
    try:
        (number,) = struct.unpack_from("<H", body)
        name, at = _text(body, 2)
        encoding, at = _text(body, at)
        (length,) = struct.unpack_from("<I", body, at)
    except (struct.error, ValueError):
        return 0, "", "", b""
    return number, name, encoding, bytes(body[at + 4 : at + 4 + length])


def read_channel(body: memoryview) -> tuple[int, int, str, str, dict[str, str]]:
    """Number, schema's number, topic, encoding and metadata of a channel record; empty when it is damaged."""
    try:
        number, schema = struct.unpack_from("<HH", body)
        topic, at = _text(body, 4)
        encoding, at = _text(body, at)
        metadata = _texts(body, at)
    except (struct.error, ValueError):
        return -1, 0, "", "", {}
    return number, schema, topic, encoding, metadata


def _texts(body: memoryview, at: int) -> dict[str, str]:
    values: dict[str, str] = {}
    at += 4
    while at < len(body):
        key, at = _text(body, at)
        values[key], at = _text(body, at)
    return values


def read_metadata(body: memoryview) -> tuple[str, dict[str, str]]:
    """Name and values of a metadata record; empty when it is damaged."""
    try:
        name, at = _text(body, 0)
        return name, _texts(body, at)
    except (struct.error, ValueError):
        return "", {}
