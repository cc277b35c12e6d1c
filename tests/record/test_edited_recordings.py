"""Recordings that another program wrote, edited or joined: right checksums, wrong contents."""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from surffollow.errors import RecordingError
from surffollow.record.convert import convert
from surffollow.record.format import MESSAGE_ENCODING, SCHEMA_ENCODING, SCHEMA_NAME, TOPIC, layout_description
from surffollow.record.map_rebuild import rebuild_map
from surffollow.record.reader import Batch, RecordingReader
from surffollow.record.recorded_inputs import load_recorded_inputs
from surffollow.record.recording_writer import RecordingWriter
from surffollow.record.recover import recover
from surffollow.record.replay import replay_file
from surffollow.shm.journal import (
    CYCLE,
    MAP,
    PARAMS,
    PARAMS_WORDS,
    SNAPSHOT,
    STOP,
    entry_head,
    entry_kind,
    entry_words,
)
from surffollow.shm.layout_follow import FollowState

Batches = list[tuple[Batch, np.ndarray]]
REFERENCE = 2 + PARAMS_WORDS + FollowState.offset("adaptive", "beams", "reference") // 8


def rewritten(path: Path, change: Callable[[Batches], Batches]) -> Path:
    """The recording with changed messages and right checksums."""
    with RecordingReader(path) as reader:
        batches = [(b, np.frombuffer(bytes(b.words), np.int64).copy()) for b in reader.batches()]
        summary = reader.summary
    out = path.with_name("edited.mcap")
    with RecordingWriter(out, force=True) as writer:
        for b, words in change(batches):
            writer.add_batch(b.segment, b.epoch, b.position, b.cycles, words, 0, 0)
        writer.finish(summary)
    return out


def first(batches: Batches, kind: int, skip: int = 0) -> tuple[np.ndarray, int]:
    """Words and index of an entry of a kind."""
    for _, words in batches:
        at = 0
        while at < words.size:
            if entry_kind(words[at]) == kind:
                if skip == 0:
                    return words, at
                skip -= 1
            at += int(entry_words(words[at]))
    raise AssertionError(f"no entry of kind {kind}")


def with_head(kind: int, length: int) -> Callable[[Batches], Batches]:
    """Writes the first word of an entry over that of a cycle in the middle."""

    def change(batches: Batches) -> Batches:
        words, at = first(batches, CYCLE, skip=450)
        words[at] = entry_head(kind, length)
        return batches

    return change


def with_end(kind: int, length: int) -> Callable[[Batches], Batches]:
    """Appends a word that begins an entry, and nothing else of it."""

    def change(batches: Batches) -> Batches:
        last, words = batches[-1]
        return [*batches[:-1], (last, np.append(words, entry_head(kind, length)))]

    return change


@pytest.mark.parametrize("kind", [CYCLE, SNAPSHOT, PARAMS, MAP, STOP, 0, 99])
@pytest.mark.parametrize("length", [0, 1, 2, 3, 0xFFFFFF])
@pytest.mark.parametrize("place", [with_head, with_end])
def test_an_entry_of_a_wrong_length_ends_every_reader_in_one_line(
    make_recording: Callable[..., Path], kind: int, length: int, place: Callable[..., Any]
) -> None:
    path = rewritten(make_recording(cycles=600, mode=1), place(kind, length))
    if (kind, length, place) != (STOP, 3, with_head):  # a whole entry: what follows it is none
        assert "begins no entry" in replay_file(path).damage
    with pytest.raises(RecordingError, match=r"cannot be played: .* replay it without --live"):
        load_recorded_inputs(path)
    with pytest.raises(RecordingError, match="cannot be mapped: "):
        rebuild_map(path)
    assert convert([path], "foxglove", path.with_suffix(".foxglove.mcap"), force=True).damage


def lost(batches: Batches) -> Batches:
    return batches[:3] + batches[4:]


def repeated(batches: Batches) -> Batches:
    return batches[:3] + batches[2:]


def turned_round(batches: Batches) -> Batches:
    return [batches[0], batches[2], batches[1], *batches[3:]]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lost, "of the log are missing"),
        (repeated, "repeated, out of order, or of another run"),
        (turned_round, "of the log are missing"),
    ],
)
def test_messages_that_are_lost_repeated_or_turned_round_are_named_by_every_reader(
    make_recording: Callable[..., Path], change: Callable[[Batches], Batches], says: str
) -> None:
    path = rewritten(make_recording(cycles=1500), change)
    report = replay_file(path)
    assert says in report.damage
    assert not report.identical
    with pytest.raises(RecordingError, match=says):
        load_recorded_inputs(path)
    with pytest.raises(RecordingError, match=says):
        rebuild_map(path)


@pytest.mark.parametrize("reference", [-9, 8, 1 << 40])
def test_a_state_that_leads_a_kernel_out_of_its_arrays_is_not_stepped(
    make_recording: Callable[..., Path], reference: int
) -> None:
    def change(batches: Batches) -> Batches:
        words, at = first(batches, SNAPSHOT)
        words[at + REFERENCE] = reference
        return batches

    path = rewritten(make_recording(cycles=600, mode=1, channels=4), change)
    with pytest.raises(RecordingError, match=r"begins no entry"):
        replay_file(path)
    with pytest.raises(RecordingError, match="cannot be mapped"):
        rebuild_map(path)
    with pytest.raises(RecordingError, match=r"no whole cycle|no cycle"):
        convert([path], "csv", path.with_suffix(".csv"), force=True)


def by_hand(path: Path, schema: bytes, messages: list[bytes]) -> Path:
    """A recording made with a public library."""
    with open(path, "wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, enable_data_crcs=True)
        writer.start("x", "x")
        number = writer.register_schema(SCHEMA_NAME, SCHEMA_ENCODING, schema)
        channel = writer.register_channel(TOPIC, MESSAGE_ENCODING, number)
        for data in messages:
            writer.add_message(channel, 0, data, 0)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("about", [], "layout record cannot be read; .* take the original file"),
        ("about", {"period_ns": 7}, "layout record cannot be read"),
        ("byteorder", "big", "machine of byte order big, and this one has little; replay it on such a"),
        ("hashes", [], "with another layout of"),
        ("format", 2, "recording of format 2; .* replay it with surffollow"),
    ],
)
def test_a_layout_record_of_another_machine_or_program_is_named(
    tmp_path: Path, key: str, value: object, says: str
) -> None:
    layout = json.loads(layout_description()) | {key: value}
    path = by_hand(tmp_path / "x.mcap", json.dumps(layout).encode(), [bytes(32)])
    with pytest.raises(RecordingError, match=says):
        replay_file(path)


@pytest.mark.parametrize("text", ["", "abc", "0", "-5", "9" * 30])
def test_a_period_that_is_none_is_the_usual_one(tmp_path: Path, text: str) -> None:
    path = by_hand(tmp_path / "x.mcap", layout_description({"period_ns": text}), [bytes(32)])
    with RecordingReader(path) as reader:
        assert reader.period_ns == 1_000_000


def test_a_message_without_its_head_is_counted_as_lost(make_recording: Callable[..., Path]) -> None:
    # GIVEN a file whose last chunk holds a message record of one byte
    path = make_recording(cycles=600)
    whole = path.read_bytes()
    record = b"\x05" + (1).to_bytes(8, "little") + b"\x01"
    body = b"".join(
        (
            bytes(16),
            len(record).to_bytes(8, "little"),
            zlib.crc32(record).to_bytes(4, "little"),
            bytes(4),
            len(record).to_bytes(8, "little"),
            record,
        )
    )
    chunk = b"\x06" + len(body).to_bytes(8, "little") + body
    at = whole.index(b"\x0f" + (4).to_bytes(8, "little"))  # DATA_END
    path.write_bytes(whole[:at] + chunk + whole[at:])
    # WHEN it is read, THEN every reader names it
    assert "a message is cut short" in replay_file(path).damage
    assert "a message is cut short" in recover(path, path.with_name("new.mcap")).damage


def test_a_recording_behind_another_one_in_a_file_is_named_and_counted_as_lost(
    make_recording: Callable[..., Path],
) -> None:
    path = make_recording(cycles=600)
    whole = path.read_bytes()
    path.write_bytes(whole + whole)
    report = replay_file(path)
    assert f"{len(whole)} bytes follow its end and are not read" in report.damage
    assert f"tail -c +{len(whole) + 1} {path.name}" in report.damage
    assert report.lost_bytes == recover(path, path.with_name("new.mcap")).lost_bytes == len(whole)
    # WHEN the remedy is followed, THEN the second one is whole
    path.write_bytes(path.read_bytes()[len(whole) :])
    assert replay_file(path).identical


def test_a_pipe_is_no_recording_and_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "run.mcap")
    with pytest.raises(RecordingError, match="is a pipe; write what comes out of it to a file first"):
        replay_file(tmp_path / "run.mcap")
