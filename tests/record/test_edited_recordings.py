"""Recordings that another program wrote, edited or joined: right checksums, wrong contents."""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from mcap.writer import CompressionType, Writer

from surffollow.cli.plot import plot_command
from surffollow.cli.replay import report_text
from surffollow.errors import RecordingError
from surffollow.record import replay as replay_module
from surffollow.record.convert import convert
from surffollow.record.format import (
    MESSAGE_ENCODING,
    RECOVERED_NAME,
    SCHEMA_ENCODING,
    SCHEMA_NAME,
    SUMMARY_NAME,
    TOPIC,
    layout_description,
)
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
DAMAGE = {"damage": "the chunk at byte 9 is damaged"}
REFERENCE = 2 + PARAMS_WORDS + FollowState.offset("adaptive", "beams", "reference") // 8
POSES = 2 + PARAMS_WORDS + FollowState.offset("sense", "pose_count") // 8


def rewritten(
    path: Path, change: Callable[[Batches], Batches], recovered: dict[str, str] | None = None
) -> Path:
    """The recording with changed messages and right checksums; `recovered`: as `recover` would write it."""
    with RecordingReader(path) as reader:
        batches = [(b, np.frombuffer(bytes(b.words), np.int64).copy()) for b in reader.batches()]
        summary = reader.summary
    out = path.with_name("edited.mcap")
    with RecordingWriter(out, force=True) as writer:
        for b, words in change(batches):
            writer.add_batch(b.segment, b.epoch, b.position, b.cycles, words, 0, 0)
        if recovered is not None:
            writer._mcap.add_metadata(RECOVERED_NAME, recovered)
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


MISSING, BACK = "of the log are missing", "repeated, out of order, or of another run"


@pytest.mark.parametrize(
    ("change", "says", "played"),
    [(lost, MISSING, MISSING), (repeated, BACK, BACK), (turned_round, MISSING, BACK)],
)
def test_messages_that_are_lost_repeated_or_turned_round_are_named_by_every_reader(
    make_recording: Callable[..., Path], change: Callable[[Batches], Batches], says: str, played: str
) -> None:
    path = rewritten(make_recording(cycles=1500), change)
    report = replay_file(path)
    assert says in report.damage
    assert not report.identical
    for read in (load_recorded_inputs, rebuild_map):
        with pytest.raises(RecordingError, match=f"{played}.*no checksum is wrong: the file was edited"):
            read(path)


def again_as_another(batches: Batches) -> Batches:
    """The last messages once more, as a segment of their own."""
    return batches + [(b._replace(segment=1), words) for b, words in batches[-3:]]


def segments_turned_round(batches: Batches) -> Batches:
    segments = [(b._replace(segment=k, epoch=9 - k), words) for k in (0, 1) for b, words in batches]
    return segments[len(batches) :] + segments[: len(batches)]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (repeated, BACK),
        (turned_round, BACK),
        (again_as_another, BACK),
        (segments_turned_round, "segment 0 comes behind segment 1"),
        (with_head(0, 3), "begins no entry"),
    ],
)
def test_a_recovered_recording_that_was_edited_is_not_played(
    make_recording: Callable[..., Path], change: Callable[[Batches], Batches], says: str
) -> None:
    # GIVEN a recovered recording that lacks messages
    def lacking(batches: Batches) -> Batches:
        return change(lost(batches))

    made = make_recording(cycles=1500, snapshot_cycles=500)
    load_recorded_inputs(rewritten(made, lost, DAMAGE))
    # WHEN it was edited, too, THEN it is refused
    path = rewritten(made, lacking, DAMAGE)
    for read in (load_recorded_inputs, rebuild_map):
        with pytest.raises(RecordingError, match=f"{says}.*no checksum is wrong: the file was edited"):
            read(path)


def test_a_segment_whose_front_is_lost_is_played_from_its_first_snapshot_on(
    make_recording: Callable[..., Path],
) -> None:
    made = make_recording(cycles=1500, snapshot_cycles=500)
    path = rewritten(made, lambda batches: batches[2:], DAMAGE)
    inputs, report = load_recorded_inputs(path), replay_file(path)
    [part] = inputs.left_out
    assert report.left_out == rebuild_map(path).left_out == [part]
    assert 0 < part.first_cycle < part.last_cycle == 499
    assert inputs.conversion.size == 25 * report.cycles == 25 * 1000


def test_a_recovered_recording_without_a_snapshot_is_refused(make_recording: Callable[..., Path]) -> None:
    path = rewritten(make_recording(cycles=900), lambda batches: batches[1:], DAMAGE)
    for read in (load_recorded_inputs, rebuild_map):
        with pytest.raises(
            RecordingError, match=r"not begin with a snapshot, and no snapshot follows.*record the"
        ):
            read(path)


def test_a_gap_without_damage_is_not_played_behind_a_recover_either(
    make_recording: Callable[..., Path],
) -> None:
    path = recover(rewritten(make_recording(cycles=1500), lost)).file
    with pytest.raises(RecordingError, match=f"{MISSING}.*the file was edited"):
        load_recorded_inputs(path)


@pytest.mark.parametrize(
    ("word", "value"),
    [(REFERENCE, -9), (REFERENCE, 8), (REFERENCE, 1 << 40), (POSES, -1), (POSES, 2**63 - 1)],
)
def test_a_state_that_leads_a_kernel_out_of_its_arrays_or_its_time_is_not_stepped(
    make_recording: Callable[..., Path], word: int, value: int
) -> None:
    def change(batches: Batches) -> Batches:
        words, at = first(batches, SNAPSHOT)
        words[at + word] = value
        return batches

    path = rewritten(make_recording(cycles=600, mode=1, channels=4), change)
    with pytest.raises(RecordingError, match=r"begins no entry"):
        replay_file(path)
    with pytest.raises(RecordingError, match="cannot be mapped"):
        rebuild_map(path)
    with pytest.raises(RecordingError, match=r"no whole cycle|no cycle"):
        convert([path], "csv", path.with_suffix(".csv"), force=True)


def by_hand(
    path: Path, schema: bytes, messages: list[bytes], metadata: dict[str, dict[str, str]] | None = None
) -> Path:
    """A recording made with a public library."""
    with open(path, "wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, enable_data_crcs=True)
        writer.start("x", "x")
        number = writer.register_schema(SCHEMA_NAME, SCHEMA_ENCODING, schema)
        channel = writer.register_channel(TOPIC, MESSAGE_ENCODING, number)
        for data in messages:
            writer.add_message(channel, 0, data, 0)
        for name, values in (metadata or {}).items():
            writer.add_metadata(name, values)
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


def test_a_layout_record_that_is_nested_too_deeply_is_named(tmp_path: Path) -> None:
    path = by_hand(tmp_path / "x.mcap", b'{"format":' + b"[" * 100_000, [bytes(32)])
    with pytest.raises(RecordingError, match="layout record cannot be read"):
        replay_file(path)


def test_texts_and_numbers_that_the_author_of_a_file_chose_do_no_harm(
    make_recording: Callable[..., Path],
) -> None:
    # GIVEN a recording with control characters in its texts and counts that are none
    with RecordingReader(make_recording(cycles=600)) as reader:
        messages = [
            struct.pack("<4q", b.segment, b.epoch, b.position, b.cycles) + bytes(b.words)
            for b in reader.batches()
        ]
        summary = reader.summary | {"lost_cycles": "²", "lost_words": "9" * 5000, "lost_bytes": "²"}
    layout = json.loads(layout_description()) | {"surffollow": "1\x1b[2J", "machine": "m\x1b[2J"}
    metadata = {SUMMARY_NAME: summary, RECOVERED_NAME: {"damage": "cut\x1b[2J"}}
    path = by_hand(reader.path.with_name("x.mcap"), json.dumps(layout).encode(), messages, metadata)
    # WHEN it is replayed, THEN they are shown without effect, or not taken
    report = replay_file(path)
    assert (report.cycles, report.lost_cycles, report.lost_words, report.lost_bytes) == (600, 0, 0, 0)
    shown = report_text("x.mcap", report)
    assert "\x1b" not in shown
    assert all(f"{text}\\x1b[2J" in shown for text in ("surffollow 1", "on m", "cut"))


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


def test_a_pipe_is_no_recording_and_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the kernels of a replay take a minute to compile
    monkeypatch.setattr(replay_module, "warm_up", lambda: pytest.fail("kernels were compiled for nothing"))
    os.mkfifo(tmp_path / "run.mcap")
    done = CliRunner().invoke(plot_command, [str(tmp_path / "run.mcap")])
    with pytest.raises(RecordingError, match="is a pipe, no plain file"):
        raise done.exception or AssertionError(done.output)
    with pytest.raises(
        RecordingError, match="is a pipe, no plain file; write what comes out of it to a file first"
    ):
        replay_file(tmp_path / "run.mcap")
