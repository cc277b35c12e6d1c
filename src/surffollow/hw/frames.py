"""Find measurements in bytes: lines by a regular expression, or binary frames of fixed length.

A piece of input that is no frame is rejected, counted, and followed by caution: the first good frame after
it is held back until a second one follows directly, for rubbish may look like one frame, seldom like two.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable

import msgspec

from surffollow.errors import ConfigError
from surffollow.units import parse_quantity

LONGEST_LINE = 1024
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
    unit : what the number 1 means ("mm", "0.1 mm")
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
    unit: str = "m"
    zero_m: float = 0.0

    def scale_m(self) -> float:
        """Metres of the number 1."""
        text = self.unit if re.match(r"\s*[-+.\d]", self.unit) else f"1 {self.unit}"
        try:
            return parse_quantity(text, "m")
        except ValueError as error:
            raise ConfigError(f"unit = {self.unit!r}: {error}") from None


# bytes from the frame's first one to the end of the input, channel, distance [m]
Measurement = tuple[int, int, "float | None"]


def reader_of(number: Number | Limits | Checksum, length: int, what: str) -> struct.Struct:
    """What reads a number of a frame of `length` bytes.

    Raises
    ------
    ConfigError
        no such type, or it does not lie within the frame; `what` names it
    """
    if number.type not in TYPES:
        raise ConfigError(f"{what}: type '{number.type}' is unknown; one of: {', '.join(TYPES)}")
    reader = struct.Struct(TYPES[number.type])
    if not 0 <= number.offset <= length - reader.size:
        raise ConfigError(
            f"{what}: offset {number.offset} with type {number.type} does not lie within a frame of {length} "
            "bytes"
        )
    return reader


class _Finder:
    """What both formats share: the input that waits, rejections, caution after them."""

    def __init__(self, form: Format) -> None:
        self._form, self._scale_m, self._zero_m = form, form.scale_m(), form.zero_m
        self._no_target = frozenset(form.no_target_values)
        self._held: tuple[int, int, float | None] | None = None
        self._waiting = bytearray()
        self._sure = False
        self.rejected = 0

    def restart(self) -> None:
        """Forget what waits: the device was away."""
        self._waiting.clear()
        self._sure, self._held = False, None

    def _reject(self) -> None:
        self.rejected += 1
        self._sure, self._held = False, None

    def _accept(
        self, out: list[Measurement], behind: int, length: int, got: tuple[int, float | None]
    ) -> None:
        """A good frame that ends `behind` bytes before the end of the input."""
        if not self._sure:
            if self._held is None:
                self._held = (length, *got)
                return
            before, channel, range_m = self._held
            out.append((behind + length + before, channel, range_m))
            self._sure, self._held = True, None
        out.append((behind + length, *got))

    def _metres(self, number: float) -> float | None:
        if number in self._no_target or number != number or abs(number) == float("inf"):
            return None
        return self._zero_m + self._scale_m * number


class LineFinder(_Finder):
    """Lines; see `Format`."""

    def __init__(self, form: Format) -> None:
        super().__init__(form)
        try:
            self._pattern = re.compile(form.pattern.encode())
            self._says_none = re.compile(form.no_target.encode()) if form.no_target else None
        except re.error as error:
            raise ConfigError(f"pattern is no regular expression: {error}") from None
        groups = self._pattern.groupindex
        if "range" not in groups:
            raise ConfigError("pattern needs a group named range, as in '(?P<range>[0-9]{4}[.][0-9]{3})'")
        if form.line_checksum:
            if form.line_checksum not in CHECKSUMS or not {"body", "check"} <= set(groups):
                raise ConfigError(
                    f"line_checksum = '{form.line_checksum}', expected one of {', '.join(CHECKSUMS)} and "
                    "groups body and check in the pattern"
                )
            self._checksum: Callable[[bytes], int] | None = CHECKSUMS[form.line_checksum]
        else:
            self._checksum = None
        self._has_channel, self._has_status = "channel" in groups, "status" in groups
        self._ok = frozenset(s.encode() for s in form.status_ok)
        self._end = form.terminator.encode()
        if not self._end:
            raise ConfigError("terminator is empty; lines need one")
        self._started = False

    def restart(self) -> None:
        super().restart()
        self._started = False

    def feed(self, data: bytes) -> list[Measurement]:
        """Measurements in the input so far, oldest first."""
        waiting, out = self._waiting, list[Measurement]()
        waiting += data
        while True:
            end = waiting.find(self._end)
            if end < 0:
                break
            line = bytes(waiting[:end])
            del waiting[: end + len(self._end)]
            if not self._started:
                self._started = True  # the first line may have lost its beginning
                continue
            got = self.parse(line)
            if got is None:
                self._reject()
            else:
                self._accept(out, len(waiting), len(line) + len(self._end), got)
        if len(waiting) > LONGEST_LINE:
            waiting.clear()
            self._started = False
            self._reject()
        return out

    def parse(self, line: bytes) -> tuple[int, float | None] | None:
        """Channel and distance of one line; None when it is no line of the format."""
        match = self._pattern.fullmatch(line)
        if match is None:
            return (0, None) if self._says_none is not None and self._says_none.fullmatch(line) else None
        if self._checksum is not None:
            try:
                if int(match["check"], 16) != self._checksum(match["body"]):
                    return None
            except ValueError:
                return None
        try:
            number, channel = float(match["range"]), int(match["channel"]) if self._has_channel else 0
        except ValueError:
            return None
        if not 0 <= channel < 8:
            return None
        if self._has_status and self._ok and match["status"] not in self._ok:
            return channel, None
        return channel, self._metres(number)


class FrameFinder(_Finder):
    """Binary frames of fixed length; see `Format`."""

    def __init__(self, form: Format) -> None:
        super().__init__(form)
        try:
            self._header = bytes.fromhex(form.header)
        except ValueError:
            raise ConfigError(f"header = {form.header!r}; write bytes in hexadecimal, like '59 59'") from None
        n = self._length = form.length
        if not len(self._header) < n <= LONGEST_LINE:
            raise ConfigError(
                f"length = {n}, expected more than the header's {len(self._header)} and at most 1024"
            )
        self._value = (reader_of(form.value, n, "value"), form.value.offset)
        self._channel = (reader_of(form.channel, n, "channel"), form.channel.offset) if form.channel else None
        self._limits = [(reader_of(x, n, "limits"), x) for x in form.limits]
        self._check = None
        if form.checksum is not None:
            c = form.checksum
            if c.kind not in CHECKSUMS:
                raise ConfigError(f"checksum kind '{c.kind}' is unknown; one of: {', '.join(CHECKSUMS)}")
            end = c.offset if c.end < 0 else c.end
            if not 0 <= c.start < end <= n:
                raise ConfigError(f"checksum over bytes {c.start} to {end} of a frame of {n}")
            self._check = (reader_of(c, n, "checksum"), c.offset, CHECKSUMS[c.kind], c.start, end)

    def feed(self, data: bytes) -> list[Measurement]:
        """Measurements in the input so far, oldest first."""
        waiting, out, at = self._waiting, list[Measurement](), 0
        waiting += data
        length = self._length
        while len(waiting) - at >= length:
            got = self.parse(bytes(waiting[at : at + length]))
            if got is not None:
                self._accept(out, len(waiting) - at - length, length, got)
                at += length
                continue
            self._reject()
            # on to the next place where a frame may begin
            found = waiting.find(self._header, at + 1) if self._header else at + 1
            at = found if found >= 0 else max(at + 1, len(waiting) - len(self._header) + 1)
        del waiting[:at]
        return out

    def parse(self, frame: bytes) -> tuple[int, float | None] | None:
        """Channel and distance of one frame; None when it is none."""
        if len(frame) != self._length or not frame.startswith(self._header):
            return None
        if self._check is not None:
            reader, at, checksum, start, end = self._check
            if reader.unpack_from(frame, at)[0] != checksum(frame[start:end]):
                return None
        channel = 0
        if self._channel is not None:
            channel = int(self._channel[0].unpack_from(frame, self._channel[1])[0])
            if not 0 <= channel < 8:
                return None
        for reader, x in self._limits:
            number = reader.unpack_from(frame, x.offset)[0]
            if not x.low <= (int(number) & x.mask if x.mask >= 0 else number) <= x.high:
                return channel, None
        return channel, self._metres(self._value[0].unpack_from(frame, self._value[1])[0])


def make_finder(form: Format) -> LineFinder | FrameFinder:
    """The finder of a format.

    Raises
    ------
    ConfigError
        neither lines nor frames, or a part that cannot be
    """
    if bool(form.pattern) == bool(form.length):
        raise ConfigError("give either pattern (lines) or length, header and value (binary frames)")
    return LineFinder(form) if form.pattern else FrameFinder(form)
