"""Readers of a block that lock bytes against the rules, and blocks that other users made."""

from __future__ import annotations

import fcntl
import os
import struct
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from blocks.conftest import Platform, Words
from second_user import NOBODY, OtherUser, as_other_user, needs_root, outcome
from surffollow.blocks import mem_attach
from surffollow.blocks.listing import attach_unknown, list_blocks
from surffollow.errors import BlockError, NoPermissionError

FLOCK = struct.Struct("hhxxxxqqixxxx")
LEASE_S = 0.3


def lock_all(path: Path) -> int:
    """Hold a read lock on every byte that the file could have."""
    fd = os.open(path, os.O_RDONLY)
    fcntl.fcntl(fd, fcntl.F_OFD_SETLK, FLOCK.pack(fcntl.F_RDLCK, os.SEEK_SET, 0, 0, 0))
    return fd


def maker(space: str) -> Callable[[OtherUser], str]:
    """Work of another user, who makes a block and keeps it until a line arrives."""

    def made(child: OtherUser) -> str:
        mem = mem_attach(Platform, space, write=True, mode=0o644)
        child.say("made")
        child.receive()
        mem.close()
        return "closed"

    return made


def test_a_reader_that_locks_every_byte_holds_the_writer_up_for_one_lease_and_never_again(space):
    with mem_attach(Words, space, write=True, lease_s=LEASE_S) as mem, mem_attach(Words, space) as theirs:
        block = mem.words
        with block.write() as slot:
            slot.word = [1] * 256
        fd = lock_all(Path(f"/dev/shm/{space}.words"))
        with pytest.warns(UserWarning, match="against its rules"), block.write(60.0) as slot:
            slot.word = [2] * 256
        assert block.barred
        fences = block.fenced
        began = time.monotonic()
        for k in range(20):
            with block.write(60.0) as slot:
                slot.word = [k] * 256
        assert time.monotonic() - began < 20 * LEASE_S, "no lease per write"
        assert block.fenced == fences + 20, "who reads meanwhile is told that it is stale"
        # readers that keep to the rules read on, each whole publication
        view, _ = theirs.words.get_read_ok(60.0)
        assert set(view.word) == {19}
        with block.write(60.0) as slot:
            slot.word = [20] * 256
        assert theirs.words.read_done() == "stale"
        os.close(fd)
        with block.write(60.0) as slot:
            slot.word = [21] * 256
        assert not block.barred
        with theirs.words.read(60.0) as view:
            assert set(view.word) == {21}


@needs_root
def test_no_file_of_an_untrusted_user_is_mapped_for_it_could_be_cut_while_it_is_listed(space):
    name = f"{space}.platform"
    with OtherUser(maker(space)) as other:
        assert other.receive() == "made"
        assert name not in [b["name"] for b in list_blocks()]
        Path(f"/dev/shm/{name}.lock").unlink()  # root's rights: only the object itself is in the way
        for open_it in (lambda: attach_unknown(name), lambda: mem_attach(Platform, space, write=True)):
            with pytest.raises(NoPermissionError, match=f"belongs to user {NOBODY}, expected user 0"):
                open_it()
        other.say("end")
        assert other.receive() == "closed"
    with mem_attach(Platform, space, write=True):
        assert name in [b["name"] for b in list_blocks()]


def test_a_barred_writer_keeps_readers_out_while_it_writes(space):
    with mem_attach(Words, space, write=True, lease_s=60.0) as mem, mem_attach(Words, space) as theirs:
        block = mem.words
        with block.write() as slot:
            slot.word = [1] * 256
        block.barred = True
        fd = lock_all(Path(f"/dev/shm/{space}.words"))
        block.get_write_ok()
        with pytest.raises(BlockError, match="did not finish writing"):
            theirs.words.get_read_ok(0.05)
        block.write_done()
        theirs.words.get_read_ok(60.0)
        assert theirs.words.read_done() == "ok"
        os.close(fd)


@needs_root
def test_a_reader_that_locks_every_byte_keeps_no_new_writer_out(space):
    def locking(child: OtherUser) -> str:
        child.say(outcome(lambda: os.open(f"/dev/shm/{space}.platform.lock", os.O_RDONLY)))
        lock_all(Path(f"/dev/shm/{space}.platform"))
        child.say("locked")
        return str(child.receive())

    first = mem_attach(Platform, space, write=True, mode=0o644)
    with OtherUser(locking) as reader:
        assert reader.receive().startswith("PermissionError")
        assert reader.receive() == "locked"
        first.close(keep=True)
        with mem_attach(Platform, space, write=True, lease_s=LEASE_S) as mem:
            assert mem.platform.is_writer


@needs_root
def test_a_block_that_another_user_made_is_not_read(space):
    with mem_attach(Platform, space, write=True) as mem, mem_attach(Platform, space) as reader:
        with mem.platform.write() as slot:
            slot.t_ns = 7
        assert reader.platform.latest()["t_ns"] == 7
        mem.close()
        with OtherUser(maker(space)) as impostor:
            assert impostor.receive() == "made"
            with pytest.raises(NoPermissionError, match=f"belongs to user {NOBODY}, expected user 0"):
                mem_attach(Platform, space)
            for _ in range(5):
                reader.platform._next_attach_ns = 0
                assert reader.platform.latest().stale
            with mem_attach(Platform, space, owner=NOBODY) as trusting:
                assert trusting.platform.attached
            impostor.say("over")
            assert impostor.receive() == "closed"


@needs_root
@pytest.mark.parametrize("kind", ["fifo", "link"])
def test_what_is_no_plain_file_is_refused_at_once(space, kind):
    path = Path(f"/dev/shm/{space}.platform")
    make = (lambda: os.mkfifo(path, 0o666)) if kind == "fifo" else (lambda: path.symlink_to("/dev/zero"))
    assert as_other_user(lambda _: outcome(make)) == "done"
    for write in (False, True):
        with pytest.raises(BlockError, match="expected a plain file"):
            mem_attach(Platform, space, write=write, timeout_s=0.1)
    path.unlink()
