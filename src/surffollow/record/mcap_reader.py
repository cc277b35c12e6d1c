"""Read an MCAP file back, whole or damaged: records by their lengths, checked by their checksums.

A file with all its checksums in place is checked once, as stored; any other file is
salvaged chunk by chunk, and what was lost is counted. Nothing damaged is ever handed on.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]

from surffollow.config.input_file import check_plain_file
from surffollow.errors import RecordingError
from surffollow.shm.closing import Closing

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, METADATA, DATA_END = 2, 3, 4, 5, 6, 12, 15
_LAST_OPCODE = 15
_RECORD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
MESSAGE_HEAD = struct.Struct("<HIQQ")
_FOOTER_BODY = struct.Struct("<QQI")
_TAIL_BYTES = _RECORD.size + _FOOTER_BODY.size + len(MAGIC)
_DATA_END = struct.Struct("<BQI")
_CRC_BLOCK = 1 << 20
# our chunks are 128 KiB plus one message; more is damage, not data
_MAX_CHUNK_BYTES = 64 << 20
_LZ4_BLOCK_BYTES = 1 << 16  # of our chunks


@dataclass
class Damage:
    """Damage of a file; all zero and empty without damage."""

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


class McapReader(Closing):
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
            check_plain_file(self.path, RecordingError)
            self._file: Any = open(self.path, "rb")  # noqa: SIM115 - closed by close()
            self._size = self._file.seek(0, os.SEEK_END)
            begins = self._read(0, len(MAGIC))
        except OSError as e:
            raise RecordingError(f"cannot read recording {self.path}: {e.strerror}") from None
        if begins != MAGIC:
            raise RecordingError(
                f"{self.path} is no recording: it does not begin with the MCAP mark "
                "(replay and plot read a CSV log, whose name ends in .csv, with --columns)"
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
            self.damage.add(
                "the file ends early: its end mark is missing (still being recorded, recorder killed, or cut)"
            )
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
                if not self._sound:
                    self._look_behind(at)
                return
            if opcode == CHUNK:
                yield from self._chunk(memoryview(self._read(at + _RECORD.size, length)), at)
            elif self._sound:
                # outside chunks only the checksum over the file vouches for a record
                yield opcode, memoryview(self._read(at + _RECORD.size, length))
            self.at = at = end
        if at < size:
            self.damage.add(f"the last {size - at} bytes are lost", lost_bytes=size - at)

    def _look_behind(self, at: int) -> None:
        """Name what was appended to the file, such as another recording (`cat a.mcap b.mcap`)."""
        for start in range(at, self._size, _CRC_BLOCK):
            found = self._read(start, _CRC_BLOCK + len(MAGIC) - 1).find(MAGIC)
            if found >= 0:
                end = start + found + len(MAGIC)
                if end < self._size:
                    own = f"; they are a file of their own: tail -c +{end + 1} {self.path.name}"
                    self.damage.add(
                        f"{self._size - end} bytes follow its end and are not read"
                        + (own if self._read(end, len(MAGIC)) == MAGIC else ""),
                        lost_bytes=self._size - end,
                    )
                return

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
        if len(packed) != length or unpacked > _MAX_CHUNK_BYTES:
            raise ValueError("its sizes do not agree")
        if compression == "lz4":
            # a decompressor of a set limit: a crafted chunk cannot fill the memory. Where there is room for a
            # whole block more it unpacks the last one in place
            lz = lz4.frame.LZ4FrameDecompressor()
            records = lz.decompress(packed, max_length=unpacked + _LZ4_BLOCK_BYTES) if length else b""
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
