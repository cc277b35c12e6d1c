"""A map rebuilt from a recording is the map that the run's own target points make."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from surffollow.cli.replay import replay_command
from surffollow.errors import RecordingError, UsageError
from surffollow.forecast.step import follow_step
from surffollow.map import HeightMap
from surffollow.record.map_rebuild import Remapper, rebuild_map
from surffollow.record.reader import RecordingReader
from surffollow.record.recorder import Recorder
from surffollow.record.recording_writer import RecordingWriter
from surffollow.record.replay import replay_file
from surffollow.record.synthetic_log import NS_PER_S, SyntheticLog, synthesise_inputs
from surffollow.shm.journal import CYCLE, MAP, SNAPSHOT, entry_head, entry_kind, entry_words
from surffollow.shm.layout_board import RQ_MAP_INSTALL, RQ_MAP_REFOCUS, RQ_MAP_RESET

CYCLES = 1400  # before the synthetic log's first change of parameters


def targets() -> np.ndarray:
    """The target points of the synthetic log, stepped here: (cycle, x, y, z)."""
    r, points = SyntheticLog(), []
    for cycle in range(CYCLES):
        synthesise_inputs(r.params, r.inputs, cycle, 1, 25, 1_000_000)
        follow_step(r.params, r.state, r.inputs, r.output, r.scratch)
        if r.output["fresh"][0] & 1:
            points.append([cycle, *r.output["target_m"][0][:3]])
    return np.array(points)


def with_commands(path: Path, commands: dict[int, tuple[int, tuple[float, ...]]]) -> Path:
    """The recording with MAP entries before the cycles named."""
    with RecordingReader(path) as reader:
        batches = [np.frombuffer(bytes(b.words), np.int64) for b in reader.batches()]
    changed, position = path.with_name("map.mcap"), 0
    with RecordingWriter(changed, force=True) as writer:
        for words in batches:
            out, at, cycles = [], 0, 0
            while at < words.size:
                n = int(entry_words(words[at]))
                cycle = int(words[at + 2])
                if entry_kind(words[at]) != SNAPSHOT and cycle in commands:
                    code, region = commands.pop(cycle)
                    out.append(np.array([entry_head(MAP, 3 + len(region)), NS_PER_S, code]))
                    out.append(np.array(region, np.float64).view(np.int64))
                cycles += entry_kind(words[at]) == CYCLE
                out.append(words[at : at + n])
                at += n
            written = np.concatenate(out)
            writer.add_batch(0, 1, position, cycles, written, 0, 0)
            position += written.size
        writer.finish({"cycles": str(CYCLES)})
    return changed


def same_maps(a: HeightMap, b: HeightMap) -> None:
    np.testing.assert_array_equal(a.heights_m, b.heights_m)
    np.testing.assert_array_equal(a.counts, b.counts)
    assert a.region_m == b.region_m


def test_the_heights_have_the_resolution_that_the_service_chose_at_the_reset(
    make_recording: Callable[..., Path],
) -> None:
    wide = (-0.01, -0.01, 0.08, 0.02)
    path = with_commands(make_recording(cycles=CYCLES), {400: (RQ_MAP_RESET, (*wide, 1e-3))})
    expected = HeightMap.over(wide, quantum_m=1e-3)
    expected.add(targets()[targets()[:, 0] >= 400, 1:])
    rebuilt = rebuild_map(path).map
    assert (rebuilt.quantum_m, rebuilt.datum_m) == (1e-3, expected.datum_m)
    same_maps(rebuilt, expected)


def test_behind_a_stop_and_its_reset_the_state_is_that_of_the_run(tmp_path: Path) -> None:
    # GIVEN a recorded run with a stop and its reset
    log, path = SyntheticLog(mode=1), tmp_path / "run.mcap"
    recorder = Recorder(log, RecordingWriter(path, force=True))
    log.run(2800)
    recorder.finish()
    with RecordingReader(path) as reader:
        words = np.concatenate([np.frombuffer(bytes(b.words), np.int64) for b in reader.batches()])
    # WHEN the map is built again, THEN target points come from the run's own state
    remapper = Remapper()
    remapper.segment(words)
    np.testing.assert_array_equal(remapper.state.view(np.int64), log.state.view(np.int64))


@pytest.mark.parametrize("finest", [(), (0.0,), (5e-4,)], ids=["old recording", "none", "chosen"])
def test_resets_and_refocuses_happen_between_the_points_where_they_were_asked_for(
    make_recording: Callable[..., Path], finest: tuple[float, ...]
) -> None:
    wide, narrow = (-0.01, -0.01, 0.08, 0.02), (0.02, -0.01, 0.05, 0.01)
    commands = {400: (RQ_MAP_RESET, wide), 900: (RQ_MAP_REFOCUS, (*narrow, *finest))}
    path = with_commands(make_recording(cycles=CYCLES), commands)
    points = targets()
    expected = HeightMap.over(wide)
    expected.add(points[(points[:, 0] >= 400) & (points[:, 0] < 900), 1:])
    expected.refocus(narrow, finest_m=sum(finest))
    expected.add(points[points[:, 0] >= 900, 1:])
    assert expected.counts.any()
    same_maps(rebuild_map(path).map, expected)


def test_without_a_reset_the_map_lies_over_all_points(make_recording: Callable[..., Path]) -> None:
    rebuilt, points = rebuild_map(make_recording(cycles=CYCLES)).map, targets()
    assert rebuilt.samples == len(points) > 500
    assert rebuilt.outside == 0


def test_a_recording_without_readings_or_with_damage_makes_no_map(
    make_recording: Callable[..., Path], tmp_path: Path, recording_bytes: bytes
) -> None:
    with pytest.raises(RecordingError, match="target point"):
        rebuild_map(make_recording(cycles=300, conversions=0))
    (tmp_path / "cut.mcap").write_bytes(recording_bytes[:-100])
    with pytest.raises(RecordingError, match="cannot be mapped"):
        rebuild_map(tmp_path / "cut.mcap")


def kept(points: np.ndarray, path: Path) -> np.ndarray:
    """Which target points are of cycles that a replay of a recovered recording does not leave out."""
    parts = replay_file(path).left_out
    assert parts
    return ~np.any([(points[:, 0] >= p.first_cycle) & (points[:, 0] <= p.last_cycle) for p in parts], axis=0)


def test_a_recovered_recording_makes_the_map_of_what_its_replay_steps_over(
    make_recording: Callable[..., Path], recovered_without: Callable[..., Path], tmp_path: Path
) -> None:
    # GIVEN a recovered recording that lacks a chunk in the middle, behind a MapReset
    wide, points = (-0.01, -0.01, 0.08, 0.02), targets()
    made = make_recording(cycles=CYCLES, snapshot_cycles=500)
    path = recovered_without(with_commands(made, {50: (RQ_MAP_RESET, wide)}), 1)
    # WHEN its map is built
    rebuilt = rebuild_map(path)
    # THEN it is that of the target points that the replay has, and what is left out is named
    expected = HeightMap.over(wide)
    expected.add(points[kept(points, path) & (points[:, 0] >= 50), 1:])
    assert rebuilt.map.samples == expected.samples > 100
    same_maps(rebuilt.map, expected)
    assert rebuilt.left_out == replay_file(path).left_out
    said = CliRunner().invoke(replay_command, [str(path), "--map", str(tmp_path / "map.npz"), "--json"])
    assert said.exit_code == 1
    assert json.loads(said.stdout)["left_out"] == [asdict(part) for part in rebuilt.left_out]
    assert f"map.npz: without the target points and map commands of {rebuilt.left_out[0]}" in said.stderr


def test_a_map_command_between_a_loss_and_the_next_snapshot_is_carried_out(
    make_recording: Callable[..., Path], recovered_without: Callable[..., Path]
) -> None:
    # GIVEN a recovered recording with a MapReset in cycles that are there and that no replay can step over
    wide, points = (-0.01, -0.01, 0.08, 0.02), targets()
    made = make_recording(cycles=CYCLES, snapshot_cycles=500)
    path = recovered_without(with_commands(made, {970: (RQ_MAP_RESET, (*wide, 1e-3))}), 1)
    [part] = replay_file(path).left_out
    assert part.last_cycle == 999
    with RecordingReader(path) as reader:
        words = np.concatenate([np.frombuffer(bytes(b.words), np.int64) for b in reader.batches()])
    assert entry_head(MAP, 8) in words
    # THEN the map is that from this command on
    expected = HeightMap.over(wide, quantum_m=1e-3)
    expected.add(points[points[:, 0] >= 1000, 1:])
    same_maps(rebuild_map(path).map, expected)


def test_a_map_that_was_installed_cannot_be_built_again_unless_a_reset_follows(
    make_recording: Callable[..., Path],
) -> None:
    wide = (-0.01, -0.01, 0.08, 0.02)
    path = with_commands(make_recording(cycles=CYCLES), {400: (RQ_MAP_INSTALL, wide)})
    with pytest.raises(RecordingError, match=r"map was installed.*not in the recording"):
        rebuild_map(path)
    commands = {400: (RQ_MAP_INSTALL, wide), 900: (RQ_MAP_RESET, wide)}
    rebuilt = rebuild_map(with_commands(make_recording(cycles=CYCLES), commands)).map
    assert rebuilt.samples == (targets()[:, 0] >= 900).sum()


def test_the_commands_map_option_knows_its_formats_and_refuses_others(
    make_recording: Callable[..., Path], tmp_path: Path
) -> None:
    path, runner = str(make_recording(cycles=CYCLES)), CliRunner()
    wrong = runner.invoke(replay_command, [path, "--map", str(tmp_path / "map.wurst")])
    assert isinstance(wrong.exception, UsageError)
    assert ".txt, .map, .npz, .asc" in str(wrong.exception)
    assert not (tmp_path / "map.wurst").exists()
    assert runner.invoke(replay_command, [path, "--map", str(tmp_path / "map.asc")]).exit_code == 0
    assert (tmp_path / "map.asc").read_text().startswith("ncols")
