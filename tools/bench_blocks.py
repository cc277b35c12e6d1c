"""User blocks under deaths: trials of readers and writers that are killed, stopped or never let go.

Four kinds of trial in turn, each with children that attach by themselves (forked from a small process):

killed    a reader is killed inside a read while the writer waits: time from its death to the writer's turn
stopped   a reader is stopped inside a read: the writer goes on after the lease, the reader is told "stale"
overlap   two readers whose reads overlap without a gap: the writer writes ten times; they are killed reading
half-way  a writer is killed at a random moment of its writes; its successor goes on from what was published

The writer's process asks for SCHED_FIFO, as a controller would, and so do the readers that are killed or
stopped: on a busy machine the time to be scheduled would be measured instead. What was granted is noted.
Every publication is 2 KiB of one number, its generation: a mixture or a loss shows. Then the times of
uncontended calls, measured call by call with perf_counter_ns around them (which costs some 50 ns of each).

    python tools/bench_blocks.py [--trials 1000] [--seed 91] [--json]
"""

from __future__ import annotations

import argparse
import os
import platform
import random
import signal
import struct
import sys
import time
from collections.abc import Callable
from typing import Any

from report import bar, finish
from surffollow.blocks import I64, AttachedBlock, Block, mem_attach
from surffollow.blocks import layout as bl
from surffollow.errors import BlockTimeoutError
from surffollow.shm.latch_shape import SLOTS
from surffollow.shm.objects import unlink

WORDS = 256
LEASE_S = 0.02
LONG_S = 30.0
TORN = -2
FIFO_PRIORITY = 20
DEAD_READER_MS, CALL_US, LATEST_US = 5.0, 10.0, 1.5


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

    def hear(self) -> int:
        data = os.read(self._up, 8)
        if len(data) < 8:
            raise SystemExit("a child ended before it answered")
        return int(struct.unpack("<q", data)[0])

    def last_heard(self) -> int:
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
        self.torn = self.lost = self.starved = self.unwaited = self.verdicts = 0
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

    def relet(self, lease_s: float) -> None:
        """Become the writer anew, with another lease."""
        self.block.close(keep=True)
        self.block = self.attach(lease_s)

    # -- the trials -------------------------------------------------------------------------------

    def killed(self) -> None:
        pause = self.random.uniform(0.001, 0.003)

        def work(me: Child) -> None:
            mem_attach(Words, self.name).words.get_read_ok()
            me.say(1)
            me.hear()
            time.sleep(pause)
            me.say(time.monotonic_ns())
            os.kill(os.getpid(), signal.SIGKILL)

        child = Child(work)
        child.hear()
        child.say(1)
        called = time.monotonic_ns()
        turn = self.write()
        died = child.hear()
        child.bury()
        if called < died:
            self.late_ms.append((turn - died) / 1e6)
        else:
            self.unwaited += 1

    def stopped(self) -> None:
        def work(me: Child) -> None:
            block = mem_attach(Words, self.name).words
            view, _ = block.get_read_ok()
            me.say(1)
            os.kill(os.getpid(), signal.SIGSTOP)
            whole = len(set(view.word)) == 1
            me.say(whole and block.read_done() == "stale")

        self.relet(LEASE_S)
        child = Child(work)
        child.hear()
        os.waitpid(child.pid, os.WUNTRACED)
        called = time.monotonic_ns()
        self.lease_ms.append((self.write() - called) / 1e6)
        os.kill(child.pid, signal.SIGCONT)
        self.verdicts += child.hear() != 1
        child.bury()
        self.relet(LONG_S)

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
            child.hear()
        for _ in range(10):
            called = time.monotonic_ns()
            try:
                self.overlap_ms.append((self.write(5.0) - called) / 1e6)
            except BlockTimeoutError:
                self.starved += 1
        for child in children:
            child.kill()
            self.torn += child.last_heard() == TORN
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
        child.hear()
        time.sleep(self.random.uniform(0.0, 0.002))
        child.kill()
        published = child.last_heard()
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


def call_times_us(name: str) -> dict[str, tuple[float, float]]:
    """p50 and p99 of uncontended calls [µs]."""

    class Small(Block):
        """A pose and a counter."""

        t_ns = I64()
        word = I64(8)

    writer = mem_attach(Small, name, write=True).small
    reader = mem_attach(Small, name).small
    with writer.write() as slot:
        slot.t_ns = 1

    def write() -> None:
        writer.get_write_ok().t_ns = 1
        writer.write_done()

    def read() -> None:
        _ = reader.get_read_ok()[0].t_ns
        reader.read_done()

    def snapshot() -> None:
        reader.latest()

    out = {}
    for label, call in (("write", write), ("read", read), ("latest", snapshot)):
        times = []
        for _ in range(20_000):
            begin = time.perf_counter_ns()
            call()
            times.append(time.perf_counter_ns() - begin)
        times.sort()
        out[label] = (times[len(times) // 2] / 1e3, times[int(len(times) * 0.99)] / 1e3)
    writer.close()
    return out


def most(values: list[float]) -> float | None:
    return max(values) if values else None


def main() -> dict[str, Any]:
    """Run the trials and the calls, hold them against the bars."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=91)
    parser.add_argument("--json", action="store_true")
    o = parser.parse_args()
    granted = ask_fifo(True)
    trials = Trials(o.seed)
    begin = time.monotonic()
    try:
        trials.run(o.trials)
        seconds = time.monotonic() - begin
        ask_fifo(False)
        calls = call_times_us(trials.name)
    finally:
        trials.block.close()
        unlink(f"{trials.name}.small")
    late, lease = sorted(trials.late_ms), trials.lease_ms
    beyond = [ms - 1e3 * LEASE_S for ms in lease]
    notes = [f"{label}: p50 {p50:.2f} µs, p99 {p99:.2f} µs" for label, (p50, p99) in calls.items()]
    notes.append(granted)
    notes.append(f"{o.trials} trials, {trials.value} publications in {seconds:.0f} s, seed {o.seed}")
    notes.append(
        f"{len(late)} writers waited for a reader that died; {trials.half} writers died within a slot"
    )
    if late:
        notes.append(
            f"dead reader delays the writer: p50 {late[len(late) // 2]:.3f} ms, max {late[-1]:.3f} ms"
        )
    if trials.overlap_ms:
        notes.append(f"a write among overlapping readers: max {max(trials.overlap_ms):.2f} ms")
    return {
        "what": f"user blocks: {o.trials} trials of deaths, and uncontended calls",
        "machine": f"{platform.machine()}, {platform.release()}, {os.cpu_count()} processors",
        "calls_us": calls,
        "scheduling": granted,
        "waited_for_dead": len(late),
        "died_within_a_slot": trials.half,
        "bars": [
            bar("dead reader delays the writer, max", most(late), DEAD_READER_MS, "ms"),
            bar("stopped reader, beyond its lease, max", most(beyond), DEAD_READER_MS, "ms"),
            bar("torn reads", trials.torn, 0, ""),
            bar("lost generations", trials.lost, 0, ""),
            bar("starved writes", trials.starved, 0, ""),
            bar("fenced readers not told", trials.verdicts, 0, ""),
            bar("uncontended read p50", calls["read"][0], CALL_US, "µs"),
            bar("uncontended write p50", calls["write"][0], CALL_US, "µs"),
            bar("latest p50", calls["latest"][0], LATEST_US, "µs"),
        ],
        "notes": notes,
    }


if __name__ == "__main__":
    sys.exit(finish(main()))
