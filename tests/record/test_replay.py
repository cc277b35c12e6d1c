"""Replay gives the live run's bits, and never says so of a file that is not whole."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer

from surffollow.cli.replay import report_text
from surffollow.errors import RecordingError
from surffollow.record.reader import RecordingReader
from surffollow.record.recorder import Recorder
from surffollow.record.recording_writer import RecordingWriter
from surffollow.record.recover import recover
from surffollow.record.replay import replay_file
from surffollow.record.synthetic_log import SyntheticLog
from surffollow.shm.journal import CYCLE, PARAMS_WORDS, SNAPSHOT, entry_kind, entry_words
from surffollow.shm.layout_follow import Params


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 2**31),
    mode=st.sampled_from([0, 1]),
    channels=st.integers(1, 8),
    conversions=st.integers(0, 64),
    snapshot_cycles=st.integers(50, 900),
    step=st.integers(1, 400),
    period_ns=st.sampled_from([100_000, 1_000_000, 4_000_000]),
)
def test_every_recording_replays_with_the_same_bits(tmp_path: Path, step: int, **options: int) -> None:
    synthetic_log = SyntheticLog(**options)
    recorder = Recorder(synthetic_log, RecordingWriter(tmp_path / "log.mcap", force=True))
    for _ in range(max(1, 1200 // step)):
        synthetic_log.run(step)
        recorder.poll()
    counts = recorder.finish()
    report = replay_file(tmp_path / "log.mcap")
    assert report.identical, report
    assert report.cycles == counts.cycles > 0


def rewrite(path: Path, change: Callable[[list[np.ndarray]], None]) -> Path:
    """The recording again with changed words and right checksums, as another program might have logged it."""
    with RecordingReader(path) as reader:
        batches = [(b, np.frombuffer(bytes(b.words), np.int64).copy()) for b in reader.batches()]
        summary = reader.summary
    change([w for _, w in batches])
    out = path.with_name("changed.mcap")
    with RecordingWriter(out, force=True) as writer:
        for b, words in batches:
            writer.add_batch(b.segment, b.epoch, b.position, b.cycles, words, 0, 0)
        writer.finish(summary)
    return out


def entries(batches: list[np.ndarray], kind: int) -> list[np.ndarray]:
    found = []
    for words in batches:
        at = 0
        while at < words.size:
            n = int(entry_words(words[at]))
            if entry_kind(words[at]) == kind:
                found.append(words[at : at + n])
            at += n
    return found


@pytest.mark.parametrize(("word", "what"), [(6, "logged_demand"), (3, "logged_status")])
def test_one_changed_bit_of_a_demand_or_status_is_found(
    make_recording: Callable[..., Path], word: int, what: str
) -> None:
    def change(batches: list[np.ndarray]) -> None:
        entries(batches, CYCLE)[1234][word] ^= 1

    report = replay_file(rewrite(make_recording(), change))
    assert (report.identical, report.differing, report.complete) == (False, 1, True)
    first = report.first_difference
    assert first is not None
    assert (first.segment, first.cycle) == (0, 1234)
    assert getattr(first, what) != getattr(first, what.replace("logged", "replayed"))


def test_an_input_that_was_not_logged_shows_in_the_next_snapshot(make_recording: Callable[..., Path]) -> None:
    def change(batches: list[np.ndarray]) -> None:
        snapshot = entries(batches, SNAPSHOT)[1]
        snapshot[2 + PARAMS_WORDS + 3] ^= 1

    report = replay_file(rewrite(make_recording(), change))
    assert (report.identical, report.differing, report.states_differing) == (False, 0, 1)
    assert report.first_state_difference == 1000


def test_a_missing_message_is_reported(make_recording: Callable[..., Path]) -> None:
    path = make_recording()
    with RecordingReader(path) as reader:
        batches = list(reader.batches())
    out = path.with_name("gap.mcap")
    with RecordingWriter(out, force=True) as writer:
        for b in batches[:12] + batches[13:]:
            writer.add_batch(b[0], b[1], b[2], b[3], np.frombuffer(bytes(b.words), np.int64), 0, 0)
        writer.finish({"cycles": "3000"})
    report = replay_file(out)
    assert not report.identical
    assert not report.complete
    assert "missing" in report.damage


def test_behind_a_damaged_chunk_the_replay_goes_on_at_the_next_snapshot(
    tmp_path: Path, make_recording: Callable[..., Path]
) -> None:
    data = bytearray(make_recording(cycles=6000).read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "bad.mcap").write_bytes(data)
    recovered = recover(tmp_path / "bad.mcap")
    report, again = replay_file(tmp_path / "bad.mcap"), replay_file(recovered.file)
    for r in (report, again):
        assert (r.identical, r.complete, r.differing, r.segments) == (False, False, 0, 2)
        assert r.cycles + r.cycles_not_replayed == 6000
        # a chunk holds some 450 cycles, and a snapshot comes every 1000
        assert 4000 <= r.cycles < 6000
    assert report.cycles == again.cycles
    assert (report.recovered, bool(again.recovered)) == ("", True)
    assert 0 < recovered.cycles - report.cycles < 1000
    text = report_text("bad.mcap", report)
    assert f"{report.cycles_not_replayed} cycles not replayed" in text
    assert "missing" in text


def test_cycles_without_a_snapshot_behind_the_damage_are_counted(make_recording: Callable[..., Path]) -> None:
    path = make_recording(cycles=900)
    with RecordingReader(path) as reader:
        batches = list(reader.batches())
    out = path.with_name("gap.mcap")
    with RecordingWriter(out, force=True) as writer:
        for b in batches[:2] + batches[3:]:
            writer.add_batch(b[0], b[1], b[2], b[3], np.frombuffer(bytes(b.words), np.int64), 0, 0)
        writer.finish({"cycles": "900"})
    report = replay_file(out)
    assert report.cycles == sum(b.cycles for b in batches[:2])
    assert report.cycles + report.cycles_not_replayed == 900


def test_behind_a_word_that_begins_no_entry_the_replay_goes_on_at_the_next_snapshot(
    make_recording: Callable[..., Path],
) -> None:
    def change(batches: list[np.ndarray]) -> None:
        entries(batches, CYCLE)[300][0] = 0

    report = replay_file(rewrite(make_recording(cycles=6000), change))
    assert "begins no entry" in report.damage
    assert report.cycles + report.cycles_not_replayed == 6000
    assert (report.segments, report.differing) == (2, 0)


@pytest.mark.parametrize("name", ["sensor_readings", "ee_readings", "range_size", "n_channels", "mode"])
@pytest.mark.parametrize("value", [-1, 1 << 40])
def test_parameters_no_service_can_have_end_the_replay(
    make_recording: Callable[..., Path], name: str, value: int
) -> None:
    def change(batches: list[np.ndarray]) -> None:
        entries(batches, SNAPSHOT)[0][2 + Params.offset(name) // 8] = value

    with pytest.raises(RecordingError, match="no whole cycle"):
        replay_file(rewrite(make_recording(cycles=500), change))


def test_a_cut_file_replays_what_is_whole_and_is_never_called_identical(
    tmp_path: Path, recording_bytes: bytes
) -> None:
    size = len(recording_bytes)
    rng = np.random.default_rng(5)
    cuts = {*range(0, 60, 7), *range(size - 60, size, 7), *rng.integers(0, size, 80).tolist()}
    path = tmp_path / "cut.mcap"
    cycles = []
    for cut in sorted(cuts):
        path.write_bytes(recording_bytes[:cut])
        try:
            report = replay_file(path)
        except RecordingError:
            cycles.append(0)
            continue
        cycles.append(report.cycles)
        assert not report.identical
        assert not report.complete
        assert report.damage
        assert report.differing == 0
    assert cycles == sorted(cycles), "more of the file must not give fewer cycles"
    assert cycles[-1] == 3000


def test_a_killed_recorder_loses_only_its_last_chunk(tmp_path: Path) -> None:
    synthetic_log = SyntheticLog()
    writer = RecordingWriter(tmp_path / "a.mcap")
    recorder = Recorder(synthetic_log, writer)
    for _ in range(60):
        synthetic_log.run(100)
        recorder.poll()
    # after a kill the kernel has all data: the file is unbuffered
    (tmp_path / "killed.mcap").write_bytes((tmp_path / "a.mcap").read_bytes())
    writer.close()
    report = replay_file(tmp_path / "killed.mcap")
    words_lost = (6000 - report.cycles) * 36
    assert report.cycles < 6000
    assert words_lost * 8 < 2.2 * 128 * 1024
    assert report.differing == 0
    assert not report.identical
    assert "recorder killed" in report.damage


def test_a_changed_byte_anywhere_never_crashes_and_is_never_called_identical(
    tmp_path: Path, recording_bytes: bytes
) -> None:
    size = len(recording_bytes)
    rng = np.random.default_rng(11)
    places = {*range(0, 80), *range(size - 400, size), *rng.integers(0, size, 250).tolist()}
    path = tmp_path / "bad.mcap"
    data = bytearray(recording_bytes)
    for place in sorted(places):
        old = data[place]
        data[place] = old ^ int(rng.integers(1, 256))
        path.write_bytes(data)
        data[place] = old
        try:
            report = replay_file(path)
        except RecordingError:
            continue
        assert not report.identical, place
        assert report.damage, place
        assert report.differing == 0, f"damaged words reached the kernels (byte {place})"


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_scrambled_files_are_refused_or_reported(
    tmp_path: Path, recording_bytes: bytes, data: st.DataObject
) -> None:
    scrambled = bytearray(recording_bytes)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(scrambled) - 1))
        new = data.draw(st.binary(min_size=1, max_size=40))
        scrambled[at : at + data.draw(st.integers(0, 60))] = new
    path = tmp_path / "bad.mcap"
    path.write_bytes(scrambled)
    try:
        report = replay_file(path)
    except RecordingError:
        return
    assert not report.identical or bytes(scrambled) == recording_bytes


def test_alien_files_are_refused_with_their_names(tmp_path: Path) -> None:
    path = tmp_path / "alien"
    for text in (b"", b"t_s,range_m\n0,1\n", b"\x89MCAP0\r\n"):
        path.write_bytes(text)
        with pytest.raises(RecordingError, match="alien"):
            replay_file(path)
    path.write_bytes(b"t_s,range_m\n0,1\n")
    with pytest.raises(RecordingError, match=r"is no recording.*replay and plot read a CSV log"):
        recover(path)
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("camera", "json", 0)
        writer.add_message(channel, 0, b"{}", 0)
        writer.finish()
    with pytest.raises(RecordingError, match="no whole recording"):
        replay_file(path)
    with pytest.raises(RecordingError, match="cannot read"):
        replay_file(tmp_path / "absent.mcap")
    with pytest.raises(RecordingError, match="is a folder"):
        replay_file(tmp_path)


def test_a_recording_of_another_layout_is_refused_with_the_version_that_can_read_it(
    make_recording: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = make_recording(cycles=200)
    from surffollow.record import reader

    monkeypatch.setattr(reader, "layout_hashes", lambda: {"Params": "0"})
    with pytest.raises(RecordingError, match="another layout of Params"):
        replay_file(path)


def test_a_time_constant_at_the_end_of_its_range_is_noted(tmp_path: Path) -> None:
    # GIVEN two recordings of followers; one has learned that its axis is much slower than configured
    for learned, is_noted in ((1.0, False), (3.3, True)):
        before, log, path = SyntheticLog(mode=1), SyntheticLog(mode=1), tmp_path / f"{is_noted}.mcap"
        before.run(1000)
        log.state[:], log.plan[0] = before.state, 1000
        log.state[0]["adaptive"]["plant"]["tau_s"] *= learned
        recorder = Recorder(log, RecordingWriter(path))
        log.run(300)
        recorder.poll()
        recorder.finish()
        # WHEN they are replayed THEN the report and its text say so of the second
        report = replay_file(path)
        assert report.identical
        assert ("is at an end of what is learned" in report.note) == is_noted
        assert ("note: the learned time constant of the axis, 132 ms" in report_text("x", report)) == is_noted
