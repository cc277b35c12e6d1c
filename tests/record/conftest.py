"""Recordings made without a daemon, for the tests of this folder."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from surffollow.record.mcap_reader import CHUNK, MAGIC
from surffollow.record.recorder import Recorder
from surffollow.record.recording_writer import RecordingWriter
from surffollow.record.recover import recover
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


def chunks_of(data: bytes) -> list[int]:
    """Where the whole chunks of a file begin."""
    at, found = len(MAGIC), []
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if at + 9 + length > len(data):
            break
        if opcode == CHUNK:
            found.append(at)
        at += 9 + length
    return found


@pytest.fixture
def count_chunks() -> Callable[[Path], int]:
    """Counts the whole chunks of a file, which may not be there yet."""
    return lambda path: len(chunks_of(path.read_bytes())) if path.exists() else 0


@pytest.fixture
def recovered_without() -> Callable[..., Path]:
    """Breaks chunks of a recording, by their numbers, and gives the file that `recover` makes of it."""

    def make(path: Path, *numbers: int) -> Path:
        data = bytearray(path.read_bytes())
        places = chunks_of(bytes(data))
        for number in numbers:
            data[places[number] + 200] ^= 1
        broken = path.with_name("broken.mcap")
        broken.write_bytes(data)
        return Path(recover(broken, path.with_name("recovered.mcap"), force=True).file)

    return make


@pytest.fixture(scope="session")
def recording_bytes(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A whole recording of 3000 cycles, several chunks long."""
    return record(tmp_path_factory.mktemp("recording") / "log.mcap").read_bytes()
