"""Rewrite what is whole of a cut or damaged MCAP file into one that every reader opens."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from mcap.writer import CompressionType, Writer

from surffollow.errors import FaultError, RecordingError
from surffollow.map.formats.atomic_file import check_not_read, replacing
from surffollow.record.format import (
    CHUNK_BYTES,
    HEAD_WORDS,
    RECOVERED_NAME,
    SUMMARY_NAME,
    TOPIC,
    name_text,
)
from surffollow.record.mcap_reader import CHANNEL, MESSAGE, MESSAGE_HEAD, METADATA, SCHEMA, McapReader
from surffollow.record.mcap_records import read_channel, read_metadata, read_schema

_CYCLES_AT = MESSAGE_HEAD.size + 8 * (HEAD_WORDS - 1)


@dataclass
class Recovered:
    """Contents of the new file, and damage of the old one."""

    file: str = ""
    messages: int = 0
    cycles: int = 0
    segments: int = 0
    lost_bytes: int = 0
    damage: str = ""


def recover(path: str | Path, out: str | Path | None = None, *, force: bool = False) -> Recovered:
    """Write the messages of all whole chunks into a new file with indexes and an end.

    A recording's summary is counted anew; the metadata record `surffollow.recovered` says what was lost.

    Parameters
    ----------
    path : a recording, or any other MCAP file with LZ4 or uncompressed chunks
    out : default: NAME-recovered.mcap
    force : replace an existing file

    Raises
    ------
    RecordingError  no MCAP file, or no whole message in it
    UsageError      the output is the file itself
    FaultError      the output exists already, or cannot be written
    """
    path = Path(path)
    # of a folder without a name such as "." the reader says what it is
    target = path.parent / f"{path.stem}-recovered{path.suffix}" if out is None else Path(out)
    check_not_read(target, path)
    if os.path.exists(target) and not force:
        raise FaultError(f"{target} exists already; choose another --out, or replace it with --force")
    done = Recovered(str(target))
    with McapReader(path) as reader, replacing(target) as temporary, open(temporary, "wb") as stream:
        writer = Writer(
            stream, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4, enable_data_crcs=True
        )
        writer.start("surffollow", "surffollow recover")
        _copy(reader, writer, done)
        if done.messages == 0:
            raise RecordingError(
                f"{path} holds no whole message" + (f" ({reader.damage})" if reader.damage else "")
            )
        done.lost_bytes, done.damage = reader.damage.lost_bytes, str(reader.damage)
        said = {"from": name_text(path), "damage": done.damage, "lost_bytes": str(done.lost_bytes)}
        writer.add_metadata(RECOVERED_NAME, said)
        if done.cycles:
            counts = {"cycles": done.cycles, "segments": done.segments, "lost_bytes": done.lost_bytes}
            writer.add_metadata(SUMMARY_NAME, {k: str(v) for k, v in counts.items()})
        writer.finish()  # type: ignore[no-untyped-call]
    return done


def _copy(reader: McapReader, writer: Writer, done: Recovered) -> None:
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, tuple[int, str]] = {}
    segments = set()
    for opcode, body in reader.records():
        if opcode == SCHEMA:
            number, name, encoding, text = read_schema(body)
            if name and number not in schemas:
                schemas[number] = writer.register_schema(name, encoding, text)
        elif opcode == CHANNEL:
            number, schema, topic, encoding, about = read_channel(body)
            if topic and number not in channels and schema in schemas:
                made = writer.register_channel(topic, encoding, schemas[schema], about)
                channels[number] = made, topic
        elif opcode == MESSAGE:
            if len(body) < MESSAGE_HEAD.size:
                reader.damage.add("a message is cut short", lost_bytes=len(body))
                continue
            number, sequence, log_ns, publish_ns = MESSAGE_HEAD.unpack_from(body)
            if number not in channels:
                continue  # declared in a chunk that is lost
            channel, topic = channels[number]
            data = bytes(body[MESSAGE_HEAD.size :])
            writer.add_message(channel, log_ns, data, publish_ns, sequence)
            done.messages += 1
            if topic == TOPIC and len(body) >= _CYCLES_AT + 8:
                done.cycles += int.from_bytes(body[_CYCLES_AT : _CYCLES_AT + 8], "little")
                segments.add(bytes(body[MESSAGE_HEAD.size : MESSAGE_HEAD.size + 8]))
        elif opcode == METADATA:
            name, values = read_metadata(body)
            if name and name != SUMMARY_NAME:
                writer.add_metadata(name, values)
    done.segments = len(segments)
