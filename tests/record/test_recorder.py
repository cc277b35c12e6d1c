"""Records that the recorder keeps of a cycle log, and losses that it reports."""

from __future__ import annotations

import errno
import io
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from second_user import NOBODY, needs_root
from surffollow.errors import FaultError, LayoutMismatchError
from surffollow.record import writer as writer_module
from surffollow.record.format import BATCH_CYCLES, SCHEMA_ENCODING, TOPIC
from surffollow.record.mcap_reader import MAGIC
from surffollow.record.reader import RecordingReader
from surffollow.record.recorder import Recorder
from surffollow.record.recording_writer import RecordingWriter
from surffollow.record.replay import replay_file
from surffollow.record.synthetic_log import SyntheticLog
from surffollow.record.writer import MessageWriter
from surffollow.shm.cycle_log import log_head
from surffollow.shm.journal import CYCLE, SNAPSHOT, entry_kind, entry_words
from surffollow.shm.layout_board import LogHead


def words_of(path: Path) -> list[tuple[int, np.ndarray]]:
    with RecordingReader(path) as reader:
        return [(b.segment, np.frombuffer(bytes(b.words), np.int64)) for b in reader.batches()]


def kinds(words: np.ndarray) -> list[int]:
    out, at = [], 0
    while at < words.size:
        out.append(int(entry_kind(words[at])))
        at += int(entry_words(words[at]))
    assert at == words.size, "an entry is split between two messages"
    return out


def test_recording_holds_the_words_of_the_log_unchanged(tmp_path: Path) -> None:
    # GIVEN a log, and a recorder that looks at it now and then
    synthetic_log = SyntheticLog(1 << 20)
    recorder = Recorder(synthetic_log, RecordingWriter(tmp_path / "a.mcap"))
    for _ in range(7):
        synthetic_log.run(311)
        recorder.poll()
    # WHEN the recording is finished, THEN it holds the words of the log
    recorder.finish()
    head = int(log_head(synthetic_log.address))
    logged = synthetic_log.memory[LogHead.SIZE // 8 :][:head]
    kept = np.concatenate([w for _, w in words_of(tmp_path / "a.mcap")])
    np.testing.assert_array_equal(kept, logged)


def test_messages_hold_whole_entries_and_at_least_a_hundred_cycles(
    make_recording: Callable[..., Path],
) -> None:
    batches = words_of(make_recording(cycles=2500))
    counts = [kinds(w).count(CYCLE) for _, w in batches]
    assert sum(counts) == 2500
    assert all(n >= BATCH_CYCLES for n in counts[:-1] if n)
    assert kinds(batches[0][1])[0] == SNAPSHOT


def test_a_log_that_has_gone_around_is_recorded_from_the_next_snapshot_on(tmp_path: Path) -> None:
    # GIVEN a log that has overwritten its beginning
    synthetic_log = SyntheticLog(1 << 15, snapshot_cycles=400)
    synthetic_log.run(1100)
    # WHEN it is recorded
    recorder = Recorder(synthetic_log, RecordingWriter(tmp_path / "a.mcap"))
    for _ in range(20):
        synthetic_log.run(50)
        recorder.poll()
    counts = recorder.finish()
    # THEN the recording begins with the next snapshot, and lacks nothing from there on
    assert counts.cycles == 2100 - 1200
    assert (counts.lost_words, counts.losses, counts.segments) == (0, 0, 1)
    assert replay_file(tmp_path / "a.mcap").identical


def test_after_a_loss_the_recording_resumes_at_a_snapshot_and_counts_what_is_missing(tmp_path: Path) -> None:
    # GIVEN a recorder that follows a log
    synthetic_log = SyntheticLog(1 << 15, snapshot_cycles=400)
    recorder = Recorder(synthetic_log, RecordingWriter(tmp_path / "a.mcap"))
    for _ in range(10):
        synthetic_log.run(50)
        recorder.poll()
    # WHEN it sleeps while the log overwrites what it has not seen
    synthetic_log.run(3333)  # far more than the log holds
    recorder.poll()
    for _ in range(20):
        synthetic_log.run(50)
        recorder.poll()
    # THEN it goes on in a new segment from a snapshot, and counts what it lost
    counts = recorder.finish()
    assert (counts.segments, counts.losses) == (2, 1)
    assert counts.lost_words > 0
    assert counts.cycles + counts.lost_cycles == 500 + 3333 + 1000
    segments = words_of(tmp_path / "a.mcap")
    first_of_second = next(w for s, w in segments if s == 1)
    assert kinds(first_of_second)[0] == SNAPSHOT
    report = replay_file(tmp_path / "a.mcap")
    assert report.identical
    assert (report.segments, report.lost_cycles, report.cycles) == (2, counts.lost_cycles, counts.cycles)


def test_every_cycle_is_recorded_or_counted_as_lost_however_the_polls_fall(tmp_path: Path) -> None:
    for seed in range(6):
        rng = np.random.default_rng(seed)
        synthetic_log = SyntheticLog(1 << 15, snapshot_cycles=int(rng.integers(60, 500)), seed=seed)
        path = tmp_path / f"{seed}.mcap"
        recorder = Recorder(synthetic_log, RecordingWriter(path))
        total = 0
        for _ in range(30):
            n = int(rng.choice([1, 17, 130, 700, 1500], p=[0.2, 0.3, 0.3, 0.1, 0.1]))
            synthetic_log.run(n)
            total += n
            if rng.random() < 0.8:
                recorder.poll()
        for _ in range(8):
            synthetic_log.run(100)
            recorder.poll()
        counts = recorder.finish()
        assert counts.cycles + counts.lost_cycles == total + 800, f"seed {seed}: {counts}"
        assert replay_file(path).identical, f"seed {seed}"


def test_a_restarted_service_begins_a_new_segment(tmp_path: Path) -> None:
    first, second = SyntheticLog(epoch=4), SyntheticLog(epoch=5, seed=9)

    class Source:
        address = property(lambda self: self.now.address)
        capacity = property(lambda self: self.now.capacity)
        epoch = property(lambda self: self.now.epoch)
        now, newer = first, False

        def alive(self) -> bool:
            return not self.newer

        def reattach(self) -> bool:
            if self.newer:
                self.now, self.newer = second, False
                return True
            return False

    source = Source()
    recorder = Recorder(source, RecordingWriter(tmp_path / "a.mcap"))
    first.run(420)
    recorder.poll()
    first.run(13)
    assert not recorder.restart()
    second.run(230)
    source.newer = True
    assert recorder.restart()
    second.run(100)
    counts = recorder.finish()
    assert (counts.cycles, counts.segments, counts.restarts, counts.lost_cycles) == (433 + 330, 2, 1, 0)
    with RecordingReader(tmp_path / "a.mcap") as reader:
        assert {(b.segment, b.epoch) for b in reader.batches()} == {(0, 4), (1, 5)}
    assert replay_file(tmp_path / "a.mcap").identical


def test_any_mcap_reader_opens_the_recording_and_finds_the_layout(
    make_recording: Callable[..., Path],
) -> None:
    with open(make_recording(cycles=1000), "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages = list(reader.iter_messages())
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    schema, channel, message = messages[0]
    assert channel.topic == TOPIC
    assert schema.encoding == SCHEMA_ENCODING
    layout = json.loads(schema.data)
    params = {name: (word, code) for name, word, code, _, _ in layout["words"]["Params"]}
    word, code = params["offset_m"]
    begin = 8 * (len(layout["words"]["BatchHead"]) + 2 + word)
    assert code == "f8"
    assert np.frombuffer(message.data[begin : begin + 8], np.float64)[0] == 0.1
    assert metadata["surffollow.summary"]["cycles"] == "1000"
    offset_ns = int(metadata["surffollow.clock"]["wall_minus_monotonic_ns"])
    assert message.log_time == 1_000_000_000 + offset_ns


def test_a_log_of_another_version_is_refused_and_not_recorded_as_one_long_loss(tmp_path: Path) -> None:
    synthetic_log = SyntheticLog()
    recorder = Recorder(synthetic_log, RecordingWriter(tmp_path / "a.mcap"))

    def record_on() -> None:
        for _ in range(20):
            begin = int(log_head(synthetic_log.address))
            synthetic_log.run(10)
            synthetic_log.memory[LogHead.SIZE // 8 + begin] ^= 1 << 9  # the first entry's length
            recorder.poll()

    with pytest.raises(LayoutMismatchError, match="does not know"):
        record_on()


class FullDisk(io.BytesIO):
    """A file that takes only so many bytes."""

    room = 300_000
    error = errno.ENOSPC

    def write(self, data: bytes) -> int:
        n = min(len(data), self.room - self.tell())
        if n == 0:
            raise OSError(self.error, os.strerror(self.error))
        return super().write(data[:n])

    def close(self) -> None:
        self.kept = self.getvalue()
        super().close()


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (errno.ENOSPC, "the disk is full.*free some space"),
        (errno.EDQUOT, "the disk is full.*free some space"),
        (errno.EFBIG, r"no file may be larger here.*ulimit -f.*--rotate-size"),
    ],
)
def test_a_full_disk_is_reported_and_the_file_stays_readable_up_to_there(
    tmp_path: Path, error: int, says: str
) -> None:
    disk = FullDisk()
    disk.error = error
    synthetic_log = SyntheticLog()
    recorder = Recorder(synthetic_log, RecordingWriter(tmp_path / "a.mcap", stream=disk))

    def record_on() -> None:
        for _ in range(1000):
            synthetic_log.run(100)
            recorder.poll()

    with pytest.raises(FaultError, match=rf"a\.mcap ends after \d+ bytes: {says}"):
        record_on()
    (tmp_path / "a.mcap").write_bytes(disk.kept)
    report = replay_file(tmp_path / "a.mcap")
    assert report.cycles > 1000
    assert report.differing == 0
    assert not report.identical
    assert "ends early" in report.damage


def test_a_disk_that_takes_nothing_leaves_nothing_to_read(tmp_path: Path) -> None:
    with (
        open("/dev/full", "wb", buffering=0) as full,
        pytest.raises(
            FaultError, match="ends after 0 bytes: the disk is full; nothing was recorded; free some"
        ),
    ):
        RecordingWriter(tmp_path / "a.mcap", stream=full)


def test_a_file_of_a_mark_alone_is_no_recording(tmp_path: Path) -> None:
    disk = FullDisk()
    disk.room = 20
    with pytest.raises(FaultError, match="ends after 8 bytes: the disk is full; nothing was recorded"):
        RecordingWriter(tmp_path / "a.mcap", stream=disk)


class FullFile(io.FileIO):
    """A file on a disk that has room for so many bytes."""

    def __init__(self, path: str, mode: str, room: int) -> None:
        super().__init__(path, mode)
        self._room = room

    def write(self, data: Any) -> int:
        if self._room == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written = super().write(bytes(data)[: self._room])
        self._room -= written
        return written


@pytest.mark.parametrize("room", [0, 20])
def test_where_nothing_was_recorded_no_file_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    """The file kept its name from the next recording."""
    path = tmp_path / "a.mcap"
    with monkeypatch.context() as full:
        full.setattr(writer_module, "_opened", lambda path, force: FullFile(path, "wb", room))
        with pytest.raises(FaultError, match="the disk is full; nothing was recorded"):
            RecordingWriter(path)
    assert not path.exists()
    RecordingWriter(path).close()


def test_a_limit_of_the_size_of_what_is_made_of_a_recording_names_no_option_of_record(tmp_path: Path) -> None:
    disk = FullDisk()
    disk.room, disk.error = 0, errno.EFBIG
    with pytest.raises(FaultError, match=r"cannot write .*b\.mcap: .*raise the limit \(ulimit -f\)$"):
        MessageWriter(tmp_path / "a.mcap", stream=disk, target=tmp_path / "b.mcap")


def test_a_recording_that_cannot_be_opened_is_reported_with_its_path(tmp_path: Path) -> None:
    with pytest.raises(FaultError, match="nowhere"):
        RecordingWriter(tmp_path / "nowhere" / "a.mcap")


@pytest.mark.parametrize("force", [False, True])
def test_what_is_no_plain_file_is_refused_at_once(tmp_path: Path, force: bool) -> None:
    pipe = tmp_path / "pipe.mcap"
    os.mkfifo(pipe)
    # opened for reading and writing no process waits, independent of the writer
    end = os.open(pipe, os.O_RDWR)
    try:
        for path in (pipe, Path("/dev/null"), tmp_path):
            with pytest.raises(FaultError, match="no plain file"):
                RecordingWriter(path, force=force)
    finally:
        os.close(end)
    assert pipe.is_fifo()


def test_a_file_that_another_recorder_writes_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path):
        before = path.read_bytes()
        with pytest.raises(FaultError, match=r"another process records into .*a\.mcap; choose another --out"):
            RecordingWriter(path, force=True)
        assert path.read_bytes() == before
    RecordingWriter(path, force=True).close()


def test_a_file_that_is_there_already_is_only_replaced_by_force(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"somebody's work")
    with pytest.raises(FaultError, match=r"exists already.*--force"):
        RecordingWriter(path)
    assert path.read_bytes() == b"somebody's work"
    with RecordingWriter(path, force=True) as writer:
        writer.finish({})
    assert path.read_bytes().startswith(b"\x89MCAP")


@needs_root
def test_force_replaces_no_link_and_no_file_of_another_user_in_a_shared_folder(tmp_path: Path) -> None:
    (tmp_path / "own.mcap").write_text("kept")
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o1777)
    (shared / "link.mcap").symlink_to(tmp_path / "own.mcap")
    (shared / "file.mcap").write_text("theirs")
    for kind in ("link", "file"):
        path = shared / f"{kind}.mcap"
        os.chown(path, NOBODY, NOBODY, follow_symlinks=False)
        # WHEN a recording is to replace it, THEN it is refused
        with pytest.raises(FaultError, match=f"is a {kind} of user {NOBODY}; choose another"):
            RecordingWriter(path, force=True)
    assert (tmp_path / "own.mcap").read_text() == "kept"
    assert (shared / "file.mcap").read_text() == "theirs"
    # one's own links are followed
    (shared / "own.mcap").symlink_to(tmp_path / "own.mcap")
    RecordingWriter(shared / "own.mcap", force=True).finish({})
    assert (tmp_path / "own.mcap").read_bytes().startswith(MAGIC)
