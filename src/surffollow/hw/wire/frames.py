"""Find measurements in bytes: lines by a regular expression, or binary frames of fixed length.

A piece of input that is no frame is rejected, counted, and followed by caution: the first good frame after
it is held back until a second one follows directly, for rubbish may look like one frame, seldom like two.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from surffollow.errors import ConfigError
from surffollow.hw.wire.frame_format import CHECKSUMS, Format, reader_of

LONGEST_LINE = 1024

# bytes from the frame's first one to the end of the input, channel, distance [m]
Measurement = tuple[int, int, "float | None"]


class _Finder:
    """Common parts of both formats: waiting input, rejections, confirmation after them."""

    def __init__(self, form: Format) -> None:
        self._scale_m, self._zero_m = form.scale_m(), form.zero_m
        self._no_target = frozenset(form.no_target_values)
        self._held: tuple[int, int, float | None] | None = None
        self._waiting = bytearray()
        self._synchronised = False
        self.rejected = 0

    def restart(self) -> None:
        """Forget what waits: the device was away."""
        self._waiting.clear()
        self._synchronised, self._held = False, None

    def _reject(self) -> None:
        self.rejected += 1
        self._synchronised, self._held = False, None

    def _accept(
        self, out: list[Measurement], behind: int, length: int, got: tuple[int, float | None]
    ) -> None:
        """A good frame that ends `behind` bytes before the end of the input."""
        if not self._synchronised:
            if self._held is None:
                self._held = (length, *got)
                return
            before, channel, range_m = self._held
            out.append((behind + length + before, channel, range_m))
            self._synchronised, self._held = True, None
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
            self._reports_none = re.compile(form.no_target.encode()) if form.no_target else None
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
            return (
                (0, None) if self._reports_none is not None and self._reports_none.fullmatch(line) else None
            )
        if self._checksum is not None:
            try:
                if int(match["check"], 16) != self._checksum(match["body"]):
                    return None
            except (TypeError, ValueError):  # a group that took no part in the match is None
                return None
        try:
            number, channel = float(match["range"]), int(match["channel"]) if self._has_channel else 0
        except (TypeError, ValueError):
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
        self._limits = [(reader_of(x, n, "limits", whole=x.mask >= 0), x) for x in form.limits]
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
            number = self._channel[0].unpack_from(frame, self._channel[1])[0]
            if not 0 <= number < 8:  # nor is NaN
                return None
            channel = int(number)
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
