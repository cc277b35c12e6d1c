"""Guarantees for programs that share a block, without failures."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from surffollow.blocks import (
    F64,
    I8,
    Block,
    get_read_ok,
    get_write_ok,
    latest,
    mem_attach,
    read_done,
    write_done,
)
from surffollow.errors import (
    BlockError,
    BlockTimeoutError,
    LayoutMismatchError,
    NotRunningError,
)

from .conftest import Platform, Words


def test_the_five_routines_hand_values_from_writer_to_reader(space):
    with mem_attach(Platform, space, write=True) as ours, mem_attach(Platform, space) as theirs:
        slot = get_write_ok(ours.platform)
        slot.t_ns, slot.pose, slot.state = 7, [1.0, 2.0, 3.0], "höhe"
        slot.wheel[1].speed = 0.5
        assert write_done(ours.platform) == 1
        view, generation = get_read_ok(theirs.platform)
        assert generation == theirs.platform.generation == 1
        assert (view.t_ns, view.pose, view.state) == (7, (1.0, 2.0, 3.0), "höhe")
        assert [w.speed for w in view.wheel] == [0.0, 0.5]
        assert view["t_ns"] == 7
        assert read_done(theirs.platform) == "ok"
        snapshot = latest(theirs.platform)
        assert (snapshot.generation, snapshot.stale, snapshot["pose"]) == (1, False, (1.0, 2.0, 3.0))
        assert snapshot.epoch == ours.platform.epoch
        assert 0 <= snapshot.age_ns() < 1e9


def test_a_write_begins_with_the_latest_values_and_an_abandoned_one_changes_nothing(space):
    with mem_attach(Platform, space, write=True) as mem:
        block = mem.platform
        with block.write() as slot:
            slot.update(t_ns=1, pose=(1, 2, 3), state="a")
        with block.write() as slot:
            slot.array("pose")[1] = 20.0
        assert block.latest()["pose"] == (1.0, 20.0, 3.0)
        with pytest.raises(ValueError, match="17"), block.write() as slot:
            slot.update(t_ns=8, state="x" * 17)
        assert block.latest()["t_ns"] == 1
        assert block.generation == 2
        with block.write() as slot:
            assert slot.state == "a"


def test_a_view_is_read_only_and_ends_with_the_read(space):
    with mem_attach(Platform, space, write=True) as mem, mem_attach(Platform, space) as theirs:
        with mem.platform.write() as slot:
            slot.t_ns = 1
        with pytest.raises(BlockError, match="is over"):
            slot.t_ns = 2
        with theirs.platform.read() as view:
            with pytest.raises(TypeError, match="read-only"):
                view.t_ns = 5
            assert view.numpy()["t_ns"] == 1
        with pytest.raises(BlockError, match="is over"):
            _ = view.t_ns


def test_numpy_and_plain_values_show_the_same_structure(space):
    with mem_attach(Platform, space, write=True) as mem:
        with mem.platform.write() as slot:
            record = slot.numpy()
            record["pose"] = [4, 5, 6]
            record["wheel"]["slips"] = [1, 2]
            del record
        values = mem.platform.latest().values
        assert values.as_dict()["pose"] == [4.0, 5.0, 6.0]
        assert [w["slips"] for w in values.as_dict()["wheel"]] == [1, 2]
        np.testing.assert_array_equal(values.numpy()["wheel"]["slips"], [1, 2])


def test_reading_waits_until_writing_has_finished_and_writing_until_reading_has(space):
    with mem_attach(Platform, space, write=True, lease_s=30) as mem, mem_attach(Platform, space) as theirs:
        with mem.platform.write() as slot:
            slot.t_ns = 1
        with mem.platform.write() as slot:
            slot.t_ns = 2
            with pytest.raises(BlockTimeoutError, match=f"process {os.getpid()} did not finish writing"):
                theirs.platform.get_read_ok(0.02)
            assert theirs.platform.latest()["t_ns"] == 1  # `latest` does not wait
        with theirs.platform.read() as view:
            with pytest.raises(BlockTimeoutError, match="readers of block"):
                mem.platform.get_write_ok(0.02)
            assert view.t_ns == 2
        with mem.platform.write(0.0) as slot:
            slot.t_ns = 3


def test_a_waiting_reader_and_a_waiting_writer_get_their_turn(space):
    seen = []
    with mem_attach(Platform, space, write=True) as mem, mem_attach(Platform, space) as theirs:

        def read():
            with theirs.platform.read() as view:
                seen.append(view.t_ns)

        slot = mem.platform.get_write_ok()
        reader = threading.Thread(target=read)
        reader.start()
        slot.t_ns = 11
        mem.platform.write_done()
        reader.join(30)
        assert seen == [11]


def test_nothing_written_yet_is_distinguished_from_zeros(space):
    with mem_attach(Platform, space, write=True), mem_attach(Platform, space) as theirs:
        snapshot = theirs.platform.latest()
        assert snapshot.generation == 0
        assert snapshot.stale
        assert snapshot["pose"] == (0.0, 0.0, 0.0)
        with pytest.raises(BlockTimeoutError, match="nothing has been written"):
            theirs.platform.get_read_ok(0.0)


def test_a_writer_with_another_schema_replaces_a_block_whose_writer_ended(space):
    class Other(Block):
        x = F64()

    old = mem_attach({"b": Platform}, space, write=True)
    with old.b.write() as slot:
        slot.t_ns = 1
    with mem_attach({"b": Platform}, space) as reader:
        old.close(keep=True)
        with mem_attach({"b": Other}, space, write=True) as new:
            with new.b.write() as slot:
                slot.x = 2.0
            assert reader.b.latest().stale  # the object of that name has another layout than this reader
            assert reader.b.latest()["t_ns"] == 1
            with pytest.raises(LayoutMismatchError):
                reader.b.get_read_ok(0.1)
            with mem_attach({"b": Other}, space) as reader2:
                assert reader2.b.latest()["x"] == 2.0


def test_readers_follow_a_writer_that_ends_in_peace_and_starts_again(space):
    reader, epochs = None, []
    for k in (1, 2):
        with mem_attach(Platform, space, write=True) as mem:
            with mem.platform.write() as slot:
                slot.t_ns = k
            reader = reader or mem_attach(Platform, space)
            deadline = time.monotonic() + 30
            while (snapshot := reader.platform.latest()).stale and time.monotonic() < deadline:
                pass
            assert snapshot["t_ns"] == k
            epochs.append(snapshot.epoch)
            assert reader.platform.writer_alive()
        assert reader.platform.latest().stale
        assert not reader.platform.writer_alive()
        assert not Path("/dev/shm", f"{space}.platform").exists()
    assert epochs[1] > epochs[0]
    reader.close()


def test_a_kept_block_is_continued_by_the_next_writer(space):
    with mem_attach(Platform, space, write=True) as mem:
        with mem.platform.write() as slot:
            slot.t_ns = 5
        epoch = mem.platform.epoch
        mem.close(keep=True)
    with mem_attach(Platform, space, write=True) as mem:
        assert mem.platform.epoch == epoch + 1
        assert mem.platform.latest()["t_ns"] == 5
        with mem.platform.write():
            pass
        assert mem.platform.generation == 2


def test_blocks_attach_lazily_or_say_who_is_missing(space):
    with pytest.raises(NotRunningError, match=f"{space}.platform"):
        mem_attach(Platform, space, timeout_s=0.0)
    with mem_attach([Platform, Words], space, write=["words"], lazy=True) as mem:
        assert not mem.platform.attached
        assert mem.platform.latest().stale
        with pytest.raises(BlockTimeoutError, match="its writer has not started"):
            mem.platform.get_read_ok(0.0)
        with mem_attach(Platform, space, write=True) as other:
            with other.platform.write() as slot:
                slot.t_ns = 3
            with mem.platform.read() as view:
                assert view.t_ns == 3


def test_replication_hooks_get_every_publication_and_cannot_hurt_the_writer(space):
    got = []
    with mem_attach(Platform, space, write=True) as mem:
        block = mem.platform
        take_off = block.on_write_done(lambda s: got.append((s.epoch, s.generation, s.payload)))
        for k in range(3):
            with block.write() as slot:
                slot.t_ns = k
        take_off()
        with block.write():
            pass
        assert [g for _, g, _ in got] == [1, 2, 3]
        assert {e for e, _, _ in got} == {block.epoch}
        assert [int.from_bytes(p[:8], "little") for _, _, p in got] == [0, 1, 2]
        assert all(len(p) == Platform.SIZE for _, _, p in got)

        def broken(snapshot):
            raise OSError("link is down")

        block.on_write_done(broken)
        with pytest.warns(UserWarning, match="link is down"), block.write() as slot:
            slot.t_ns = 9
        with block.write():
            pass
        assert block.hook_failures == 2
        assert block.latest()["t_ns"] == 9


def test_latest_gives_the_last_good_copy_when_the_writer_outruns_every_try(space, monkeypatch):
    with mem_attach(Words, space, write=True) as mem, mem_attach(Words, space) as theirs:
        with mem.words.write() as slot:
            slot.word = [1] * 256
        good = theirs.words.latest()

        class Racing:
            """Memory in which three publications pass during every copy."""

            def __init__(self, memory):
                self.memory = memory

            def __getitem__(self, at):
                for _ in range(3):
                    with mem.words.write() as slot:
                        slot.array("word")[0] += 1
                return self.memory[at]

        monkeypatch.setattr(theirs.words, "_memory", Racing(theirs.words._memory))
        stale = theirs.words.latest()
        assert stale.stale
        assert (stale.generation, stale.data) == (good.generation, good.data)
        assert mem.words.generation == 1 + 3 * 16  # bounded tries


def test_modes_are_set_whatever_the_umask(space):
    old = os.umask(0o077)
    try:
        with mem_attach(Platform, space, write=True, mode=0o644):
            assert os.stat(f"/dev/shm/{space}.platform").st_mode & 0o777 == 0o644
    finally:
        os.umask(old)
    with pytest.raises(ValueError, match="mode"):
        mem_attach(Platform, space, write=True, mode=0o444)


def test_odd_sizes_and_single_bytes_work(space):
    class Bits(Block):
        flags = I8(3)

    with mem_attach(Bits, space, write=True) as mem:
        for k in range(9):
            with mem.bits.write() as slot:
                slot.flags = (k, -k, 0)
            assert mem.bits.latest()["flags"] == (k, -k, 0)


def test_importing_blocks_loads_neither_numpy_nor_numba():
    code = "import sys, surffollow.blocks; sys.exit(bool({'numpy', 'numba', 'click'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
