"""The cycle thread: wake, requests, conversions, one step, publish, log, hand samples to the map."""

from __future__ import annotations

from typing import Any

from surffollow.forecast.step import follow_step
from surffollow.hw.driver import REPORT_WORDS
from surffollow.service import memory as m
from surffollow.service.answers import count
from surffollow.service.conversion_watch import drain_conversions
from surffollow.service.map_preview import fill_preview
from surffollow.service.range_inputs import any_held, drain_ranges
from surffollow.service.requests import process_requests
from surffollow.service.slot_inputs import POSE_BAD, POSE_OK, POSE_TORN, read_pose
from surffollow.service.stop_latch import keep_stop
from surffollow.service.window_watch import watch_window
from surffollow.shm import atomics as at
from surffollow.shm import journal
from surffollow.shm.clock import now_ns, wait_until_ns
from surffollow.shm.cycle_log import log_append
from surffollow.shm.jit import jit_uncounted
from surffollow.shm.latch import latch_write
from surffollow.shm.layout_board import HISTOGRAM_BINS, Stats
from surffollow.shm.layout_follow import Output
from surffollow.shm.ring import ring_push

_OUTPUT_BYTES = Output.SIZE
_CYCLES = Stats.offset("cycles")
_OVERRUNS = Stats.offset("overruns")
_SKIPPED = Stats.offset("skipped")
_POSES = Stats.offset("poses")
_POSES_REFUSED = Stats.offset("poses_refused")
_TORN = Stats.offset("torn")
_LATENESS = Stats.offset("lateness")
_LATENESS_MAX = Stats.offset("lateness_max_ns")
_EXECUTION = Stats.offset("execution")
_EXECUTION_MAX = Stats.offset("execution_max_ns")
_SAMPLES = Stats.offset("samples")


@jit_uncounted
def histogram_bin(t_ns: Any) -> Any:
    """Bin of a duration: exact below 8 ns, then 8 bins per octave (`client.histogram_report` inverts it)."""
    if t_ns < 8:
        return max(t_ns, 0)
    octave = 0
    while (t_ns >> octave) >= 16:
        octave += 1
    return min(octave * 8 + (t_ns >> octave), HISTOGRAM_BINS - 1)


@jit_uncounted
def count_duration(stats: Any, histogram: Any, longest: Any, t_ns: Any) -> None:
    """Add one duration to a histogram and its maximum.

    Parameters
    ----------
    stats : int64             address of the statistics
    histogram, longest : int  offsets of the histogram and of the maximum [bytes]
    t_ns : int64 [ns]         the duration
    """
    count(stats, histogram + 8 * histogram_bin(t_ns), 1)
    if t_ns > at.load_relaxed_i64(stats + longest):
        at.store_relaxed_i64(stats + longest, t_ns)


@jit_uncounted
def push_samples(mem: Any) -> None:
    """Hand every fresh target point to the map thread."""
    ctx, output, item = mem.ctx, mem.output[0], mem.item
    fresh = output.fresh
    for c in range(mem.params[0].n_channels):
        if (fresh >> c) & 1 == 0:
            continue
        count(ctx[m.STATS], _SAMPLES, 1)
        item[0] = 0
        for i in range(3):
            mem.item_floats[1 + i] = output.target_m[3 * c + i]
        if ring_push(ctx[m.SAMPLES], ctx[m.SAMPLES_CAPACITY], m.SAMPLE_WORDS, item.ctypes.data) == 0:
            lost = ctx.ctypes.data + 8 * m.LOST
            at.store_relaxed_i64(lost, at.load_relaxed_i64(lost) + 1)


@jit_uncounted
def log_snapshot(mem: Any, t_ns: Any) -> None:
    """Write a SNAPSHOT entry: parameters and state before this cycle."""
    entry = mem.entry
    entry[0], entry[1] = journal.entry_head(journal.SNAPSHOT, journal.SNAPSHOT_WORDS), t_ns
    for i in range(journal.PARAMS_WORDS):
        entry[2 + i] = mem.param_words[i]
    for i in range(journal.STATE_WORDS):
        entry[2 + journal.PARAMS_WORDS + i] = mem.state_words[i]
    log_append(mem.ctx[m.LOG], mem.ctx[m.LOG_CAPACITY], entry.ctypes.data, journal.SNAPSHOT_WORDS)


@jit_uncounted
def hand_report(mem: Any) -> None:
    """Give the pose that was just accepted to the simulated sensor, when there is one."""
    ctx, inputs = mem.ctx, mem.inputs[0]
    mem.entry[0] = inputs.pose_t_ns[0]
    for i in range(7):
        mem.entry_floats[1 + i] = inputs.pose[i]
    ring_push(ctx[m.REPORTS], ctx[m.REPORTS_CAPACITY], REPORT_WORDS, mem.entry.ctypes.data)


@jit_uncounted
def take_inputs(mem: Any, t_ns: Any) -> None:
    """The cycle before its step: requests first, then data."""
    ctx = mem.ctx
    process_requests(mem, t_ns)
    if mem.state[0].cycle % ctx[m.SNAPSHOT_CYCLES] == 0:
        log_snapshot(mem, t_ns)
    answer = read_pose(mem, t_ns)
    if answer == POSE_OK:
        count(ctx[m.STATS], _POSES, 1)
        if ctx[m.REPORTS] != 0:
            hand_report(mem)
    elif answer == POSE_BAD:
        count(ctx[m.STATS], _POSES_REFUSED, 1)
    elif answer == POSE_TORN:
        count(ctx[m.STATS], _TORN, 1)
    if any_held(ctx):
        drain_ranges(mem, t_ns)
    drain_conversions(mem, t_ns)
    watch_window(mem)
    mem.inputs[0].t_ns = t_ns
    fill_preview(mem)


@jit_uncounted
def give_outputs(mem: Any, stop: Any, t_ns: Any) -> None:
    """The cycle after its step; `stop` are the causes of a stop before it."""
    ctx = mem.ctx
    keep_stop(mem, stop, t_ns)
    mem.output[0].epoch = ctx[m.EPOCH]
    latch_write(ctx[m.OUTPUT], mem.output.ctypes.data, _OUTPUT_BYTES)
    n = journal.encode_cycle(mem.entry, mem.entry_floats, mem.inputs, mem.output)
    log_append(ctx[m.LOG], ctx[m.LOG_CAPACITY], mem.entry.ctypes.data, n)
    push_samples(mem)
    count(ctx[m.STATS], _CYCLES, 1)


@jit_uncounted
def one_cycle(mem: Any, t_ns: Any) -> None:
    """All of a cycle but the waiting."""
    take_inputs(mem, t_ns)
    stop = mem.state[0].stop
    follow_step(mem.params, mem.state, mem.inputs, mem.output, mem.pose)
    give_outputs(mem, stop, t_ns)


@jit_uncounted
def run_cycles(mem: Any, first_ns: Any, most_cycles: Any) -> Any:
    """Cycle until STOP is set, or `most_cycles` were run; the number of cycles.

    An overrun is a cycle that ends after the next deadline. Policy skip: the missed
    deadlines are dropped and counted; policy catch-up: every one is run, late.
    """
    ctx = mem.ctx
    base, stats = ctx.ctypes.data, ctx[m.STATS]
    period, spin = ctx[m.PERIOD_NS], ctx[m.SPIN_NS]
    deadline, cycles = first_ns, 0
    while cycles < most_cycles and at.load_relaxed_i64(base + 8 * m.STOP) == 0:
        t_ns = wait_until_ns(deadline, spin)
        while t_ns < deadline:  # a signal ended the sleep
            t_ns = wait_until_ns(deadline, spin)
        count_duration(stats, _LATENESS, _LATENESS_MAX, t_ns - deadline)
        one_cycle(mem, t_ns)
        end = now_ns()
        count_duration(stats, _EXECUTION, _EXECUTION_MAX, end - t_ns)
        deadline += period
        if end > deadline:
            count(stats, _OVERRUNS, 1)
            if ctx[m.CATCH_UP] == 0:
                missed = (end - deadline) // period + 1
                deadline += missed * period
                count(stats, _SKIPPED, missed)
        cycles += 1
    return cycles
