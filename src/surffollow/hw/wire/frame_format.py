"""How a sensor's lines or frames are written: numbers, limits, checksums, units."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable

import msgspec

from surffollow.errors import ConfigError
from surffollow.units import parse_quantity

_CODES = {"u16": "H", "i16": "h", "u32": "I", "i32": "i", "u64": "Q", "i64": "q", "f32": "f", "f64": "d"}
_ORDERS = {"le": "<", "be": ">"}
# how a number is written → its code for `struct`
TYPES = {
    "u8": "<B",
    "i8": "<b",
    **{name + order: mark + code for name, code in _CODES.items() for order, mark in _ORDERS.items()},
}


def xor8(data: bytes) -> int:
    """Exclusive or of all bytes."""
    value = 0
    for byte in data:
        value ^= byte
    return value


def sum8(data: bytes) -> int:
    """Low byte of the sum of all bytes."""
    return sum(data) & 0xFF


def crc16_modbus(data: bytes) -> int:
    """CRC-16/MODBUS: polynomial 0x8005 reflected, start 0xFFFF."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return crc


def crc16_ccitt(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


CHECKSUMS: dict[str, Callable[[bytes], int]] = {
    "xor8": xor8,
    "sum8": sum8,
    "crc16-modbus": crc16_modbus,
    "crc16-ccitt": crc16_ccitt,
}


class Number(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A number in a binary frame: where it is, how it is written ("u16le", "i32be", "f32le", "u8", ...)."""

    offset: int
    type: str = "u16le"


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A number in a binary frame that must lie within bounds, else the frame is no measurement."""

    offset: int
    type: str = "u8"
    low: float = -float("inf")
    high: float = float("inf")
    mask: int = -1


class Checksum(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A checksum in a binary frame: its kind, where and how it is written, over which bytes."""

    kind: str
    offset: int
    type: str = "u8"
    start: int = 0
    end: int = -1


class Format(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a measurement is written.

    Attributes
    ----------
    pattern : lines: regular expression that a whole line must match; its group `range` is the number, its
        groups `channel` (0 to 7), `status`, `body` and `check` (checksum in hexadecimal) may be left out
    terminator : of lines
    no_target : lines: regular expression of those that say "no measurement"
    status_ok : lines: values of the group `status` that mean a good measurement; empty: all
    line_checksum : lines: kind of the checksum in `check` over `body`
    header : frames: first bytes, in hexadecimal ("59 59")
    length : frames: bytes of a frame, header included; 0: the input is lines
    value : frames: the number
    channel : frames: where the channel's number is, if it is there
    limits : frames: status, signal quality and so on
    checksum : frames
    no_target_values : numbers that mean "no measurement"
    unit : what the number 1 means ("mm", "0.1 mm"); must be given
    zero_m : what the number 0 means [m]
    """

    pattern: str = ""
    terminator: str = "\r\n"
    no_target: str = ""
    status_ok: tuple[str, ...] = ()
    line_checksum: str = ""
    header: str = ""
    length: int = 0
    value: Number = Number(0)
    channel: Number | None = None
    limits: tuple[Limits, ...] = ()
    checksum: Checksum | None = None
    no_target_values: tuple[float, ...] = ()
    unit: str = ""
    zero_m: float = 0.0

    def scale_m(self) -> float:
        """Metres of the number 1.

        Raises
        ------
        ConfigError
            no unit, or none of a length; a unit of 0, or a `zero_m` that is no number
        """
        if not self.unit.strip():
            raise ConfigError(
                "the format has no unit: give what the number 1 means, such as "
                'unit = "1 mm", or "1 m" for metres'
            )
        text = self.unit if re.match(r"\s*[-+.\d]", self.unit) else f"1 {self.unit}"
        if not math.isfinite(self.zero_m):
            raise ConfigError(f"zero_m = {self.zero_m}, expected the distance of the number 0 [m]")
        try:
            scale_m = parse_quantity(text, "m")
        except ValueError as error:
            raise ConfigError(f"unit = {self.unit!r}: {error}") from None
        if scale_m == 0.0:
            raise ConfigError(
                f"unit = {self.unit!r}: every number would be the same distance; give what 1 means"
            )
        return scale_m


def reader_of(
    number: Number | Limits | Checksum, length: int, what: str, whole: bool = False
) -> struct.Struct:
    """Reader of a number in a frame of `length` bytes.

    Raises
    ------
    ConfigError
        no such type, no whole number where one is needed, or not within the frame; `what` names it
    """
    known = [t for t in TYPES if not (whole and t.startswith("f"))]
    if number.type in TYPES and number.type not in known:
        raise ConfigError(f"{what}: type '{number.type}' is no whole number; one of: {', '.join(known)}")
    if number.type not in TYPES:
        raise ConfigError(f"{what}: type '{number.type}' is unknown; one of: {', '.join(known)}")
    reader = struct.Struct(TYPES[number.type])
    if not 0 <= number.offset <= length - reader.size:
        raise ConfigError(
            f"{what}: offset {number.offset} with type {number.type} does not lie within a frame of {length} "
            "bytes"
        )
    return reader
