"""The recorder and the live replay against real services, their deaths and restarts included."""

from __future__ import annotations

import errno
import io
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from running_service import Service, until
from surffollow.errors import FaultError, NotReadyError, NotRunningError, RecordingError
from surffollow.record import channel_feed
from surffollow.record.live_replay import LiveReport, play_live
from surffollow.record.reader import RecordingReader
from surffollow.record.recorded_inputs import load_recorded_inputs
from surffollow.record.recording_writer import RecordingWriter
from surffollow.record.replay import replay_file
from surffollow.record.replay_service import LEAD_NS, driver_info
from surffollow.record.service_log import ServiceLog
from surffollow.record.session import record_service
from surffollow.shm.name_lock import holder

POSE = (0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 1.0)
DEADLINE_S = 300.0


@pytest.fixture
def bare(tmp_path: Path) -> Iterator[Service]:
    """A service without sensors, not started; its period and its cycle log are those of the defaults."""
    s = Service(tmp_path, '[driver]\nkind = "none"\n[map]\ngrids = 1000\n')
    yield s
    s.purge()


def run_robot(s: Service, poses: int) -> None:
    with s.attach(stale_min_s=5.0) as client:
        for _ in range(poses):
            before = client.status()["poses"]
            client.ee_pos(POSE)
            until(lambda before=before: client.status()["poses"] > before, "the pose's arrival")
        client.set_params(permitted_variance="0.2 mm")
        client.sf_reset(0.11)


def segments_of(path: Path) -> set[int]:
    """Segments of which a batch has reached the file."""
    if bytes_of(path) == 0:
        return set()
    try:
        with RecordingReader(path) as reader:
            return {batch.segment for batch in reader.batches()}
    except RecordingError:  # its head is still on the way
        return set()


def bytes_of(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def test_a_killed_and_restarted_service_gives_two_segments_of_the_same_bits(
    bare: Service, tmp_path: Path
) -> None:
    # GIVEN a recorder that has written cycles of a service with a robot
    out = tmp_path / "log.mcap"
    bare.start()
    with bare.recorder(out) as recorder:
        run_robot(bare, 30)
        until(lambda: segments_of(out) == {0}, "the first segment", DEADLINE_S)
        # WHEN the service is killed and started again, and the robot goes on
        bare.kill()
        bare.start()
        run_robot(bare, 30)
        until(lambda: segments_of(out) == {0, 1}, "the second segment", DEADLINE_S)
        recorder.send_signal(signal.SIGTERM)
        text, _ = recorder.communicate(timeout=DEADLINE_S)
    # THEN the file has two segments, lacks no cycle, and replays bit for bit
    counts = json.loads(text)
    assert recorder.returncode == 0
    assert (counts["segments"], counts["restarts"], counts["lost_cycles"]) == (2, 1, 0)
    report = replay_file(out)
    assert report.identical, report
    assert report.cycles == counts["cycles"]
    assert report.events >= 4, "two parameter changes and two resets went through the log"


def test_a_killed_recorder_leaves_a_file_that_replays_up_to_its_last_chunk(
    bare: Service, tmp_path: Path
) -> None:
    # GIVEN a recorder that has written chunks of a service
    out = tmp_path / "log.mcap"
    bare.start()
    with bare.recorder(out) as recorder:
        until(out.exists, "the file")
        for _ in range(8):  # the first may be the file's head, the last cut, and a chunk written in two parts
            begin = bytes_of(out)
            until(lambda begin=begin: bytes_of(out) > begin, "the next chunk")
        # WHEN it is killed
        recorder.kill()
        recorder.wait()
    # THEN the file replays up to its last whole chunk, and says that it ends early
    report = replay_file(out)
    assert report.cycles > 200
    assert (report.differing, report.states_differing) == (0, 0)
    assert not report.identical
    assert "ends early" in report.damage


def test_a_recorder_whose_terminal_is_closed_completes_its_file(bare: Service, tmp_path: Path) -> None:
    # GIVEN a recorder that has written cycles of a service with a robot
    out = tmp_path / "log.mcap"
    bare.start()
    with bare.recorder(out) as recorder:
        run_robot(bare, 30)
        until(lambda: segments_of(out) == {0}, "the first segment", DEADLINE_S)
        # WHEN the terminal is closed
        recorder.send_signal(signal.SIGHUP)
        recorder.communicate(timeout=DEADLINE_S)
    # THEN the file has its end
    assert recorder.returncode == 0
    assert replay_file(out).identical


class FullDisk(io.BytesIO):
    """A file that takes a megabyte."""

    def write(self, data: bytes) -> int:  # type: ignore[override]
        if self.tell() + len(data) > 1_000_000:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(data)


def test_a_disk_that_is_full_is_reported_when_counters_of_the_service_are_written(
    bare: Service, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was taken for a service that goes away; the next write was to a closed file, with a traceback."""
    monkeypatch.setattr(channel_feed, "SERVICE_S", 0.0)
    bare.start()
    log = ServiceLog(bare.name)
    feed = channel_feed.ChannelFeed(RecordingWriter(tmp_path / "a.mcap", stream=FullDisk()), 10_000_000, log)

    def work_on() -> None:
        for _ in range(100_000):
            feed.work()

    try:
        with pytest.raises(FaultError, match=r"the disk is full; it is readable up to there"):
            work_on()
    finally:
        feed.close()
        log.close()


def test_a_service_behind_sigstop_stands_still(bare: Service) -> None:
    bare.start()
    log = ServiceLog(bare.name)
    try:
        assert not log.stands_still()
        bare.freeze()
        until(log.stands_still)
        assert log.alive()
    finally:
        log.close()


def test_recording_without_a_service_is_refused_and_makes_no_file(bare: Service, tmp_path: Path) -> None:
    with pytest.raises(NotRunningError, match=bare.name):
        record_service(bare.name, tmp_path / "log.mcap", threading.Event())
    assert not (tmp_path / "log.mcap").exists()


def play_and_record(name: str, path: Path, again: Path) -> LiveReport:
    """Play a recording into a service of this name and record that one."""
    done, played = threading.Event(), []

    def play() -> None:
        try:
            played.append(play_live(path, name=name))
        finally:
            done.set()

    thread = threading.Thread(target=play)
    thread.start()

    def record() -> bool:
        try:
            record_service(name, again, done)
        except (NotRunningError, NotReadyError, OSError):
            return done.is_set()
        return True

    try:
        until(record, "the recording's end", DEADLINE_S)
    finally:
        thread.join(DEADLINE_S)
    [report] = played
    return report


def test_a_recording_played_live_reaches_the_new_service_as_it_was(
    bare: Service, tmp_path: Path, make_recording: Callable[..., Path]
) -> None:
    path = make_recording(cycles=2400, snapshot_cycles=500)
    old = load_recorded_inputs(path)
    for k in range(4):  # a player that stands still posts late, and of late poses a cycle sees the newest
        again = tmp_path / f"again{k}.mcap"
        report = play_and_record(bare.name, path, again)
        new = load_recorded_inputs(again)
        if report.poses_refused == 0 and len(new.pose) > 0.9 * len(old.pose):
            break
    assert replay_file(again).identical
    assert report.finished
    assert report.poses == len(old.pose)
    assert report.poses_refused == 0
    assert report.resets == 1
    assert report.param_changes >= 1
    # one more conversion, the mark of the beginning; all others at their own times, but for those
    # that a stalled cycle skipped
    shift_ns = int(new.conversion_t_ns[0]) + LEAD_NS - old.first_ns
    places = np.searchsorted(old.conversion_t_ns, new.conversion_t_ns[1:] - shift_ns)
    np.testing.assert_array_equal(old.conversion_t_ns[places], new.conversion_t_ns[1:] - shift_ns)
    np.testing.assert_array_equal(old.conversion[places] & 0xFFFFFFFF, new.conversion[1:] & 0xFFFFFFFF)
    assert new.conversion.size - 1 == report.conversions == old.conversion.size - report.conversions_skipped
    # a cycle sees the newest of the poses that came since the last: recorded ones at their own times
    assert np.isin(new.pose_t_ns[:, 1] - shift_ns, old.pose_t_ns[:, 1]).all()
    assert len(new.pose) > 0.9 * len(old.pose)
    assert driver_info(old).scale_m == driver_info(new).scale_m


def test_a_damaged_recording_is_not_played(tmp_path: Path, recording_bytes: bytes) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(recording_bytes[: len(recording_bytes) // 2])
    with pytest.raises(RecordingError, match="cannot be played"):
        play_live(path)


def test_a_player_ends_while_its_service_starts(
    bare: Service, make_recording: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    # GIVEN a service that is never ready, such as one that compiles
    words = [sys.executable, "-c", "import signal; signal.pause()"]
    monkeypatch.setattr("surffollow.record.replay_service.bound_command", lambda *_: words)
    stop = threading.Event()
    stop.set()
    # WHEN the player is asked to end, THEN it does, and has played nothing
    report = play_live(make_recording(cycles=2400, snapshot_cycles=500), name=bare.name, stop=stop)
    assert (report.finished, report.poses, report.cycles) == (False, 0, 0)


def test_the_service_of_a_player_that_is_killed_ends(
    bare: Service, make_recording: Callable[..., Path], tmp_path: Path
) -> None:
    # GIVEN a recording that is played into a service of its own
    path = make_recording(cycles=2400, snapshot_cycles=500)
    words = [sys.executable, "-m", "surffollow", "replay", str(path), "--live", "--name", bare.name]
    here = os.environ | {"TMPDIR": str(tmp_path)}  # it leaves its folder
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=here) as player:
        try:
            until(lambda: holder(bare.name) > 0, "the start of its service", DEADLINE_S)
        finally:
            # WHEN the player is killed
            player.kill()
    # THEN the service ends
    until(lambda: holder(bare.name) == 0, "the end of its service", DEADLINE_S)
