"""Readers and writers that are killed, stopped, or never let go: others wait a bounded time."""

from __future__ import annotations

import os
import signal
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from running_service import quickest, until
from surffollow.blocks import mem_attach
from surffollow.blocks.layout import WAITING_WORD
from surffollow.errors import BlockError, BlockTimeoutError
from surffollow.shm.locks import QUEUE_BYTE

from .conftest import Platform, Words, forever

LEASE_S = 0.03
STEP = 7  # lines between two makers that are killed


def test_a_killed_reader_gives_its_lock_back_at_once(space, child):
    # GIVEN a block with a long lease
    with mem_attach(Platform, space, write=True, lease_s=60) as mem:
        with mem.platform.write() as slot:
            slot.t_ns = 1

        def read_and_hang(me):
            mem_attach(Platform, space).platform.get_read_ok()
            me.say(1)
            forever()

        for _ in range(5):
            # GIVEN a reader that keeps the writer out
            reader = child(read_and_hang)
            assert reader.receive() == 1
            with pytest.raises(BlockTimeoutError):
                mem.platform.get_write_ok(0.01)
            # WHEN it is killed
            reader.kill()
            # THEN the writer goes on, and had no reader to fence
            with mem.platform.write(20.0) as slot:  # far below the lease: the kernel released it
                slot.t_ns += 1
        assert mem.platform.fenced == 0


def test_a_stopped_reader_is_fenced_after_its_lease_and_informed(space, child):
    # a busy machine may delay a writer, but not at every try
    waited = [fence_off(f"{space}-{k}", child) for k in range(3)]
    assert LEASE_S <= min(waited) < LEASE_S + 1.0


def fence_off(space, child):
    """Write beside a reader that was stopped; how long that took [s]."""
    with mem_attach(Words, space, write=True, lease_s=LEASE_S) as mem:
        with mem.words.write() as slot:
            slot.word = [1] * 256

        def read_for_long(me):
            block = mem_attach(Words, space).words
            view, generation = block.get_read_ok()
            me.say(generation)
            os.kill(os.getpid(), signal.SIGSTOP)
            me.say(len(set(view.word)))  # one newer publication has not touched this slot
            me.say(block.read_done() == "stale")
            _, generation = block.get_read_ok()
            me.say(generation)
            me.say(block.read_done() == "ok")

        # GIVEN a reader that is stopped while it reads
        reader = child(read_for_long)
        assert reader.receive() == 1
        os.waitpid(reader.pid, os.WUNTRACED)
        # WHEN the writer writes
        begin = time.monotonic()
        with mem.words.write() as slot:
            slot.word = [2] * 256
        waited = time.monotonic() - begin
        # THEN it waits for the lease, fences the reader, and waits for it no more
        assert mem.words.fenced == 1
        with mem.words.write(LEASE_S / 2) as slot:  # fenced once, it delays no writer again
            slot.word = [2] * 256
        # THEN the reader is told that its values are stale, and its next read is good
        reader.signal(signal.SIGCONT)
        assert [reader.receive() for _ in range(4)] == [1, True, 3, True]
        assert reader.end() == 0
    return waited


def test_the_read_context_raises_when_the_reader_was_fenced(space):
    # GIVEN a short lease
    with mem_attach(Platform, space, write=True, lease_s=0.002) as mem, mem_attach(Platform, space) as theirs:
        with mem.platform.write():
            pass

        # WHEN a read lasts longer than it, THEN the end of the read raises
        def read_too_long():
            with theirs.platform.read():
                mem.platform.get_write_ok()
                mem.platform.write_done()

        with pytest.raises(BlockError, match="outlived its lease"):
            read_too_long()


def test_readers_that_overlap_for_ever_do_not_starve_the_writer(space, child):
    with mem_attach(Words, space, write=True, lease_s=60) as mem:
        with mem.words.write() as slot:
            slot.word = [1] * 256

        def keep_reading(me):
            first, second = (mem_attach(Words, space).words for _ in range(2))
            first.get_read_ok()
            me.say(0)
            n = 0
            while True:  # the next read begins before the last one ends, whenever the door is open
                for a, b in ((first, second), (second, first)):
                    try:
                        b.get_read_ok(0.0)
                    except BlockTimeoutError:
                        a.read_done()
                        b.get_read_ok(10.0)
                    else:
                        a.read_done()
                    n += 1

        # GIVEN readers whose reads overlap without end
        readers = [child(keep_reading) for _ in range(2)]
        for r in readers:
            assert r.receive() == 0
        # WHEN the writer writes, THEN it gets its turn, and fences no reader
        for k in range(20):
            with mem.words.write(20.0) as slot:
                slot.word = [k] * 256
        assert mem.words.fenced == 0


def test_a_writer_that_never_pauses_does_not_starve_readers(space, child):
    def keep_writing(me):
        with mem_attach(Words, space, write=True, lease_s=60) as mem:
            k = 0
            while True:
                k += 1
                with mem.words.write() as slot:
                    slot.word = [k] * 256
                if k == 1:
                    me.say(1)

    # GIVEN a writer that writes without a pause
    writer = child(keep_writing)
    assert writer.receive() == 1
    # WHEN a reader reads, THEN it gets its turn, and whole values in order
    with mem_attach(Words, space) as theirs:
        last = 0
        for _ in range(50):
            with theirs.words.read(20.0) as view:
                assert len(set(view.word)) == 1
                assert theirs.words.generation >= last
                last = theirs.words.generation


def test_a_reader_stopped_in_the_queue_slows_a_busy_writer_once_not_at_every_write(space, child):
    with mem_attach(Platform, space, write=True) as mem, mem_attach(Platform, space) as theirs:

        def wait_for_my_turn(me):
            mem_attach(Platform, space).platform.get_read_ok(30.0)

        # GIVEN a reader that was stopped in the queue
        with mem.platform.write():
            reader = child(wait_for_my_turn)
            until(lambda: theirs.platform._lock.held_elsewhere(QUEUE_BYTE), "a reader in the queue")
            reader.signal(signal.SIGSTOP)

        # WHEN the writer writes often, THEN it waits for that reader once
        def write_often():
            for _ in range(500):
                with mem.platform.write():
                    pass

        assert quickest(write_often) < 0.5  # 500 times 2 ms of grace would be a second


def times_asleep(pid):
    """How often a process went to sleep by itself."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("voluntary_ctxt_switches"))


def test_a_writer_that_was_itself_stopped_does_not_fence_readers_for_it(space, child):
    go_r, go_w = os.pipe()

    def write_once(me):
        block = mem_attach(Platform, space, write=True, lease_s=2.0).platform
        with block.write():
            pass
        me.say(1)
        os.read(go_r, 1)
        with block.write(30.0):
            pass
        me.say(block.fenced)

    # GIVEN a writer that waits for a reader
    writer = child(write_once)
    assert writer.receive() == 1
    with mem_attach(Platform, space) as theirs:
        theirs.platform.get_read_ok()
        os.write(go_w, b"x")
        until(lambda: theirs.platform._words[WAITING_WORD], "a writer that waits")
        # WHEN the writer is stopped for longer than the lease
        writer.signal(signal.SIGSTOP)
        begin, looks = time.monotonic(), times_asleep(writer.pid)
        until(lambda: time.monotonic() > begin + 2.1, "the end of the lease")  # which is what is tested
        writer.signal(signal.SIGCONT)
        until(lambda: times_asleep(writer.pid) > looks + 10, "the writer's looking again")
        # THEN the reader was not fenced
        assert theirs.platform.read_done() == "ok"
    assert writer.receive() == 0


def test_a_writer_killed_half_way_leaves_the_previous_generation_and_its_successor_goes_on(space, child):
    def write_half(me):
        block = mem_attach(Words, space, write=True).words
        slot = block.get_write_ok()
        slot.word = [block.epoch % 1000] * 256
        block.write_done()
        slot = block.get_write_ok()
        slot.array("word")[:128] = memoryview(bytes(8 * 128)).cast("q")
        me.say(block.epoch)
        forever()

    epochs = []
    for k in range(3):
        # GIVEN a writer in the middle of a write
        writer = child(write_half)
        epochs.append(writer.receive())
        with mem_attach(Words, space) as theirs:
            with pytest.raises(BlockTimeoutError, match=f"process {writer.pid} did not finish"):
                theirs.words.get_read_ok(0.01)
            # WHEN it is killed
            writer.kill()
            # THEN readers have the generation before
            with theirs.words.read(20.0) as view:
                assert set(view.word) == {epochs[-1] % 1000}
            assert theirs.words.latest().generation == k + 1
            assert not theirs.words.writer_alive()
    # THEN each writer went on from its predecessor
    assert epochs == [epochs[0], epochs[0] + 1, epochs[0] + 2]


def test_a_writer_killed_while_it_waits_does_not_keep_readers_out(space, child):
    def wait_for_ever(me):
        block = mem_attach(Platform, space, write=True, lease_s=60).platform
        with block.write():
            pass
        me.say(1)
        me.say(2 if os.read(go_r, 1) else 0)
        block.get_write_ok(60.0)

    go_r, go_w = os.pipe()
    # GIVEN a writer that waits for a reader and keeps others out
    writer = child(wait_for_ever)
    assert writer.receive() == 1
    with mem_attach(Platform, space) as first, mem_attach(Platform, space) as second:
        first.platform.get_read_ok()
        os.write(go_w, b"x")
        assert writer.receive() == 2

        def closed():
            try:
                second.platform.get_read_ok(0.0)
                second.platform.read_done()
            except BlockTimeoutError:
                return True
            return False

        until(closed, "the door of the waiting writer")
        # WHEN it is killed
        writer.kill()
        # THEN the others may read, and the first reader is not fenced
        second.platform.get_read_ok(20.0)
        assert second.platform.read_done() == "ok"
        assert first.platform.read_done() == "ok"


def killed_at(lines):
    """A trace that kills this process before it runs so many lines of the package."""
    left = lines

    def hook(frame, event, _):
        nonlocal left
        if event == "line" and f"{os.sep}surffollow{os.sep}" in frame.f_code.co_filename:
            left -= 1
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)
        return hook

    return hook


def test_makers_killed_at_any_moment_leave_nothing_that_a_successor_must_clean(space, child):
    def make(_, at):
        sys.settrace(killed_at(at))
        mem_attach(Words, space, write=True).words.get_write_ok()

    # GIVEN makers of a block that were killed at every step
    for lines in range(1, 2000, STEP):
        if child(partial(make, at=lines)).end() == 0:
            break
    assert 10 * STEP < lines < 2000, "makers were killed, and the last one came to its end"
    # THEN what they left is the block and its lock, and the next one makes the block
    left = {p.name for p in Path("/dev/shm").glob(f"{space}*")}
    assert left <= {f"{space}.words", f"{space}.words.lock"}
    with mem_attach(Words, space, write=True) as mem, mem.words.write() as slot:
        slot.word = [1] * 256
