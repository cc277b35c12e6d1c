"""Recovered recordings that lack cycles: what `replay --live` plays of them, and what it says of the rest."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from running_service import config_text, drive, over_ground, run_command, unique_name
from surffollow.errors import RecordingError
from surffollow.record.left_out import LeftOut, listed
from surffollow.record.map_rebuild import rebuild_map
from surffollow.record.reader import RecordingReader
from surffollow.record.recorded_inputs import SEGMENT_GAP_NS, load_recorded_inputs
from surffollow.record.recover import recover
from surffollow.record.replay import replay_file
from surffollow.shm.conversion import conversion_dt_ns
from surffollow.shm.journal import CYCLE, CYCLE_HEAD, entry_kind, entry_words

PER_CYCLE = 25  # conversions of a synthetic log


def conversions_of(path: Path, left_out: list[LeftOut]) -> list[tuple[int, int]]:
    """Cycle and word of each conversion in the file, but for cycles that are left out."""
    with RecordingReader(path) as reader:
        words = np.concatenate([np.frombuffer(bytes(b.words), np.int64) for b in reader.batches()])
    out, at = [], 0
    while at < words.size:
        if entry_kind(words[at]) == CYCLE:
            cycle, first = int(words[at + 2]), at + CYCLE_HEAD + 8 * (int(words[at]) >> 40 & 0xFF)
            if not any(p.first_cycle <= cycle <= p.last_cycle for p in left_out):
                out += [(cycle, int(w)) for w in words[first : first + (int(words[at]) >> 32 & 0xFF)]]
        at += int(entry_words(words[at]))
    return out


@pytest.mark.parametrize("broken", [(2,), (1, 5)], ids=["one place", "two places"])
def test_the_inputs_of_a_recovered_recording_are_those_that_its_replay_steps_over(
    make_recording: Callable[..., Path], recovered_without: Callable[..., Path], broken: tuple[int, ...]
) -> None:
    # GIVEN recordings that lack chunks
    path = recovered_without(make_recording(cycles=4000, snapshot_cycles=500), *broken)
    report = replay_file(path)
    assert report.differing == report.states_differing == 0
    assert len(report.left_out) == len(broken)
    # WHEN their inputs are loaded
    inputs = load_recorded_inputs(path)
    # THEN they are those of the cycles that a replay steps over, and the others are named as there
    assert inputs.left_out == report.left_out
    assert inputs.recovered == report.recovered
    assert "is damaged" in inputs.recovered
    assert sum(p.cycles for p in inputs.left_out) == report.cycles_not_replayed
    expected = conversions_of(path, report.left_out)
    assert len(expected) == PER_CYCLE * report.cycles
    np.testing.assert_array_equal(inputs.conversion, [word for _, word in expected])
    # of every segment: the poses of all but the first were zeroes
    assert len(inputs.pose) > report.cycles // 11
    assert (inputs.pose[:, 6] == 1.0).all()
    # AND what is left out takes no time: the next part follows as another segment would
    times = [cycle * 1_000_000 + conversion_dt_ns(word) for cycle, word in expected]
    steps = np.diff(times)
    steps[np.flatnonzero(np.diff([cycle for cycle, _ in expected]) > 1)] += SEGMENT_GAP_NS
    for part in report.left_out:
        lost = [k for k, (cycle, _) in enumerate(expected) if cycle < part.first_cycle][-1]
        steps[lost] -= (part.cycles + 1) * 1_000_000
    np.testing.assert_array_equal(np.diff(inputs.conversion_t_ns), steps)


def test_a_recovered_recording_is_recovered_again(
    make_recording: Callable[..., Path], recovered_without: Callable[..., Path]
) -> None:
    path = recovered_without(make_recording(cycles=3000, snapshot_cycles=500), 1)
    again = recover(path).file
    assert replay_file(again).recovered == replay_file(path).recovered != ""
    assert load_recorded_inputs(again).left_out == load_recorded_inputs(path).left_out != []


def test_a_damaged_recording_is_refused_with_the_way_to_play_it(
    make_recording: Callable[..., Path], tmp_path: Path
) -> None:
    data = bytearray(make_recording(cycles=3000).read_bytes())
    data[len(data) // 2] ^= 1
    path = tmp_path / "broken.mcap"
    path.write_bytes(data)
    for read in (load_recorded_inputs, rebuild_map):
        with pytest.raises(RecordingError, match=rf"is damaged.*`surffollow recover {path}`"):
            read(path)


def test_many_places_are_listed_by_the_first_three() -> None:
    parts = [LeftOut(0, 10 * k, 10 * k + 4, 5) for k in range(5)]
    assert listed(parts) == (
        "cycles 0 to 4 of segment 0 (5); cycles 10 to 14 of segment 0 (5); "
        "cycles 20 to 24 of segment 0 (5); and 2 more"
    )


def test_the_recording_of_a_killed_service_is_recovered_and_played_around_what_it_lacks(
    tmp_path: Path, count_chunks: Callable[[Path], int], recovered_without: Callable[..., Path]
) -> None:
    # GIVEN a service with a robot and a recorder, all killed, and a chunk of the file that the disk has lost
    cut = tmp_path / "run.mcap"
    text = config_text(kind="simulated", top='snapshot = "100 ms"')
    # so long a log that a recorder which was put to sleep loses nothing
    text = text.replace("log_words = 65536", "log_words = 1048576")
    with over_ground(tmp_path, text) as s, s.recorder(cut) as recorder:
        with s.attach() as client:
            drive(client, lambda: count_chunks(cut) >= 6, what="six chunks")
        s.kill()
        recorder.kill()
        recorder.wait()
    path = recovered_without(cut, 3)
    report = replay_file(path)
    assert report.left_out
    assert report.cycles_not_replayed > 0
    assert report.differing == report.states_differing == 0
    # WHEN what `recover` makes of it is played into a service, and mapped
    inputs, target = load_recorded_inputs(path), tmp_path / "map.npz"
    words = ["--live", "--name", unique_name(), "--map", str(target), "--json"]
    done = run_command([s.python, "-m", "surffollow", "replay", str(path), *words])
    # THEN all that a replay steps over is played, and the rest is named
    played = json.loads(done.stdout)
    assert played["finished"]
    assert played["poses"] + played["poses_refused"] == len(inputs.pose)
    assert played["poses"] > 0
    assert played["conversions"] + played["conversions_skipped"] == len(conversions_of(path, report.left_out))
    assert played["left_out"] == [asdict(part) for part in report.left_out]
    assert played["recovered"] == report.recovered
    assert f"map.npz: without the target points and map commands of {listed(report.left_out)}" in done.stderr
    assert f"{path.name}: not played: {listed(report.left_out)}" in done.stderr
    assert done.returncode == 1
    assert target.exists()
