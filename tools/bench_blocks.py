"""User blocks under deaths: trials of readers and writers that are killed, stopped or never let go.

Four kinds of trial in turn, each with children that attach by themselves (forked from a small process):

killed    a reader is killed inside a read while the writer waits: time from its death to the writer's turn
stopped   a reader is stopped inside a read: the writer goes on after the lease, the reader is told "stale"
overlap   two readers whose reads overlap without a gap: the writer writes ten times; they are killed reading
half-way  a writer is killed at a random moment of its writes; its successor goes on from what was published

The writer's process asks for SCHED_FIFO, as a controller would, and so do the readers that are killed or
stopped: on a busy machine the time to be scheduled would be measured instead. The granted policy is noted.
Every publication is 2 KiB of one number, its generation: a mixture or a loss shows. Then the times of
uncontended calls, measured call by call with perf_counter_ns around them (which costs some 50 ns of each).

    python tools/bench_blocks.py [--trials 1000] [--seed 91] [--json]
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

from block_trials import LEASE_S, Trials, ask_fifo
from report import criterion, finish, result
from surffollow.blocks import I64, Block, mem_attach
from surffollow.shm.objects import unlink

DEAD_READER_MS, CALL_US, LATEST_US = 5.0, 10.0, 1.5


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
    """Run the trials and the calls, hold them against the criteria."""
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
    return result(
        f"user blocks: {o.trials} trials of deaths, and uncontended calls",
        [
            criterion("dead reader delays the writer, max", most(late), DEAD_READER_MS, "ms"),
            criterion("stopped reader, beyond its lease, max", most(beyond), DEAD_READER_MS, "ms"),
            criterion("torn reads", trials.torn, 0, ""),
            criterion("lost generations", trials.lost, 0, ""),
            criterion("starved writes", trials.starved, 0, ""),
            criterion("fenced readers not told", trials.verdicts, 0, ""),
            criterion("uncontended read p50", calls["read"][0], CALL_US, "µs"),
            criterion("uncontended write p50", calls["write"][0], CALL_US, "µs"),
            criterion("latest p50", calls["latest"][0], LATEST_US, "µs"),
        ],
        notes,
        calls_us=calls,
        scheduling=granted,
        waited_for_dead=len(late),
        died_within_a_slot=trials.half,
    )


if __name__ == "__main__":
    sys.exit(finish(main()))
