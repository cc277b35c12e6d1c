"""Parts of a recording: an MCAP file with runs of the cycle log's own words on one channel.

One schema record holds the layout as JSON, so that a reader without this program can
decode the words; every message begins with a `BatchHead`. Entries are never split.
A run of messages with one segment number and gapless positions is a segment: it
begins with a SNAPSHOT entry and can be replayed by itself.
"""

from __future__ import annotations

import json
import os
import platform
import sys
from typing import Any

from surffollow.release import program_version
from surffollow.shm import journal
from surffollow.shm.layout_follow import FollowState, Inputs, Output, Params
from surffollow.shm.schema import I64, Schema

FORMAT_VERSION = 1
PROFILE = "surffollow"
TOPIC = "surffollow/cycle_log"
SCHEMA_NAME = "surffollow.CycleLog"
SCHEMA_ENCODING = "x-surffollow-layout"
MESSAGE_ENCODING = "x-surffollow-words"
SUMMARY_NAME = "surffollow.summary"
RECOVERED_NAME = "surffollow.recovered"
CLOCK_NAME = "surffollow.clock"
# a killed recorder loses what is in its unfinished chunk: 0.4 s of a 1 kHz service
CHUNK_BYTES = 128 * 1024
# one message per cycle reads back at 0.1 M cycles/s, a hundred at several M/s
BATCH_CYCLES = 100

ENTRY_KINDS = {
    "CYCLE": journal.CYCLE,
    "SNAPSHOT": journal.SNAPSHOT,
    "PARAMS": journal.PARAMS,
    "RESET": journal.RESET,
    "MAP": journal.MAP,
    "STOP": journal.STOP,
}


class BatchHead(Schema):
    """First words of every message."""

    segment = I64(doc="number of the segment in this file, from 0")
    epoch = I64(doc="of the service that wrote the log")
    position = I64(doc="of the first word in that service's log")
    cycles = I64(doc="CYCLE entries in this message")


HEAD_WORDS = BatchHead.SIZE // 8


def _fields(schema: type[Schema]) -> list[list[Any]]:
    return [[name, at // 8, f.code, f.count, f.unit] for name, at, f in schema.walk()]


def layout_hashes() -> dict[str, str]:
    """Hash of every schema that the words are made of, as hexadecimal text."""
    return {s.__name__: f"{s.HASH:016x}" for s in (BatchHead, Params, FollowState, Inputs, Output)}


def layout_description(about: dict[str, str] | None = None) -> bytes:
    """The schema record's JSON: version, machine, hashes, fields as [name, word, type, count, unit]."""
    return json.dumps(
        {
            "format": FORMAT_VERSION,
            "surffollow": program_version(),
            "machine": platform.machine(),
            "byteorder": sys.byteorder,
            "python": platform.python_version(),
            "about": about or {},
            "hashes": layout_hashes(),
            "entry_kinds": ENTRY_KINDS,
            "entries": journal.__doc__,
            "words": {s.__name__: _fields(s) for s in (BatchHead, Params, FollowState)},
        },
        indent=1,
    ).encode()


def name_text(path: str | os.PathLike[str]) -> str:
    """The name of a file as Unicode text; bytes that are no UTF-8 are replaced."""
    return os.fsencode(os.path.basename(path)).decode("utf-8", "replace")
