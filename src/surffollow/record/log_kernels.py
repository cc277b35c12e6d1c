"""Jitted walks over runs of cycle-log words: find whole entries, and step the follower over them.

Every count is checked against the words that are there, so damaged words end a walk
and never lead it outside.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from surffollow.config.params import PARAMS as TABLE
from surffollow.forecast.step import follow_step, reset_stop, sf_reset
from surffollow.forecast.stop import latch_stop
from surffollow.shm.jit import jit, jit_uncounted
from surffollow.shm.journal import (
    CYCLE,
    CYCLE_HEAD,
    CYCLE_MAX,
    MAP,
    PARAMS,
    PARAMS_WORDS,
    RESET,
    SNAPSHOT,
    SNAPSHOT_WORDS,
    STATE_WORDS,
    STOP,
    decode_cycle,
    entry_kind,
    entry_words,
    same_outcome,
)
from surffollow.shm.layout_follow import CHANNELS, FollowState, Output, Params

MAP_WORDS = 8  # 7, the least, in recordings from before a refocus could choose its grids
_DEMAND_WORD = Output.offset("demand") // 8
_CYCLE_WORD = FollowState.offset("cycle") // 8
# whole-numbered parameters run loops and choose branches: word after the entry's second, least, most
_WHOLE = np.array(
    [[Params.offset("n_channels") // 8, 1, CHANNELS]]
    + [
        [Params.offset(name) // 8, int(spec.low), int(spec.high)]
        for name, spec in TABLE.items()
        if spec.whole and Params.field(name).code == "i8"
    ],
    np.int64,
)

# numbers of the state that index arrays as they are, or whose overflow ends no loop: as above, behind the
# words of the parameters
_STATE = np.array(
    [
        [PARAMS_WORDS + FollowState.offset("adaptive", "beams", "reference") // 8, 0, CHANNELS - 1],
        [PARAMS_WORDS + FollowState.offset("sense", "pose_count") // 8, 0, 1 << 62],
    ],
    np.int64,
)

# results of a walk, int64 each
(
    W_END,  # index of the first word that was not taken
    W_CYCLES,
    W_FIRST_CYCLE,
    W_LAST_CYCLE,
    W_FIRST_T_NS,
    W_LAST_T_NS,
    W_BAD,  # 1: the word at W_END begins no entry
    W_SNAPSHOT,  # index of the first snapshot; -1: none
    W_COUNT,
) = range(9)


@jit
def entry_length(word: Any) -> Any:
    """Words of the entry that begins with `word`; 0 when none can."""
    kind, n = entry_kind(word), entry_words(word)
    if kind == CYCLE:
        return n if CYCLE_HEAD <= n <= CYCLE_MAX else 0
    if kind == SNAPSHOT:
        return n if n == SNAPSHOT_WORDS else 0
    if kind == PARAMS:
        return n if n == 2 + PARAMS_WORDS else 0
    if kind in (RESET, STOP):
        return n if n == 3 else 0
    if kind == MAP:
        return n if MAP_WORDS - 1 <= n <= MAP_WORDS else 0
    return 0


@jit
def walk_entries(words: Any, n: Any, most_cycles: Any, stop_at_snapshot: Any, walk: Any) -> None:
    """Take whole entries from the front of `words[:n]`, at most `most_cycles` cycles of them.

    Parameters
    ----------
    words : (≥ n,) int64
    n, most_cycles : int64
    stop_at_snapshot : int64   1: end before the first SNAPSHOT entry
    walk : (W_COUNT,) int64    overwritten
    """
    at, cycles = 0, 0
    walk[W_BAD], walk[W_SNAPSHOT] = 0, -1
    walk[W_FIRST_CYCLE], walk[W_LAST_CYCLE] = -1, -1
    walk[W_FIRST_T_NS], walk[W_LAST_T_NS] = 0, 0
    while at < n and cycles < most_cycles:
        length = entry_length(words[at])
        if length == 0:
            walk[W_BAD] = 1
            break
        if entry_kind(words[at]) == SNAPSHOT:
            if walk[W_SNAPSHOT] < 0:
                walk[W_SNAPSHOT] = at
            if stop_at_snapshot != 0:
                break
        if at + length > n:
            break
        if walk[W_FIRST_T_NS] == 0:
            walk[W_FIRST_T_NS] = words[at + 1]
        walk[W_LAST_T_NS] = words[at + 1]
        if entry_kind(words[at]) == CYCLE:
            cycles += 1
            if walk[W_FIRST_CYCLE] < 0:
                walk[W_FIRST_CYCLE] = words[at + 2]
            walk[W_LAST_CYCLE] = words[at + 2]
        at += length
    walk[W_END] = at
    walk[W_CYCLES] = cycles


# sums of a replay, int64 each
(
    R_STARTED,  # 1: a snapshot was loaded, the state is known
    R_CYCLES,
    R_DIFFERING,  # cycles whose demand or status had other bits
    R_FIRST_WORD,  # index of the first such entry, in the run given last; -1: none in it
    R_SNAPSHOTS,  # snapshots compared, those that began a segment not among them
    R_STATES_DIFFERING,  # snapshots that were not the replayed state
    R_FIRST_STATE_CYCLE,  # cycle of the first such snapshot
    R_LAST_CYCLE,
    R_GAPS,  # cycles whose number does not follow the one before
    R_EVENTS,  # PARAMS, RESET, MAP and STOP entries
    R_COUNT,
) = range(11)


@jit
def same_words(a: Any, b: Any) -> Any:
    """Whether the words of two arrays of one size are the same."""
    differing = 0
    for k in range(a.size):  # to the end: it vectorises
        differing |= a[k] ^ b[k]
    return differing == 0


@jit
def are_within(words: Any, at: Any, bounds: Any) -> Any:
    """Whether the entry at `at` keeps the bounds (n, 3): word after its second, least, most."""
    for k in range(bounds.shape[0]):  # noqa: SIM110 - numba has no all() over a generator
        if not bounds[k, 1] <= words[at + 2 + bounds[k, 0]] <= bounds[k, 2]:
            return False
    return True


@jit
def numbers_in_bounds(words: Any, at: Any) -> Any:
    """Whether the PARAMS or SNAPSHOT entry at `at` keeps every kernel inside its arrays and its time."""
    return are_within(words, at, _WHOLE) and (
        entry_kind(words[at]) != SNAPSHOT or are_within(words, at, _STATE)
    )


@jit
def entries_end(words: Any, floats: Any, inputs: Any) -> Any:
    """Index of the first word that begins no whole entry with usable contents; the size when all do.

    Parameters
    ----------
    words, floats : (n,) int64, float64   the same memory
    inputs : (1,) record of `Inputs`      scratch
    """
    at = 0
    while at < words.size:
        length, kind = entry_length(words[at]), entry_kind(words[at])
        if length == 0 or at + length > words.size:
            break
        if kind == CYCLE and decode_cycle(words, floats, at, inputs) != length:
            break
        if kind in (PARAMS, SNAPSHOT) and not numbers_in_bounds(words, at):
            break
        at += length
    return at


@jit
def take_request(words: Any, floats: Any, at: Any, params: Any, state: Any) -> None:
    """Change the state as the RESET or STOP entry at `at` did; another kind changes nothing.

    Parameters
    ----------
    words, floats : (n,) int64, float64     the same memory
    at : int                                index of the entry's first word; the entry is whole
    params, state : (1,) records of `Params`, `FollowState`, updated
    """
    kind = entry_kind(words[at])
    if kind == RESET:
        sf_reset(params, state, floats[at + 2])
    elif kind == STOP and words[at + 2] != 0:
        latch_stop(state, words[at + 2])
    elif kind == STOP:
        reset_stop(params, state)


@jit
def take_snapshot(words: Any, at: Any, params_words: Any, state_words: Any, tally: Any) -> None:
    """Load the first snapshot of a segment; compare the later ones with the replayed state.

    Parameters
    ----------
    words : (n,) int64  the log
    at : int            index of the entry's first word
    params_words, state_words : int64  `Params` and `FollowState` of the replay as words
    tally : (…,) int64  counts of the comparison, updated
    """
    logged_params, logged_state = words[at + 2 :], words[at + 2 + PARAMS_WORDS :]
    if tally[R_STARTED] == 0:
        for k in range(PARAMS_WORDS):
            params_words[k] = logged_params[k]
        for k in range(STATE_WORDS):
            state_words[k] = logged_state[k]
        tally[R_STARTED] = 1
        tally[R_LAST_CYCLE] = state_words[_CYCLE_WORD] - 1
        return
    tally[R_SNAPSHOTS] += 1
    if not (same_words(params_words, logged_params) and same_words(state_words, logged_state)):
        if tally[R_STATES_DIFFERING] == 0:
            tally[R_FIRST_STATE_CYCLE] = logged_state[_CYCLE_WORD]
        tally[R_STATES_DIFFERING] += 1


@jit_uncounted
def replay_words(
    words: Any, floats: Any, n: Any, records: Any, views: Any, scratch: Any, first: Any, tally: Any
) -> Any:
    """Step the follower over the entries in `words[:n]` and compare what comes out, bit for bit.

    Parameters
    ----------
    words, floats : (≥ n,) int64, float64    the same memory; whole entries
    n : int64
    records : (params, state, inputs, output), each (1,)    carried from run to run of a segment
    views : (params, state, output) as int64 words
    scratch : (7,) float64
    first : (9,) int64      overwritten at the first difference: cycle, t_ns, status, six demands replayed
    tally : (R_COUNT,) int64    added to

    Returns
    -------
    int64  words taken; fewer than `n` when the word there begins no entry that may stand there
    """
    params, state, inputs, output = records
    params_words, state_words, output_words = views
    tally[R_FIRST_WORD] = -1
    at = 0
    while at < n:
        length = entry_length(words[at])
        kind = entry_kind(words[at])
        if length == 0 or at + length > n or (tally[R_STARTED] == 0 and kind != SNAPSHOT):
            return at
        if kind == CYCLE:
            if decode_cycle(words, floats, at, inputs) != length:
                return at
            follow_step(params, state, inputs, output, scratch)
            o = output[0]
            tally[R_CYCLES] += 1
            if words[at + 2] != tally[R_LAST_CYCLE] + 1:
                tally[R_GAPS] += 1
            tally[R_LAST_CYCLE] = words[at + 2]
            if same_outcome(words, at, output_words, _DEMAND_WORD, o.status, o.cycle) == 0:
                if tally[R_DIFFERING] == 0:
                    tally[R_FIRST_WORD] = at
                    first[0], first[1], first[2] = o.cycle, o.t_ns, o.status
                    for k in range(6):
                        first[3 + k] = output_words[_DEMAND_WORD + k]
                tally[R_DIFFERING] += 1
        elif kind == SNAPSHOT:
            if not numbers_in_bounds(words, at):
                return at
            take_snapshot(words, at, params_words, state_words, tally)
        else:
            tally[R_EVENTS] += 1
            if kind == PARAMS:
                if not numbers_in_bounds(words, at):
                    return at
                for k in range(PARAMS_WORDS):
                    params_words[k] = words[at + 2 + k]
            take_request(words, floats, at, params, state)
        at += length
    return at
