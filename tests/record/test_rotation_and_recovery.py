"""Recordings in several files, and files that were cut: nothing lost that need not be."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from mcap.reader import make_reader

from surffollow.cli.convert import convert_command, recover_command
from surffollow.cli.replay import report_text
from surffollow.errors import FaultError, UsageError
from surffollow.record.channel_feed import ChannelFeed
from surffollow.record.convert import convert
from surffollow.record.recorder import Recorder
from surffollow.record.recover import recover
from surffollow.record.replay import replay_file
from surffollow.record.session import Files
from surffollow.record.synthetic_log import SyntheticLog


def recorded(folder: Path, cycles: int, **limits: float) -> tuple[Recorder, Files]:
    synthetic_log = SyntheticLog(snapshot_cycles=500)
    files = Files(folder / "run.mcap", {"name": "synthetic_log"}, **limits)  # type: ignore[arg-type]
    writer = files.open_next()
    recorder = Recorder(synthetic_log, writer, ChannelFeed(writer, 10_000_000), files)
    for _ in range(0, cycles, 100):
        synthetic_log.run(100)
        recorder.poll()
    recorder.finish()
    return recorder, files


def test_files_that_follow_each_other_hold_every_cycle_and_replay_each_by_itself(tmp_path: Path) -> None:
    # GIVEN a recording in several files
    recorder, files = recorded(tmp_path, 6000, max_bytes=150_000)
    assert len(files.paths) >= 3
    # WHEN each is replayed, THEN all have the same bits and no cycle is lost
    reports = [replay_file(path) for path in files.paths]
    assert all(r.identical for r in reports), reports
    assert sum(r.cycles for r in reports) == recorder.counts.cycles == 6000
    assert (recorder.counts.losses, recorder.counts.segments) == (0, 1)
    # WHEN they are converted together, THEN the table has every cycle in order
    done = convert(files.paths, "csv", tmp_path / "all.csv", rate_hz=0)
    rows = (tmp_path / "all.csv").read_text().splitlines()
    place = rows[0].split(",").index("cycle")
    cycles = np.array([int(row.split(",")[place]) for row in rows[1:]])
    assert (done.rows, done.damage, done.differing) == (6000, [], 0), "stops are in the second half, too"
    assert (np.diff(cycles) == 1).all()
    # THEN the last file has all that a reader needs
    with open(files.paths[-1], "rb") as file:
        topics = [channel.topic for _, channel, _ in make_reader(file).iter_messages()]
    assert {"/params", "/tf", "/state"} <= set(topics), "a later file is understood without the first"
    # THEN no file lacks samples: a stop ends the channels of none
    samples = 0
    for path in files.paths:
        with open(path, "rb") as file:
            samples += sum(c.topic == "/state" for _, c, _ in make_reader(file).iter_messages())
    assert samples == 600


def test_the_oldest_files_go_when_only_some_are_kept(tmp_path: Path) -> None:
    _, files = recorded(tmp_path, 6000, max_bytes=150_000, keep=2)
    assert sorted(tmp_path.iterdir()) == files.paths[-2:]
    assert files.paths[-1].name == f"run-{len(files.paths) - 1:04d}.mcap"


def test_keeping_without_rotation_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="when to begin another"):
        Files(tmp_path / "run.mcap", {}, keep=2)


@pytest.mark.parametrize("part", [0.35, 0.5, 0.8])
def test_a_cut_recording_is_recovered_up_to_its_last_whole_chunk(
    tmp_path: Path, recording_bytes: bytes, part: float
) -> None:
    # GIVEN a recording that was cut
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recording_bytes[: int(len(recording_bytes) * part)])
    before = replay_file(cut)
    # WHEN it is recovered
    done = recover(cut)
    # THEN the new file is whole, has the cycles up to the cut, and names the damage
    after = replay_file(done.file)
    assert after.identical, after
    assert (after.complete, after.damage) == (True, "")
    assert "ends early" in after.recovered
    assert f"RECOVERED from a damaged file: {after.recovered}" in report_text(done.file, after)
    assert before.recovered == ""
    assert after.cycles == before.cycles == done.cycles > 0
    assert after.lost_bytes == done.lost_bytes == before.lost_bytes > 0
    with open(done.file, "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert sum(1 for _ in reader.iter_messages()) == done.messages
        reported = {m.name: m.metadata for m in reader.iter_metadata()}
    assert "ends early" in reported["surffollow.recovered"]["damage"]


def test_a_file_whose_name_is_no_utf_8_is_recovered(tmp_path: Path, recording_bytes: bytes) -> None:
    cut = Path(os.fsdecode(os.fsencode(tmp_path) + b"/cut-\xff.mcap"))
    cut.write_bytes(recording_bytes[: len(recording_bytes) // 2])
    done = recover(cut)
    with open(done.file, "rb") as file:
        reported = {m.name: m.metadata for m in make_reader(file).iter_metadata()}
    assert reported["surffollow.recovered"]["from"] == "cut-\N{REPLACEMENT CHARACTER}.mcap"


def test_the_commands_keep_what_is_there_and_tell_damage(tmp_path: Path, recording_bytes: bytes) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recording_bytes[: len(recording_bytes) // 2])
    found = CliRunner().invoke(recover_command, [str(cut), "--json"])
    assert json.loads(found.stdout)["lost_bytes"] > 0
    again = CliRunner().invoke(recover_command, [str(cut)])
    assert isinstance(again.exception, FaultError)
    table = CliRunner().invoke(convert_command, [str(cut), "--to", "csv", "--json"])
    assert "ends early" in table.stderr
    assert json.loads(table.stdout)["rows"] > 0
    again = CliRunner().invoke(convert_command, [str(cut), "--to", "csv"])
    assert isinstance(again.exception, FaultError)
    assert "--force" in str(again.exception)
