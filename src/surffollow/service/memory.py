"""Shared memory of the service's threads: addresses and flags in one word array, records for the kernels.

Words that more than one thread touches (STOP, CLAIM, PENDING, LOST, …) are only
reached through the atomics module, by `ctx.ctypes.data + 8 * index`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surffollow.config.params import PARAMS
from surffollow.hw.pushed_ranges import make_pushed
from surffollow.map.kernels.preview_line import new_kept
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import zeros
from surffollow.shm.journal import CYCLE_MAX, SNAPSHOT_WORDS
from surffollow.shm.layout_board import AUDIT_ENTRY_WORDS, CLIENTS, Ack
from surffollow.shm.layout_follow import CHANNELS, FollowState, Inputs, Output, Params
from surffollow.shm.layout_slot import REQUEST_ARGS, PosePost, RequestPost
from surffollow.shm.python_atomics import load_acquire

(
    STOP,  # main → threads: end
    PERIOD_NS,
    SPIN_NS,
    CATCH_UP,  # 1: run every missed cycle, 0: skip them
    OUTPUT,  # addresses of board parts
    PARAMS_LATCH,
    ACKS,
    MAP_ACKS,
    MAP_STATUS,
    STATS,
    LOG,
    LOG_CAPACITY,
    SLOTS_AT,  # where the slots are mapped
    CONVERSIONS,  # the driver's queue
    CONVERSIONS_CAPACITY,
    SAMPLES,  # the map's queue
    SAMPLES_CAPACITY,
    SNAPSHOT_CYCLES,
    EPOCH,
    LOST,  # cycle → map thread: samples that found no room
    POSE_SLOT,  # cycle → main: sender of the pose, -1: none
    POSE_CLAIM,
    POSE_SEEN,  # generation of the pose read last
    LEASE_NS,  # of exclusive access
    REPORTS,  # a simulated sensor's queue of accepted poses; 0: the driver takes none
    REPORTS_CAPACITY,
    MAP_PASSES,  # map → main: looks around that have begun
    QUANTUM,  # height of one count after a MapReset [m], a float64; 0: it follows from the stand-off
) = range(28)
# main → threads: per slot, the claim of the client that holds it; 0: none, its memory is not read
CLAIM = 32
PID = CLAIM + CLIENTS  # per slot, that client's process and user, from the kernel
UID = PID + CLIENTS
SEEN = UID + CLIENTS  # per slot, generation of the request read last; 0 when the slot is granted
COUNTER = SEEN + CLIENTS  # per slot, counter answered last
PENDING = COUNTER + CLIENTS  # per slot, 1: a map request is under way
REGION = PENDING + CLIENTS  # per slot, four float64 of that request, its claim, an installed map's numbers
REGION_WORDS = 16
# grid (of a refocus: the finest; of a reset: height of one count), x0, y0, datum, quantum [m] as float64;
# columns, rows, datum is set
INSTALL_WORD = 5
FENCED = REGION + CLIENTS * REGION_WORDS  # per slot, the claim whose request for access is ignored; 0: none
POLICY = FENCED + CLIENTS
(
    STOP_ASKED,  # main → cycle: causes of a stop that the main thread sees now
    PARAMS_BY,  # rights to set parameters: BY_ANY, BY_HOLDER, BY_HOLDER_ONLY
    MAP_BY,  # rights to change the map, as above
    RANGES_BY,  # user who may push ranges beside root and the service's; ANY_USER, NO_OTHER_USER
    OWN_USER,  # the service's
    CHANGES,  # the audit trail's queue, cycle → main
    CHANGES_CAPACITY,
    CHANGES_LOST,  # entries that found no room
) = range(POLICY, POLICY + 8)
RANGES_HELD = POLICY + 8  # bit per channel whose ranges a client pushes
RANGE_SLOT = RANGES_HELD + 1  # cycle → main: per channel, the slot of that client; -1: none
RANGE_CLAIM = RANGE_SLOT + CHANNELS
RANGE_SEEN = RANGE_CLAIM + CHANNELS  # per slot, head of its ring at the last look
STOP_SEEN = RANGE_SEEN + CLIENTS  # per slot, its stop word at the last look; 0 when the slot is granted
# cycle → main: per channel, distances outside the window since the last one inside, and the last one [µm]
OUTSIDE = STOP_SEEN + CLIENTS
OUTSIDE_UM = OUTSIDE + CHANNELS
WINDOW_UM = OUTSIDE_UM + CHANNELS  # its two ends
# cycle → main: the newest conversion lay far from now (cycles in a row, when it did last, by how much), and
# the last one of a channel that does not exist (when, channels << 8 | channel); times [ns], 0: never
OFF_RUN, OFF_SEEN_NS, OFF_BY_NS, WRONG_CHANNEL_NS, WRONG_CHANNEL = range(WINDOW_UM + 2, WINDOW_UM + 7)
CTX_WORDS = WINDOW_UM + 7

BY_ANY, BY_HOLDER, BY_HOLDER_ONLY = 0, 1, 2

SAMPLE_WORDS = 4  # kind | slot << 8 (0: a sample), then x y z [m] or the request's counter


class CycleMemory(NamedTuple):
    """Private memory of the cycle thread; views of one buffer carry its bits as words and floats."""

    ctx: NDArray[np.int64]
    params: Any
    param_words: NDArray[np.int64]
    param_floats: NDArray[np.float64]
    state: Any
    state_words: NDArray[np.int64]
    inputs: Any
    output: Any
    entry: NDArray[np.int64]
    entry_floats: NDArray[np.float64]
    pose: NDArray[np.float64]
    item: NDArray[np.int64]
    item_floats: NDArray[np.float64]
    post: Any
    request: Any
    ack: Any
    bounds: NDArray[np.float64]
    header: Any  # the map's, which the map thread writes
    pairs: Any
    kept: Any  # its grids ahead, as they were before the tool came
    audit: NDArray[np.int64]  # an `AuditEntry` that is being filled
    audit_floats: NDArray[np.float64]
    old_values: NDArray[np.float64]  # of the parameters that a request is about to change
    pushed: Any  # memory shared with an external driver; empty where there is none


def bounds_table() -> NDArray[np.float64]:
    """Per parameter word: settable (1 float, 2 whole, 0 no), low, high, least and most for clients."""
    table = np.zeros((Params.SIZE // 8, 5))
    for name, spec in PARAMS.items():
        whole = Params.field(name).code == "i8"
        bounds = (spec.low, spec.high)
        table[Params.offset(name) // 8] = (2.0 if whole else 1.0, *bounds, *bounds)
    return table


def load_word(ctx: NDArray[np.int64], index: int) -> int:
    """A word that the service's threads share, with all that was written before it (from Python).

    Parameters
    ----------
    ctx : (n,) int64   the words
    index : int        of one of them
    """
    return int(load_acquire(ctx.ctypes.data + 8 * index))


def make_cycle_memory(header: Any = None, pairs: Any = None, pushed: Any = None) -> CycleMemory:
    """All zeroed; the daemon fills in `ctx` and `params`, and gives its map's header and pairs.

    `pushed` is what an external driver shares with the cycle (`hw.driver.pushed_of`).
    """
    params, state = zeros(Params), zeros(FollowState)
    entry = np.zeros(max(CYCLE_MAX, SNAPSHOT_WORDS), np.int64)
    item = np.zeros(SAMPLE_WORDS, np.int64)
    ctx = np.zeros(CTX_WORDS, np.int64)
    ctx[POSE_SLOT] = -1
    ctx[RANGE_SLOT : RANGE_SLOT + CHANNELS] = -1
    audit = np.zeros(AUDIT_ENTRY_WORDS, np.int64)
    return CycleMemory(
        ctx,
        params,
        params.view(np.int64),
        params.view(np.float64),
        state,
        state.view(np.int64),
        zeros(Inputs),
        zeros(Output),
        entry,
        entry.view(np.float64),
        np.zeros(7),
        item,
        item.view(np.float64),
        zeros(PosePost),
        zeros(RequestPost),
        zeros(Ack),
        bounds_table(),
        zeros(ml.MapHeader) if header is None else header,
        zeros(ml.GridPair) if pairs is None else pairs,
        new_kept(),
        audit,
        audit.view(np.float64),
        np.zeros(REQUEST_ARGS),
        make_pushed() if pushed is None else pushed,
    )
