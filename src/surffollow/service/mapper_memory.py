"""Memory of the map thread: the map object, and memory of its own."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from surffollow.service import memory as m
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_board import Ack, MapStatus
from surffollow.shm.layout_slot import PIECE_BYTES, PIECE_COUNTS, PIECE_GRIDS, PIECE_HEIGHTS


class MapMemory(NamedTuple):
    """The map object and private memory of the map thread."""

    ctx: Any
    header: Any
    pairs: Any
    scratch: Any
    item: Any
    item_floats: Any
    status: Any
    ack: Any
    job: Any  # int64 words, indices below
    piece: Any  # copy of a piece of an installed map, as int64 words
    piece_heights: Any
    piece_counts: Any


# indices in `job`
(
    JOB_SLOT,  # slot of the request under way; -1: none, -2: recovery after a cut-off
    JOB_CODE,  # code of that request
    JOB_COUNTER,  # counter of that request
    JOB_CLAIM,  # claim of the client that sent it
    HOLDER_CLAIM,  # claim of the client that has exclusive access
    GRANTED_NS,  # when the access was granted
    LAST_HOLDER,  # slot of the last client that had access
    JOB_PIECE,  # number of the next piece of an installation
    JOB_BEGAN_NS,  # when the installation began
    WAITING_ITEMS,  # samples still queued of those that came during the last access
) = range(10)
JOB_WORDS = 16


def make_map_memory(ctx: Any, header: Any, pairs: Any, scratch: Any) -> MapMemory:
    """Everything idle.

    Parameters
    ----------
    ctx : (…,) int64       context of the service, see `memory`
    header, pairs, scratch : parts of the map object
    """
    item, status = np.zeros(m.SAMPLE_WORDS, np.int64), zeros(MapStatus)
    status[0]["access_slot"] = -1
    piece = np.zeros(PIECE_BYTES // 8, np.int64)
    heights, counts = PIECE_HEIGHTS // 2, PIECE_COUNTS
    return MapMemory(
        ctx,
        header,
        pairs,
        scratch,
        item,
        item.view(np.float64),
        status,
        zeros(Ack),
        np.full(JOB_WORDS, -1, np.int64),
        piece,
        piece.view(np.int16)[heights : heights + PIECE_GRIDS],
        piece.view(np.uint8)[counts : counts + PIECE_GRIDS],
    )
