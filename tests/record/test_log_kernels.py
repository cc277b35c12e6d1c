"""The walks over cycle-log words against slow twins written from the journal's description."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from surffollow.forecast.step import follow_step, reset_stop, sf_reset
from surffollow.record import log_kernels as k
from surffollow.record.recorded_inputs import count_inputs, take_inputs
from surffollow.record.synthetic_log import SyntheticLog
from surffollow.shm import journal
from surffollow.shm.cycle_log import log_head
from surffollow.shm.dtypes import numpy_dtype, zeros
from surffollow.shm.layout_board import LogHead
from surffollow.shm.layout_follow import FollowState, Inputs, Output, Params


def log_words(cycles: int = 2600, **options: int) -> np.ndarray:
    synthetic_log = SyntheticLog(1 << 20, **options)
    synthetic_log.run(cycles)
    return synthetic_log.memory[LogHead.SIZE // 8 :][: int(log_head(synthetic_log.address))].copy()


def split(words: np.ndarray) -> list[tuple[int, int, np.ndarray]]:
    """All whole entries as (index, kind, words)."""
    out, at = [], 0
    while at < words.size:
        n = int(words[at]) >> 8 & 0xFFFFFF
        if n == 0 or at + n > words.size:
            break
        out.append((at, int(words[at]) & 0xFF, words[at : at + n]))
        at += n
    return out


def read_cycle(entry: np.ndarray) -> dict[str, Any]:
    """The inputs of a CYCLE entry, field by field."""
    n_conversions, n_poses = int(entry[0]) >> 32 & 0xFF, int(entry[0]) >> 40 & 0xFF
    poses = entry[10 : 10 + 8 * n_poses].reshape(n_poses, 8)
    return {
        "t_ns": int(entry[1]),
        "pose_t_ns": poses[:, 0],
        "pose": poses[:, 1:].copy().view(np.float64),
        "conversion": entry[10 + 8 * n_poses : 10 + 8 * n_poses + n_conversions],
    }


@pytest.mark.parametrize("seed", range(4))
def test_a_walk_takes_whole_entries_up_to_the_asked_number_of_cycles(seed: int) -> None:
    rng = np.random.default_rng(seed)
    words = log_words(900, snapshot_cycles=170, seed=seed)
    entries = split(words)
    walk = np.zeros(k.W_COUNT, np.int64)
    for _ in range(40):
        first = int(rng.integers(0, len(entries)))
        begin = entries[first][0]
        end = int(rng.integers(begin, words.size + 1))
        most = int(rng.integers(1, 300))
        k.walk_entries(words[begin:end], end - begin, most, 0, walk)
        taken: list[tuple[int, int, np.ndarray]] = []
        for at, kind, entry in entries[first:]:
            if at + entry.size > end or sum(e[1] == journal.CYCLE for e in taken) >= most:
                break
            taken.append((at, kind, entry))
        cycles = [int(e[2][2]) for e in taken if e[1] == journal.CYCLE]
        assert walk[k.W_END] == sum(e[2].size for e in taken), f"seed {seed}"
        assert walk[k.W_CYCLES] == len(cycles)
        assert walk[k.W_BAD] == 0
        if cycles:
            assert (walk[k.W_FIRST_CYCLE], walk[k.W_LAST_CYCLE]) == (cycles[0], cycles[-1])
        if taken:
            assert (walk[k.W_FIRST_T_NS], walk[k.W_LAST_T_NS]) == (taken[0][2][1], taken[-1][2][1])


def test_a_walk_that_seeks_a_snapshot_ends_before_it() -> None:
    words = log_words(500, snapshot_cycles=170)
    snapshots = [at for at, kind, _ in split(words) if kind == journal.SNAPSHOT]
    walk = np.zeros(k.W_COUNT, np.int64)
    after = snapshots[0] + journal.SNAPSHOT_WORDS
    k.walk_entries(words[after:], words.size - after, 1 << 60, 1, walk)
    assert walk[k.W_END] == walk[k.W_SNAPSHOT] == snapshots[1] - after


def test_replay_of_random_words_takes_nothing_and_touches_nothing() -> None:
    rng = np.random.default_rng(3)
    words = rng.integers(-(2**63), 2**63 - 1, 400, np.int64)
    records = (zeros(Params), zeros(FollowState), zeros(Inputs), zeros(Output))
    views = (records[0].view(np.int64), records[1].view(np.int64), records[3].view(np.int64))
    tally = np.zeros(k.R_COUNT, np.int64)
    for at in range(300):
        part = words[at:]
        n = k.replay_words(
            part, part.view(np.float64), part.size, records, views, np.zeros(7), np.zeros(9, np.int64), tally
        )
        assert n == 0
    assert tally[k.R_CYCLES] == 0
    assert not views[1].any()


@pytest.mark.parametrize("mode", [0, 1])
def test_replay_steps_as_a_plain_loop_over_the_entries_does(mode: int) -> None:
    words = log_words(2600, mode=mode, conversions=7)
    params, state, output = zeros(Params), zeros(FollowState), zeros(Output)
    started, snapshots = False, 0
    for _, kind, entry in split(words):
        if kind == journal.SNAPSHOT:
            logged_params = entry[2 : 2 + journal.PARAMS_WORDS].copy()
            logged_state = entry[2 + journal.PARAMS_WORDS :].copy()
            if not started:
                params = logged_params.view(numpy_dtype(Params))
                state = logged_state.view(numpy_dtype(FollowState))
                started = True
            else:
                np.testing.assert_array_equal(params.view(np.int64), logged_params)
                np.testing.assert_array_equal(state.view(np.int64), logged_state)
                snapshots += 1
        elif kind == journal.PARAMS:
            params = entry[2:].copy().view(numpy_dtype(Params))
        elif kind == journal.RESET:
            sf_reset(params, state, float(entry[2:3].view(np.float64)[0]))
        elif kind == journal.STOP and entry[2]:
            state["stop"] |= entry[2]
        elif kind == journal.STOP:
            reset_stop(params, state)
        elif kind == journal.CYCLE:
            read, inputs = read_cycle(entry), zeros(Inputs)
            inputs["t_ns"] = read["t_ns"]
            inputs["n_conversions"], inputs["n_poses"] = len(read["conversion"]), len(read["pose"])
            inputs["conversion"][0, : len(read["conversion"])] = read["conversion"]
            inputs["pose_t_ns"][0, : len(read["pose"])] = read["pose_t_ns"]
            inputs["pose"][0, : read["pose"].size] = read["pose"].ravel()
            follow_step(params, state, inputs, output, np.zeros(7))
            assert output["cycle"][0] == entry[2]
            assert output["status"][0] == entry[3]
            np.testing.assert_array_equal(output["demand"][0].view(np.int64), entry[4:10])
    records = (zeros(Params), zeros(FollowState), zeros(Inputs), zeros(Output))
    views = (records[0].view(np.int64), records[1].view(np.int64), records[3].view(np.int64))
    tally = np.zeros(k.R_COUNT, np.int64)
    n = k.replay_words(
        words, words.view(np.float64), words.size, records, views, np.zeros(7), np.zeros(9, np.int64), tally
    )
    assert n == words.size
    assert (tally[k.R_CYCLES], tally[k.R_DIFFERING], tally[k.R_SNAPSHOTS]) == (2600, 0, snapshots)
    np.testing.assert_array_equal(views[1], state.view(np.int64))


def test_inputs_are_taken_out_as_they_lie_in_the_entries() -> None:
    words, shift = log_words(1800, conversions=5), 12345
    t_ns, conversion, poses, events = [], [], [], []
    for at, kind, entry in split(words):
        if kind == journal.CYCLE:
            read = read_cycle(entry)
            for word in read["conversion"]:
                t_ns.append(read["t_ns"] + (int(word) >> 32) + shift)
                conversion.append(int(word))
            for stamp, pose in zip(read["pose_t_ns"], read["pose"].view(np.int64)):
                poses.append([read["t_ns"] + shift, int(stamp) + shift, *pose.tolist()])
        else:
            events.append([int(entry[1]) + shift, at])
    counts = np.zeros(3, np.int64)
    count_inputs(words, counts)
    assert counts.tolist() == [len(t_ns), len(poses), len(events)]
    out = [np.zeros(counts[0], np.int64) for _ in range(2)]
    out += [np.zeros((counts[1], 9), np.int64), np.zeros((counts[2], 2), np.int64)]
    take_inputs(words, shift, *out, np.zeros(3, np.int64))
    for got, expected in zip(out, (t_ns, conversion, poses, events)):
        np.testing.assert_array_equal(got, expected)
