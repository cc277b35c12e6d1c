"""Cycle-log entries: what went into a cycle and what came out, as words.

First word of every entry: bits 0-7 kind, 8-31 length in words, 32-39 conversions,
40-47 poses, 48-55 ready-made ranges, 56-63 remembered heights (preview).

======== ==========================================================================
kind     words after the first
======== ==========================================================================
CYCLE    t_ns, cycle, status, demand (6 float64); 8 per pose (t_ns, 7 float64);
         1 per conversion; with ranges: given_t_ns and 1 float64 per range;
         with preview: where from and step (float64), 1 float64 per height
SNAPSHOT t_ns, `Params`, `FollowState`: the state before the next cycle
PARAMS   t_ns, `Params` in force from the next cycle on
RESET    t_ns, offset_m: SFReset before the next cycle
MAP      t_ns, request code, 4 float64 of its region, 1 of the finest grid (MapRefocus) or of
         the height of one count (MapReset): a map command between samples
STOP     t_ns, bits: causes added to the latched stop before the next cycle; 0: it was reset
======== ==========================================================================
"""

from surffollow.shm.jit import jit, jit_pasted, jit_uncounted
from surffollow.shm.layout_follow import (
    CHANNELS,
    MAX_CONVERSIONS,
    MAX_POSES,
    MAX_PREVIEW,
    FollowState,
    Params,
)

CYCLE, SNAPSHOT, PARAMS, RESET, MAP, STOP = 1, 2, 3, 4, 5, 6
CYCLE_HEAD = 10
CYCLE_MAX = CYCLE_HEAD + 8 * MAX_POSES + MAX_CONVERSIONS + 1 + CHANNELS + 2 + MAX_PREVIEW
PARAMS_WORDS = Params.SIZE // 8
STATE_WORDS = FollowState.SIZE // 8
SNAPSHOT_WORDS = 2 + PARAMS_WORDS + STATE_WORDS


@jit_pasted
def entry_head(kind, n_words):
    """The first word of an entry without conversions, poses or ranges."""
    return kind | (n_words << 8)


@jit_pasted
def entry_kind(word):
    """Kind of the entry that begins with this word."""
    return word & 0xFF


@jit_pasted
def entry_words(word):
    """Length of the entry that begins with this word, in words."""
    return (word >> 8) & 0xFFFFFF


@jit
def encode_cycle(words, floats, inputs, output):
    """Write a CYCLE entry; returns its length.

    Parameters
    ----------
    words : (≥ CYCLE_MAX,) int64, floats : the same memory as float64
    inputs, output : (1,) records of `Inputs`, `Output`
    """
    i, o = inputs[0], output[0]
    words[1], words[2], words[3] = i.t_ns, o.cycle, o.status
    for k in range(6):
        floats[4 + k] = o.demand[k]
    n = CYCLE_HEAD
    for k in range(i.n_poses):
        words[n] = i.pose_t_ns[k]
        for j in range(7):
            floats[n + 1 + j] = i.pose[7 * k + j]
        n += 8
    for k in range(i.n_conversions):
        words[n + k] = i.conversion[k]
    n += i.n_conversions
    if i.n_ranges > 0:
        words[n] = i.given_t_ns
        for k in range(i.n_ranges):
            floats[n + 1 + k] = i.given_m[k]
        n += 1 + i.n_ranges
    if i.n_preview > 0:
        floats[n], floats[n + 1] = i.preview_from_m, i.preview_step_m
        for k in range(i.n_preview):
            floats[n + 2 + k] = i.preview_m[k]
        n += 2 + i.n_preview
    counts = i.n_conversions | (i.n_poses << 8) | (i.n_ranges << 16) | (i.n_preview << 24)
    words[0] = CYCLE | (n << 8) | (counts << 32)
    return n


@jit_uncounted
def decode_cycle(words, floats, at, inputs):
    """Read the inputs of the CYCLE entry at index `at`; its length, or -1 when it cannot be one.

    The counts are checked against the entry's own length, so a damaged file cannot make
    the reader step outside it.

    Parameters
    ----------
    words, floats : (n,) int64, the same memory as float64
    at : int  index of the entry's first word
    inputs : (1,) record of `Inputs`  receives the inputs
    """
    head = words[at]
    i = inputs[0]
    n_conversions, n_poses, n_ranges = (head >> 32) & 0xFF, (head >> 40) & 0xFF, (head >> 48) & 0xFF
    n_preview = (head >> 56) & 0xFF
    expected = CYCLE_HEAD + 8 * n_poses + n_conversions + (1 + n_ranges if n_ranges > 0 else 0)
    expected += 2 + n_preview if n_preview > 0 else 0
    bad = n_conversions > MAX_CONVERSIONS or n_poses > MAX_POSES or n_ranges > CHANNELS
    bad = bad or n_preview > MAX_PREVIEW
    if bad or expected != entry_words(head) or at + expected > words.size:
        return -1
    i.t_ns = words[at + 1]
    i.n_conversions, i.n_poses, i.n_ranges = n_conversions, n_poses, n_ranges
    i.n_preview = n_preview
    n = at + CYCLE_HEAD
    for k in range(n_poses):
        i.pose_t_ns[k] = words[n]
        for j in range(7):
            i.pose[7 * k + j] = floats[n + 1 + j]
        n += 8
    conversions = words[n:]  # of which no index is negative: the loop vectorises
    for k in range(n_conversions):
        i.conversion[k] = conversions[k]
    n += n_conversions
    if n_ranges > 0:
        i.given_t_ns = words[n]
        for k in range(n_ranges):
            i.given_m[k] = floats[n + 1 + k]
        n += 1 + n_ranges
    if n_preview > 0:
        i.preview_from_m, i.preview_step_m = floats[n], floats[n + 1]
        for k in range(n_preview):
            i.preview_m[k] = floats[n + 2 + k]
    return expected


@jit_uncounted
def same_outcome(words, at, output_words, demand_word, status, cycle):
    """1 when cycle number, status and all six demands of the entry at `at` have the same bits.

    Parameters
    ----------
    words : (n,) int64         the log
    at : int                   index of the entry's first word
    output_words : (m,) int64  an `Output` record as words
    demand_word : int          index of the demand in it
    status, cycle : int64      status bits and cycle number to compare
    """
    if words[at + 2] != cycle or words[at + 3] != status:
        return 0
    for k in range(6):
        if words[at + 4 + k] != output_words[demand_word + k]:
            return 0
    return 1
