"""Recordings made without a daemon, for the tests of this folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from surffollow.record.recorder import Recorder
from surffollow.record.recording_writer import RecordingWriter
from surffollow.record.synthetic_log import SyntheticLog


def record(path: Path, cycles: int = 3000, step: int = 250, **options: int) -> Path:
    """A recording of a synthetic log, polled every `step` cycles."""
    synthetic_log = SyntheticLog(**options)
    recorder = Recorder(synthetic_log, RecordingWriter(path, {"name": "synthetic_log"}, force=True))
    for done in range(0, cycles, step):
        synthetic_log.run(min(step, cycles - done))
        recorder.poll()
    recorder.finish()
    return path


@pytest.fixture
def make_recording(tmp_path: Path) -> Callable[..., Path]:
    """Makes a recording with the options of `SyntheticLog`."""
    return lambda **options: record(tmp_path / "log.mcap", **options)


@pytest.fixture(scope="session")
def recording_bytes(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A whole recording of 3000 cycles, several chunks long."""
    return record(tmp_path_factory.mktemp("recording") / "log.mcap").read_bytes()
