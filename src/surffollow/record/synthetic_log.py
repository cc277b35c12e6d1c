"""Write a cycle log without a daemon: the follower's kernels on invented inputs, for trials and benchmarks.

The order is the service's: SNAPSHOT at the start and every `snapshot_cycles`, then
PARAMS, RESET or STOP before the cycle they change, then the CYCLE entry.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.config.params import PARAMS
from surffollow.forecast.step import follow_step, reset_stop, sf_reset
from surffollow.forecast.stop import latch_stop
from surffollow.shm import journal
from surffollow.shm.conversion import FLAG_INVALID, pack_conversion
from surffollow.shm.cycle_log import log_append
from surffollow.shm.dtypes import zeros
from surffollow.shm.jit import jit
from surffollow.shm.journal import (
    CYCLE_MAX,
    PARAMS_WORDS,
    RESET,
    SNAPSHOT,
    SNAPSHOT_WORDS,
    STATE_WORDS,
    STOP,
    encode_cycle,
    entry_head,
)
from surffollow.shm.layout_board import LogHead
from surffollow.shm.layout_follow import CHANNELS, STOP_REQUEST, FollowState, Inputs, Output, Params

NS_PER_S = 1_000_000_000
SPEED_MPS = 0.05
RANGE_M, SWELL_M, WAVELENGTH_M = 0.1, 0.005, 0.3


@jit
def noise(seed: Any) -> Any:
    """A reproducible number in [-1, 1) from an integer (SplitMix64's mixing)."""
    z = (seed + 0x9E3779B97F4A7C) * 6364136223846793005
    z = (z ^ ((z >> 30) & 0x3FFFFFFFF)) * 1181783497276652981
    z = (z ^ ((z >> 27) & 0x1FFFFFFFFF)) * 2685821657736338717
    return ((z >> 11) & 0x1FFFFFFFFFFFFF) / 4503599627370496.0 - 1.0


@jit
def synthesise_inputs(
    params: Any, inputs: Any, cycle: Any, seed: Any, per_cycle: Any, period_ns: Any
) -> None:
    """A cycle's conversions and poses: a swell under a tool at constant speed, noise, losses, odd poses.

    Parameters
    ----------
    params : (1,) record of `Params`  calibration of the channels
    inputs : (1,) record of `Inputs`  receives the inputs
    cycle, seed : int  number of the cycle, and of the noise
    per_cycle : int    conversions in a cycle
    period_ns : int    length of a cycle
    """
    p, i = params[0], inputs[0]
    t_ns = NS_PER_S + cycle * period_ns
    i.t_ns = t_ns
    i.n_conversions = per_cycle
    lost = (cycle // 700) % 5 == 4
    for k in range(per_cycle):
        x = SPEED_MPS * (cycle * period_ns) * 1e-9
        r = RANGE_M + SWELL_M * math.sin(2.0 * math.pi * x / WAVELENGTH_M)
        r += 2.5e-4 * noise(seed + cycle * 64 + k)
        channel = k % p.n_channels
        counts = round((r - p.zero_m[channel]) / p.scale_m[channel])
        flags = FLAG_INVALID if lost or noise(seed - cycle * 64 - k) > 0.99 else 0
        dt_ns = -((per_cycle - k) * period_ns) // (per_cycle + 1)
        i.conversion[k] = pack_conversion(counts, channel, flags, dt_ns)
    i.n_ranges = 0
    i.n_poses = 0
    if cycle % 10 == 3:
        i.n_poses = 1 if noise(seed ^ cycle) < 0.9 else 2
        for k in range(i.n_poses):
            age_ns = 10_000_000 - k * 1_000_000
            i.pose_t_ns[k] = t_ns - age_ns
            for j in range(7):
                i.pose[7 * k + j] = 0.0
            i.pose[7 * k] = SPEED_MPS * ((cycle * period_ns - age_ns) * 1e-9)
            i.pose[7 * k + 2] = 0.2 + 5e-5 * noise(seed + 7 * cycle + k)
            i.pose[7 * k + 6] = 1.0


@jit
def append_event(log: Any, capacity: Any, words: Any, address: Any, kind: Any, t_ns: Any, n: Any) -> None:
    """Append the entry whose words from the third on are already in `words`.

    Parameters
    ----------
    log, capacity : int64  as in `log_append`
    words : (≥ n,) int64   the entry; the first two words are written
    address : int64        of `words`
    kind : int             of the entry
    t_ns : int64
    n : int                words of the entry
    """
    words[0], words[1] = entry_head(kind, n), t_ns
    log_append(log, capacity, address, n)


@jit
def simulate_cycles(
    log: Any, capacity: Any, words: Any, floats: Any, address: Any, records: Any, views: Any, plan: Any
) -> None:
    """Step `plan.cycles` cycles and log them.

    Parameters
    ----------
    log, capacity, address : int64        the log, its words, and where `words` lies
    words, floats : (≥ SNAPSHOT_WORDS,) int64, float64   the same scratch memory
    records : (params, state, inputs, output, scratch)
    views : (params, state) as int64 words
    plan : (6,) int64  first cycle, cycles, snapshot interval, seed, conversions per cycle, period [ns]
    """
    params, state, inputs, output, scratch = records
    params_words, state_words = views
    for cycle in range(plan[0], plan[0] + plan[1]):
        t_ns = NS_PER_S + cycle * plan[5]
        if cycle % plan[2] == 0:
            words[2 : 2 + PARAMS_WORDS] = params_words
            words[2 + PARAMS_WORDS : 2 + PARAMS_WORDS + STATE_WORDS] = state_words
            append_event(log, capacity, words, address, SNAPSHOT, t_ns, SNAPSHOT_WORDS)
        if cycle % 1900 == 1500:
            params[0].permitted_variance_m = 1e-5 * (1 + (cycle // 1900) % 3)
            words[2 : 2 + PARAMS_WORDS] = params_words
            append_event(log, capacity, words, address, journal.PARAMS, t_ns, 2 + PARAMS_WORDS)
        if cycle % 2300 == 1700:
            offset_m = RANGE_M + 1e-3 * ((cycle // 2300) % 4)
            sf_reset(params, state, offset_m)
            floats[2] = offset_m
            append_event(log, capacity, words, address, RESET, t_ns, 3)
        if cycle % 2900 == 2100:
            latch_stop(state, STOP_REQUEST)
            words[2] = STOP_REQUEST
            append_event(log, capacity, words, address, STOP, t_ns, 3)
        elif cycle % 2900 == 2250:
            reset_stop(params, state)
            words[2] = 0
            append_event(log, capacity, words, address, STOP, t_ns, 3)
        synthesise_inputs(params, inputs, cycle, plan[3], plan[4], plan[5])
        follow_step(params, state, inputs, output, scratch)
        log_append(log, capacity, address, encode_cycle(words, floats, inputs, output))


def default_params(mode: int = 0, channels: int = 1) -> NDArray[Any]:
    """A (1,) record of `Params` with the table's defaults, a 12-bit calibration and mounts looking down."""
    params = zeros(Params)
    for name, spec in PARAMS.items():
        params[name] = spec.default
    params["mode"], params["n_channels"] = mode, channels
    span_m = PARAMS["range_max_m"].default - PARAMS["range_min_m"].default
    params["scale_m"] = span_m / 4095.0
    params["zero_m"] = PARAMS["range_min_m"].default
    params["tool_from_sensor"][0].reshape(CHANNELS, 7)[:, 6] = 1.0
    return params


class SyntheticLog:
    """A private cycle log that is filled on request; offers the recorder's interface to a service's log.

    Parameters
    ----------
    capacity : int           words of the log, a power of two
    mode, channels : int     `Params.mode` and `n_channels`
    conversions : int        per cycle, all channels together
    """

    def __init__(
        self,
        capacity: int = 1 << 18,
        *,
        mode: int = 0,
        channels: int = 1,
        conversions: int = 25,
        seed: int = 1,
        snapshot_cycles: int = 1000,
        period_ns: int = 1_000_000,
        epoch: int = 1,
    ) -> None:
        self.capacity, self.epoch = capacity, epoch
        self.memory = np.zeros(LogHead.SIZE // 8 + capacity, np.int64)
        self.memory[LogHead.offset("capacity") // 8] = capacity
        self.params = default_params(mode, channels)
        self.state, self.inputs, self.output = zeros(FollowState), zeros(Inputs), zeros(Output)
        self.scratch = np.zeros(7)
        self.words = np.zeros(max(SNAPSHOT_WORDS, CYCLE_MAX), np.int64)
        self.plan = np.array([0, 0, snapshot_cycles, seed, conversions, period_ns], np.int64)
        self.running = True

    @property
    def address(self) -> int:
        """Address of the log's head."""
        return int(self.memory.ctypes.data)

    def alive(self) -> bool:
        """Whether the log still has a writer."""
        return self.running

    def reattach(self) -> bool:
        """There is never a newer log."""
        return False

    def run(self, cycles: int) -> None:
        """Step and log that many cycles more."""
        self.plan[1] = cycles
        records = (self.params, self.state, self.inputs, self.output, self.scratch)
        views = (self.params.view(np.int64), self.state.view(np.int64))
        floats = self.words.view(np.float64)
        address = int(self.words.ctypes.data)
        simulate_cycles(self.address, self.capacity, self.words, floats, address, records, views, self.plan)
        self.plan[0] += cycles
