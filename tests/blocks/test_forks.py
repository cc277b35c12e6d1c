"""Forked processes and the locks of blocks."""

from __future__ import annotations

import multiprocessing

import pytest

from surffollow.blocks import mem_attach
from surffollow.errors import BlockError, BlockTimeoutError

from .conftest import Platform, forever


def test_a_forked_child_neither_keeps_nor_frees_its_parents_locks(space):
    mem = mem_attach(Platform, space, write=True)
    # GIVEN a writer that forks in the middle of a write
    with mem.platform.write() as slot:
        slot.t_ns = 1
    slot = mem.platform.get_write_ok()  # the fork happens in the middle of a write
    context = multiprocessing.get_context("fork")

    def in_child(out):
        with pytest.raises(BlockError, match="parent stays the writer"):
            mem.platform.write_done()
        out.put(mem.platform.latest()["t_ns"])
        mem.close()
        out.put("closed")
        forever()

    out = context.Queue()
    process = context.Process(target=in_child, args=(out,), daemon=True)
    # WHEN the child tries to publish, then closes the block
    process.start()
    try:
        assert out.get(timeout=20) == 1
        assert out.get(timeout=20) == "closed"
        # THEN the parent is still the writer
        slot.t_ns = 2
        mem.platform.write_done()
        with mem_attach(Platform, space) as theirs:
            assert theirs.platform.writer_alive()
            # WHEN the parent closes it
            mem.close(keep=True)
            # THEN the block has no writer
            assert not theirs.platform.writer_alive()  # though the child lives
    finally:
        process.kill()
        process.join()
    # THEN the next writer finds what was published last
    with mem_attach(Platform, space, write=True) as mem:
        assert mem.platform.latest()["t_ns"] == 2


def test_a_forked_reader_opens_its_own_locks(space, child):
    with mem_attach(Platform, space, write=True, lease_s=60) as mem, mem_attach(Platform, space) as theirs:
        with mem.platform.write() as slot:
            slot.t_ns = 1

        def read_on(me):
            theirs.platform.get_read_ok(1.0)
            me.say(1)
            forever()

        # GIVEN a forked reader that reads by the block of its parent
        reader = child(read_on)
        assert reader.receive() == 1
        # THEN it keeps the writer out
        with pytest.raises(BlockTimeoutError):
            mem.platform.get_write_ok(0.01)
        # WHEN it is killed, THEN the writer goes on
        reader.kill()
        with mem.platform.write(20.0):
            pass
