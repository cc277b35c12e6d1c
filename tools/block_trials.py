"""The trials of bench_blocks.py: a writer, and children of it that are killed, stopped or never let go."""

from __future__ import annotations

import os
import random
import signal
import struct
import time
from collections.abc import Callable

from surffollow.blocks import I64, AttachedBlock, Block, mem_attach
from surffollow.blocks import layout as bl
from surffollow.errors import BlockTimeoutError
from surffollow.shm.latch_shape import SLOTS

WORDS = 256
LEASE_S = 0.02
LONG_S = 30.0
TORN = -2
FIFO_PRIORITY = 20


class Words(Block):
    """One number, many times."""

    word = I64(WORDS)


def ask_fifo(fifo: bool) -> str:
    """Run this process under SCHED_FIFO, or no longer; what came of it."""
    policy, priority = (os.SCHED_FIFO, FIFO_PRIORITY) if fifo else (os.SCHED_OTHER, 0)
    try:
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except OSError as e:
        return f"SCHED_FIFO refused ({e.strerror}): the delays are those of the machine's load as well"
    return f"SCHED_FIFO {FIFO_PRIORITY} granted"


class Child:
    """A forked child and the pipes to it; numbers of 8 bytes each way."""

    def __init__(self, work: Callable[[Child], None]) -> None:
        self._up, up_w = os.pipe()
        down_r, self._down = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            self._up, self._down = down_r, up_w
            signal.alarm(60)  # it must not outlive a bench that was killed
            try:
                work(self)
            finally:
                os._exit(0)
        os.close(up_w)
        os.close(down_r)

    def say(self, number: int) -> None:
        os.write(self._down, struct.pack("<q", number))

    def receive(self) -> int:
        data = os.read(self._up, 8)
        if len(data) < 8:
            raise SystemExit("a child ended before it answered")
        return int(struct.unpack("<q", data)[0])

    def last_received(self) -> int:
        """The last number said before the child's end that was not heard yet; -1: none."""
        data = b""
        while part := os.read(self._up, 1 << 16):
            data += part
        return int(struct.unpack("<q", data[-8:])[0]) if data else -1

    def kill(self) -> None:
        os.kill(self.pid, signal.SIGKILL)

    def bury(self) -> None:
        os.waitpid(self.pid, 0)
        os.close(self._up)
        os.close(self._down)


class Trials:
    """The writer's process and what it counts."""

    def __init__(self, seed: int) -> None:
        self.name, self.random = f"benchblocks-{os.getpid()}", random.Random(seed)
        self.block: AttachedBlock = self.attach()
        self.value = 0
        self.torn = self.lost = self.starved = self.verdicts = 0
        self.late_ms: list[float] = []
        self.lease_ms: list[float] = []
        self.overlap_ms: list[float] = []
        self.half = 0
        self.write()

    def attach(self, lease_s: float = LONG_S) -> AttachedBlock:
        return mem_attach(Words, self.name, write=True, lease_s=lease_s).words

    def write(self, timeout_s: float = 10.0) -> int:
        """One publication; returns when the writer got its turn [ns]."""
        slot = self.block.get_write_ok(timeout_s)
        turn = time.monotonic_ns()
        self.value = self.block.generation + 1
        slot.word = [self.value] * WORDS
        if self.block.write_done() != self.value:
            self.lost += 1
        self.look(self.value)
        return turn

    def look(self, at_least: int) -> None:
        """Compare what a reader gets now with what must be there."""
        with mem_attach(Words, self.name).words.read() as view:
            values = set(view.word)
        self.torn += len(values) != 1
        self.lost += min(values) < at_least

    def reattach_writer(self, lease_s: float) -> None:
        """Become the writer anew, with another lease."""
        self.block.close(keep=True)
        self.block = self.attach(lease_s)

    # -- the trials -------------------------------------------------------------------------------

    def killed(self) -> None:
        pause = self.random.uniform(0.001, 0.003)

        def work(me: Child) -> None:
            mem_attach(Words, self.name).words.get_read_ok()
            me.say(1)
            me.receive()
            time.sleep(pause)
            me.say(time.monotonic_ns())
            os.kill(os.getpid(), signal.SIGKILL)

        child = Child(work)
        child.receive()
        child.say(1)
        called = time.monotonic_ns()
        turn = self.write()
        died = child.receive()
        child.bury()
        if called < died:  # else the writer had not to wait
            self.late_ms.append((turn - died) / 1e6)

    def stopped(self) -> None:
        def work(me: Child) -> None:
            block = mem_attach(Words, self.name).words
            view, _ = block.get_read_ok()
            me.say(1)
            os.kill(os.getpid(), signal.SIGSTOP)
            whole = len(set(view.word)) == 1
            me.say(whole and block.read_done() == "stale")

        self.reattach_writer(LEASE_S)
        child = Child(work)
        child.receive()
        os.waitpid(child.pid, os.WUNTRACED)
        called = time.monotonic_ns()
        self.lease_ms.append((self.write() - called) / 1e6)
        os.kill(child.pid, signal.SIGCONT)
        self.verdicts += child.receive() != 1
        child.bury()
        self.reattach_writer(LONG_S)

    def overlap(self) -> None:
        def work(me: Child) -> None:
            ask_fifo(False)  # it never sleeps
            blocks = [mem_attach(Words, self.name).words for _ in range(2)]
            held = blocks[0]
            view, generation = held.get_read_ok()
            me.say(1)
            while True:
                if set(view.word) != {generation}:
                    me.say(TORN)
                other = blocks[held is blocks[0]]
                try:
                    view, generation = other.get_read_ok(0.0)
                    held.read_done()
                except BlockTimeoutError:  # the door is closed: the writer waits
                    held.read_done()
                    view, generation = other.get_read_ok(10.0)
                held = other

        children = [Child(work) for _ in range(2)]
        for child in children:
            child.receive()
        for _ in range(10):
            called = time.monotonic_ns()
            try:
                self.overlap_ms.append((self.write(5.0) - called) / 1e6)
            except BlockTimeoutError:
                self.starved += 1
        for child in children:
            child.kill()
            self.torn += child.last_received() == TORN
            child.bury()

    def half_way(self) -> None:
        def work(me: Child) -> None:
            ask_fifo(False)
            block = mem_attach(Words, self.name, write=True).words
            me.say(block.generation)
            while True:
                slot = block.get_write_ok()
                value = block.generation + 1
                words = slot.array("word")
                for k in range(WORDS):
                    words[k] = value
                    if k == WORDS // 2:
                        time.sleep(50e-6)  # so that many die here
                block.write_done()
                me.say(value)

        epoch = self.block.epoch
        self.block.close(keep=True)
        child = Child(work)
        child.receive()
        time.sleep(self.random.uniform(0.0, 0.002))
        child.kill()
        published = child.last_received()
        child.bury()
        self.look(published)
        self.block = self.attach(LONG_S)
        snapshot = self.block.latest()
        self.lost += snapshot.stale or snapshot.generation < published or self.block.epoch != epoch + 2
        self.lost += snapshot["word"][0] != snapshot.generation
        self.half += self.slot_is_mixed()
        self.write()

    def slot_is_mixed(self) -> bool:
        """Whether the killed writer left a half-written slot: the trial's case happened."""
        block = self.block
        latch = bl.read_header(block._memory)["latch_offset"]
        _, first, stride = bl.slot_places(Words, latch)
        at = first + ((block.generation + 1) % SLOTS) * stride + bl.HEAD
        words = struct.unpack_from(f"<{WORDS}q", block._memory, at)
        return len(set(words)) > 1

    def run(self, n: int) -> None:
        kinds = (self.killed, self.stopped, self.overlap, self.half_way)
        for k in range(n):
            kinds[k % len(kinds)]()
