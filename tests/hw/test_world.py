"""The block with the robot's true pose: one writer, readers that outlive it, restarts."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from second_user import NOBODY, as_other_user, needs_root, outcome
from surffollow.errors import (
    BusyError,
    ConfigError,
    InvalidNameError,
    LayoutMismatchError,
    NoPermissionError,
    NotRunningError,
)
from surffollow.shm.dtypes import zeros
from surffollow.sim.world import WorldPose, WorldReader, WorldWriter
from surffollow.sim.world_surface import SURFACES, WorldConfig, world_surface


@pytest.fixture
def name() -> Iterator[str]:
    unique = f"test-world-{os.getpid()}"
    yield unique
    for end in (".world", ".world.lock"):
        Path(f"/dev/shm/{unique}{end}").unlink(missing_ok=True)


def pose(t_ns: int) -> np.ndarray:
    record = zeros(WorldPose)
    record["t_ns"] = t_ns
    record["pose"] = [1, 2, 3, 0, 0, 0, 1]
    return record


def test_reader_sees_the_newest_pose(name: str) -> None:
    writer = WorldWriter(name)
    reader = WorldReader(name)
    assert reader.latest() is None
    for t_ns in (5, 6, 7):
        writer.write(pose(t_ns))
    latest = reader.latest()
    assert latest is not None
    assert latest["t_ns"][0] == 7
    assert latest["pose"][0].tolist() == [1, 2, 3, 0, 0, 0, 1]
    reader.close()
    writer.close()


def test_a_second_live_writer_is_refused(name: str) -> None:
    writer = WorldWriter(name)
    with pytest.raises(BusyError, match="live writer"):
        WorldWriter(name)
    writer.close()
    WorldWriter(name).close()


@needs_root
def test_a_block_of_another_user_is_not_mapped(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # the owner of a block can truncate it, and reading beyond the end ends the reader's process
    assert as_other_user(lambda _: outcome(lambda: WorldWriter(name).write(pose(1)))) == "done"
    with pytest.raises(NoPermissionError, match=f"user {NOBODY}"):
        WorldReader(name)
    monkeypatch.setenv("SURFFOLLOW_OWNER", str(NOBODY))
    WorldReader(name).close()


def test_reader_outlives_its_writer_and_learns_that_the_block_is_another_one(name: str) -> None:
    writer = WorldWriter(name)
    writer.write(pose(1))
    reader = WorldReader(name)
    assert reader.is_current
    writer.close()
    assert not reader.is_current
    assert reader.latest() is not None
    again = WorldWriter(name)
    assert not reader.is_current
    fresh = WorldReader(name)
    assert fresh.is_current
    assert fresh.epoch > reader.epoch
    for block in (reader, fresh, again):
        block.close()


def test_a_killed_writer_is_replaced_in_place_and_its_readers_go_on(name: str) -> None:
    code = (
        "import os, signal, sys; from surffollow.sim.world import *; from surffollow.shm.dtypes import zeros;"
        "w = WorldWriter(sys.argv[1]); r = zeros(WorldPose); r['t_ns'] = 11; w.write(r);"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code, name], check=False)
    reader = WorldReader(name)
    epoch = reader.epoch
    writer = WorldWriter(name)
    assert reader.is_current
    assert reader.epoch > epoch
    writer.write(pose(12))
    latest = reader.latest()
    assert latest is not None
    assert latest["t_ns"][0] == 12
    reader.close()
    writer.close()
    assert not os.path.exists(f"/dev/shm/{name}.world")


def test_missing_unfinished_and_foreign_blocks_are_distinguished(name: str) -> None:
    with pytest.raises(NotRunningError, match="start a robot"):
        WorldReader(name)
    writer = WorldWriter(name)
    with open(f"/dev/shm/{name}.world", "r+b") as block:
        block.seek(8)
        block.write(b"\1" * 8)
        block.flush()
        with pytest.raises(LayoutMismatchError, match="same version"):
            WorldReader(name)
        block.seek(0)
        block.write(b"\0" * 8)
        block.flush()
        with pytest.raises(NotRunningError, match="not ready"):
            WorldReader(name)
    writer.close()


def test_an_object_of_another_size_is_replaced_not_resized(name: str) -> None:
    with open(f"/dev/shm/{name}.world", "wb") as block:
        block.write(b"x" * 100)
    before = os.stat(f"/dev/shm/{name}.world").st_ino
    writer = WorldWriter(name)
    assert os.stat(f"/dev/shm/{name}.world").st_ino != before
    writer.close()


@pytest.mark.parametrize("bad", ["", "../x", "a/b", ".hidden", "x" * 65, "ü"])
def test_names_that_a_path_could_misread_are_refused(bad: str) -> None:
    with pytest.raises(InvalidNameError):
        WorldReader(bad)


@pytest.mark.parametrize("kind", [k for k in SURFACES if k in ("fy91", "flat", "shell", "iso-c")])
def test_two_makers_of_one_ground_get_the_same_heights(kind: str) -> None:
    config = WorldConfig(surface=kind, seed=7, region=(0.0, 0.0, 0.5, 0.2))
    a, b = config.make(), config.make()
    assert np.array_equal(a.heights_m, b.heights_m)
    assert a.region[3] >= 0.2 - 1e-9


def test_unknown_ground_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="fy91"):
        world_surface("moon")


@pytest.mark.parametrize("surface", ["fy91", "flat", "iso-c"])
@pytest.mark.parametrize("seed", [-5, 2**63])
def test_a_seed_outside_its_bounds_is_refused(surface: str, seed: int) -> None:
    with pytest.raises(ConfigError, match=r"seed of the ground is .*; expected a whole number from 0"):
        WorldConfig(surface=surface, seed=seed).make()
