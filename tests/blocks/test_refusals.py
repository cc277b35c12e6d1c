"""Blocks refuse misuse, other declarations, other users and what is no block."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from second_user import needs_root
from surffollow.blocks import (
    F64,
    I64,
    Block,
    mem_attach,
)
from surffollow.errors import (
    BlockError,
    BusyError,
    InvalidNameError,
    LayoutMismatchError,
    NoPermissionError,
    NoSpaceError,
    SchemaError,
)

from .conftest import Platform


def test_values_that_do_not_fit_are_refused_by_name(space):
    with mem_attach(Platform, space, write=True) as mem, mem.platform.write() as slot:
        for name, value in (("pose", (1, 2)), ("t_ns", 1.5), ("t_ns", 1 << 63), ("state", "x" * 17)):
            with pytest.raises(ValueError, match=name):
                slot[name] = value
        with pytest.raises(AttributeError, match="no field 'speed'"):
            slot.speed = 1


def test_a_second_live_writer_is_refused_with_the_pid_of_the_first(space):
    pid = f"written by process {os.getpid()}"
    with mem_attach(Platform, space, write=True), pytest.raises(BusyError, match=pid):
        mem_attach(Platform, space, write=True)


def test_a_block_declared_otherwise_is_refused_with_both_hashes(space):
    class Platform2(Block):
        t_ns = I64(unit="s")

    with mem_attach({"platform": Platform}, space, write=True) as mem:
        with mem.platform.write() as slot:
            slot.t_ns = 1
        with pytest.raises(LayoutMismatchError, match=f"{Platform.HASH:016x}.*{Platform2.HASH:016x}"):
            mem_attach({"platform": Platform2}, space)


def test_misuse_is_named(space):
    with mem_attach(Platform, space, write=True) as mem, mem_attach(Platform, space) as theirs:
        with pytest.raises(BlockError, match="not the writer"):
            theirs.platform.get_write_ok()
        with pytest.raises(BlockError, match="without get_write_ok"):
            mem.platform.write_done()
        with pytest.raises(BlockError, match="without get_read_ok"):
            theirs.platform.read_done()
        with mem.platform.write(), pytest.raises(BusyError, match="under way"):
            mem.platform.get_read_ok()
        with pytest.raises(AttributeError, match="no block 'arm'"):
            _ = mem.arm


def test_names_and_schemas_that_cannot_be_are_refused(space):
    class Wide(Block):
        x = F64(align=128)

    class Clash(Block):
        update = F64()

    for name in ("../etc", "a/b", "", ".hidden", "x" * 60):
        with pytest.raises(InvalidNameError):
            mem_attach(Platform, name, write=True)
    with pytest.raises(InvalidNameError, match="map"):
        mem_attach({"map": Platform}, space, write=True)
    with pytest.raises(SchemaError, match="alignment"):
        mem_attach(Wide, space, write=True)
    with pytest.raises(SchemaError, match="update"):
        mem_attach(Clash, space, write=True)
    with pytest.raises(SchemaError, match="none of the blocks"):
        mem_attach(Platform, space, write=["arm"])
    assert not list(Path("/dev/shm").glob(f"{space}*"))


def test_links_and_foreign_objects_are_not_followed_or_overwritten(space, tmp_path):
    victim = tmp_path / "victim"
    victim.write_bytes(b"precious" * 4096)
    link = Path("/dev/shm", f"{space}.platform")
    link.symlink_to(victim)
    for write in (False, True):
        with pytest.raises(BlockError):
            mem_attach(Platform, space, write=write, timeout_s=0)
    link.unlink()
    link.write_bytes(b"precious" * 4096)
    for write in (False, True):
        with pytest.raises(BlockError, match=r"no block|not a block"):
            mem_attach(Platform, space, write=write, timeout_s=0)
    assert link.read_bytes() == victim.read_bytes() == b"precious" * 4096


@needs_root
def test_a_block_of_another_user_is_not_written_into(space):
    mem_attach(Platform, space, write=True).close(keep=True)
    os.chown(f"/dev/shm/{space}.platform", 65534, -1)
    with pytest.raises(NoPermissionError, match=r"belongs to user 65534, expected user 0"):
        mem_attach(Platform, space, write=True)


def test_a_block_larger_than_dev_shm_is_refused_and_leaves_nothing(space):
    room = os.statvfs("/dev/shm")

    class Huge(Block):
        x = F64(room.f_bavail * room.f_frsize // 8)

    with pytest.raises(NoSpaceError, match="MiB free"):
        mem_attach(Huge, space, write=True)
    assert not list(Path("/dev/shm").glob(f"{space}*"))
