"""Read a recording's cycle log back; what was lost is counted, nothing damaged is ever handed on."""

from __future__ import annotations

import json
import re
import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from surffollow.errors import RecordingError
from surffollow.record.format import (
    FORMAT_VERSION,
    HEAD_WORDS,
    RECOVERED_NAME,
    SCHEMA_ENCODING,
    SCHEMA_NAME,
    SUMMARY_NAME,
    TOPIC,
    layout_hashes,
)
from surffollow.record.mcap_reader import CHANNEL, MESSAGE, MESSAGE_HEAD, METADATA, SCHEMA, Damage, McapReader
from surffollow.record.mcap_records import read_channel, read_metadata, read_schema
from surffollow.release import program_version

DEFAULT_PERIOD_NS = 1_000_000
_NUMBER = re.compile("-?[0-9]{1,19}")
_LARGEST = 1 << 62  # of a time [ns]
_BATCH_HEAD = struct.Struct(f"<{HEAD_WORDS}q")


class Batch(NamedTuple):
    """One message: whole entries of the cycle log."""

    segment: int
    epoch: int
    position: int
    cycles: int
    words: memoryview  # bytes, a multiple of eight


class RecordingReader(McapReader):
    """An open recording; iterate `batches()`, then look at `damage` and `summary`.

    Attributes
    ----------
    layout : dict     what the schema record says (version, machine, hashes, …)
    summary : dict    what the recorder counted; empty when it was killed
    damage : Damage
    recovered : dict  what `recover` lost when it wrote this file; empty: it did not

    Raises
    ------
    RecordingError  not to be opened, no recording, or of another layout
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__(path)
        self.layout: dict[str, Any] = {}
        self.summary: dict[str, str] = {}
        self.recovered: dict[str, str] = {}
        self._log_channel = -1
        self._find_layout()

    @property
    def about(self) -> dict[str, str]:
        """Description of the service by the recorder: name, period, clocks."""
        return dict(self.layout.get("about", {}))

    @property
    def wall_offset_ns(self) -> int:
        """CLOCK_REALTIME less CLOCK_MONOTONIC; 0: the recording does not say."""
        return self._about_number("wall_minus_monotonic_ns", 0)

    @property
    def period_ns(self) -> int:
        """The recorded service's cycle; 1 ms: the recording does not say."""
        period_ns = self._about_number("period_ns", DEFAULT_PERIOD_NS)
        return period_ns if period_ns > 0 else DEFAULT_PERIOD_NS

    def _about_number(self, key: str, default: int) -> int:
        """A number of `about`, or the default when it holds none that can be a time."""
        text = self.about.get(key, "")
        return int(text) if _NUMBER.fullmatch(text) and abs(int(text)) < _LARGEST else default

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
        # damage met in this first look will be met and counted again
        self.damage = found

    def batches(self) -> Iterator[Batch]:
        """All whole messages of the cycle log, in the order of the file; other channels are passed over."""
        self.recovered = {}
        for opcode, body in self.records():
            if opcode == MESSAGE:
                if len(body) < MESSAGE_HEAD.size:
                    self.damage.add("a message is cut short", lost_bytes=len(body))
                    continue
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
                elif name == RECOVERED_NAME:  # one for each time
                    damage = filter(None, (self.recovered.get("damage"), values.get("damage")))
                    self.recovered = values | {"damage": "; ".join(damage)}


def missing_words(expected: int, position: int) -> str:
    """Words of a log that do not follow those before: a text for messages.

    Parameters
    ----------
    expected, position : int   of the word that should have come, and of the one that came
    """
    if position > expected:
        return f"words {expected} to {position} of the log are missing"
    return (
        f"behind word {expected} of the log comes word {position}: repeated, out of order, or of another run"
    )


def _check_layout(path: Path, text: bytes) -> dict[str, Any]:
    try:
        layout = json.loads(text)
        version, hashes = layout["format"], layout["hashes"]
        made_by = layout.get("surffollow", "unknown")
        about = layout.setdefault("about", {})
        texts = isinstance(about, dict) and all(isinstance(v, str) for v in about.values())
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        texts = False
    if not texts:
        raise RecordingError(
            f"{path}: the recording's layout record cannot be read; it was edited or written by another "
            "program: record the run again, or take the original file"
        )
    if version != FORMAT_VERSION:
        raise RecordingError(
            f"{path} is a recording of format {version}; this program ({program_version()}) reads "
            f"{FORMAT_VERSION}; replay it with surffollow {made_by}"
        )
    mine = layout_hashes()
    changed = [name for name in mine if not isinstance(hashes, dict) or hashes.get(name) != mine[name]]
    if layout.get("byteorder") != sys.byteorder:
        raise RecordingError(
            f"{path} was recorded on a machine of byte order {layout.get('byteorder')}, and this one has "
            f"{sys.byteorder}; replay it on such a machine"
        )
    if changed:
        raise RecordingError(
            f"{path} was recorded by surffollow {made_by} with another layout of {', '.join(changed)}; "
            f"this is {program_version()}; replay it with the version that recorded it"
        )
    return dict(layout)
