"""Read a recording back, whole or damaged: MCAP records by their lengths, checked by their checksums.

A file with all its checksums in place is checked once, as stored; any other file is
salvaged chunk by chunk, and what was lost is counted. Nothing damaged is ever handed on.
"""

from __future__ import annotations

import json
import os
import struct
import sys
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import lz4.frame  # type: ignore[import-untyped]

from surffollow.errors import RecordingError
from surffollow.record.format import (
    FORMAT_VERSION,
    HEAD_WORDS,
    SCHEMA_ENCODING,
    SCHEMA_NAME,
    SUMMARY_NAME,
    TOPIC,
    layout_hashes,
    program_version,
)
from surffollow.record.mcap_records import read_channel, read_metadata, read_schema

if TYPE_CHECKING:
    from typing_extensions import Self

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, METADATA, DATA_END = 2, 3, 4, 5, 6, 12, 15
_LAST_OPCODE = 15
_RECORD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
MESSAGE_HEAD = struct.Struct("<HIQQ")
_FOOTER_BODY = struct.Struct("<QQI")
_BATCH_HEAD = struct.Struct(f"<{HEAD_WORDS}q")
_TAIL_BYTES = _RECORD.size + _FOOTER_BODY.size + len(MAGIC)
_DATA_END = struct.Struct("<BQI")
_CRC_BLOCK = 1 << 20
# our chunks are 128 KiB plus one message; more is damage, not data
_CHUNK_MOST = 64 << 20


class Batch(NamedTuple):
    """One message: whole entries of the cycle log."""

    segment: int
    epoch: int
    position: int
    cycles: int
    words: memoryview  # bytes, a multiple of eight


@dataclass
class Damage:
    """What is wrong with a file; all zero and empty when nothing is."""

    reasons: list[str] = field(default_factory=list)
    lost_bytes: int = 0
    lost_chunks: int = 0

    def add(self, reason: str, lost_bytes: int = 0, lost_chunks: int = 0) -> None:
        self.reasons.append(reason)
        self.lost_bytes += lost_bytes
        self.lost_chunks += lost_chunks

    def __bool__(self) -> bool:
        return bool(self.reasons)

    def __str__(self) -> str:
        shown = "; ".join(self.reasons[:3])
        return shown + (f"; and {len(self.reasons) - 3} more" if len(self.reasons) > 3 else "")


class McapReader:
    """An open MCAP file whose chunks may be damaged; iterate `records()`, then look at `damage`.

    Raises
    ------
    RecordingError  not to be opened, or no MCAP file
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.damage = Damage()
        self.at = 0  # how far `records` came [B]
        try:
            self._file: Any = open(self.path, "rb")  # noqa: SIM115 - closed by close()
            self._size = self._file.seek(0, os.SEEK_END)
            begins = self._read(0, len(MAGIC))
        except OSError as e:
            raise RecordingError(f"cannot read recording {self.path}: {e.strerror}") from None
        if begins != MAGIC:
            raise RecordingError(
                f"{self.path} is no recording: it does not begin with the MCAP mark "
                "(a CSV log needs --columns and a name ending in .csv)"
            )
        self._sound = self._check_whole()

    def _read(self, at: int, n: int) -> bytes:
        try:
            self._file.seek(at)
            data: bytes = self._file.read(n)
        except OSError as e:
            raise RecordingError(f"cannot read recording {self.path}: {e.strerror}") from None
        return data

    def _crc(self, at: int, end: int) -> int:
        crc = 0
        for start in range(at, end, _CRC_BLOCK):
            crc = zlib.crc32(self._read(start, min(_CRC_BLOCK, end - start)), crc)
        return crc

    def _check_whole(self) -> bool:
        """Whether end mark, footer and the checksums over every byte of the file are right."""
        start = self._size - _TAIL_BYTES
        tail = self._read(max(start, 0), _TAIL_BYTES)
        if start < len(MAGIC) or not tail.endswith(MAGIC):
            self.damage.add("the file ends early: its end mark is missing (recorder killed, or cut)")
            return False
        opcode, length = _RECORD.unpack_from(tail)
        summary, _, summary_crc = _FOOTER_BODY.unpack_from(tail, _RECORD.size)
        data_end = summary - _DATA_END.size
        if opcode != FOOTER or length != _FOOTER_BODY.size or not len(MAGIC) <= data_end < summary <= start:
            self.damage.add("the footer is damaged")
            return False
        opcode, length, data_crc = _DATA_END.unpack(self._read(data_end, _DATA_END.size))
        if opcode != DATA_END or length != 4 or self._crc(0, data_end) != data_crc:
            self.damage.add("the checksum over the file's data is wrong")
            return False
        if self._crc(summary, self._size - len(MAGIC) - 4) != summary_crc:
            self.damage.add("the checksum over the file's index is wrong")
            return False
        return True

    def records(self) -> Iterator[tuple[int, memoryview]]:
        """The records of the data section, those inside chunks in their places."""
        at, size = len(MAGIC), self._size
        self.at = at
        while at + _RECORD.size <= size:
            head = self._read(at, _RECORD.size)
            opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (0, 0)
            end = at + _RECORD.size + length
            if not 1 <= opcode <= _LAST_OPCODE or end > size:
                what = f"what begins at byte {at} is cut short or no record"
                self.damage.add(f"{what}: the last {size - at} bytes are lost", lost_bytes=size - at)
                return
            if opcode == DATA_END:
                return
            if opcode == CHUNK:
                yield from self._chunk(memoryview(self._read(at + _RECORD.size, length)), at)
            elif self._sound:
                # outside chunks only the checksum over the file vouches for a record
                yield opcode, memoryview(self._read(at + _RECORD.size, length))
            self.at = at = end
        if at < size:
            self.damage.add(f"the last {size - at} bytes are lost", lost_bytes=size - at)

    def _chunk(self, body: memoryview, at: int) -> Iterator[tuple[int, memoryview]]:
        try:
            records = self._unpack(body)
        except (struct.error, ValueError, RuntimeError, EOFError, MemoryError) as e:
            self.damage.add(f"the chunk at byte {at} is damaged ({e})", len(body), 1)
            return
        inner, size = 0, len(records)
        while inner + _RECORD.size <= size:
            opcode, length = _RECORD.unpack_from(records, inner)
            end = inner + _RECORD.size + length
            if end > size:
                break
            yield opcode, records[inner + _RECORD.size : end]
            inner = end
        if inner != size:
            self.damage.add(f"the chunk at byte {at} holds half a record", size - inner)

    def _unpack(self, body: memoryview) -> memoryview:
        _, _, unpacked, crc, name_length = _CHUNK_HEAD.unpack_from(body)
        at = _CHUNK_HEAD.size + name_length
        compression = bytes(body[_CHUNK_HEAD.size : at]).decode("ascii")
        (length,) = struct.unpack_from("<Q", body, at)
        packed = body[at + 8 :]
        if len(packed) != length or unpacked > _CHUNK_MOST:
            raise ValueError("its sizes do not agree")
        if compression == "lz4":
            # a decompressor of a set limit: a crafted chunk cannot fill the memory
            lz = lz4.frame.LZ4FrameDecompressor()
            records = lz.decompress(packed, max_length=unpacked + 1) if length else b""
        elif compression == "":
            records = bytes(packed)
        else:
            raise ValueError(f"compressed with {compression!r}, which recordings do not use")
        if len(records) != unpacked:
            raise ValueError("it does not unpack to its size")
        if not self._sound and zlib.crc32(records) != crc:
            raise ValueError("its checksum is wrong")
        return memoryview(records)

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class RecordingReader(McapReader):
    """An open recording; iterate `batches()`, then look at `damage` and `summary`.

    Attributes
    ----------
    layout : dict     what the schema record says (version, machine, hashes, …)
    summary : dict    what the recorder counted; empty when it was killed
    damage : Damage

    Raises
    ------
    RecordingError  not to be opened, no recording, or of another layout
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__(path)
        self.layout: dict[str, Any] = {}
        self.summary: dict[str, str] = {}
        self._log_channel = -1
        self._find_layout()

    @property
    def about(self) -> dict[str, str]:
        """What the recorder kept about the service: name, period, clocks."""
        return dict(self.layout.get("about", {}))

    @property
    def wall_offset_ns(self) -> int:
        """CLOCK_REALTIME less CLOCK_MONOTONIC; 0: the recording does not say."""
        text = self.about.get("wall_minus_monotonic_ns", "0")
        return int(text) if text.lstrip("-").isdigit() else 0

    def _find_layout(self) -> None:
        found = Damage(list(self.damage.reasons))
        for opcode, body in self.records():
            if opcode == SCHEMA:
                _, name, encoding, text = read_schema(body)
                if name == SCHEMA_NAME and encoding == SCHEMA_ENCODING:
                    self.layout = _check_layout(self.path, text)
            elif opcode == CHANNEL:
                number, _, topic, _, _ = read_channel(body)
                if topic == TOPIC and self.layout:
                    self._log_channel = number
                    break
        if self._log_channel < 0:
            raise RecordingError(
                f"{self.path} is an MCAP file, but no whole recording of the cycle log begins in it"
                + (f" ({self.damage})" if self.damage else "")
            )
        # what this first look stumbled over will be met and counted again
        self.damage = found

    def batches(self) -> Iterator[Batch]:
        """All whole messages of the cycle log, in the order of the file; other channels are passed over."""
        for opcode, body in self.records():
            if opcode == MESSAGE:
                if body[0] | body[1] << 8 != self._log_channel:
                    continue
                size = len(body) - MESSAGE_HEAD.size - _BATCH_HEAD.size
                if size < 0 or size % 8:
                    self.damage.add("a message is not made of whole words", lost_bytes=len(body))
                    continue
                head = _BATCH_HEAD.unpack_from(body, MESSAGE_HEAD.size)
                segment, epoch, position, cycles = head
                words = body[MESSAGE_HEAD.size + _BATCH_HEAD.size :]
                yield Batch(segment, epoch, position, cycles, words)
            elif opcode == METADATA:
                name, values = read_metadata(body)
                if name == SUMMARY_NAME:
                    self.summary = values


def _check_layout(path: Path, text: bytes) -> dict[str, Any]:
    try:
        layout = json.loads(text)
        version, hashes = layout["format"], layout["hashes"]
        made_by = layout.get("surffollow", "unknown")
    except (ValueError, KeyError, TypeError, AttributeError):
        raise RecordingError(f"{path}: the recording's layout record cannot be read") from None
    if version != FORMAT_VERSION:
        raise RecordingError(
            f"{path} is a recording of format {version}; this program ({program_version()}) reads "
            f"{FORMAT_VERSION}; replay it with surffollow {made_by}"
        )
    mine = layout_hashes()
    changed = [name for name in mine if not isinstance(hashes, dict) or hashes.get(name) != mine[name]]
    if changed or layout.get("byteorder") != sys.byteorder:
        raise RecordingError(
            f"{path} was recorded by surffollow {made_by} with another layout of {', '.join(changed)}; "
            f"this is {program_version()}; replay it with the version that recorded it"
        )
    return dict(layout)
