"""Install a map that a client streams through its slot, piece by piece (docs/map.md).

The client writes piece k (k = 1, 2, …) into half k & 1 of its stream area and stores the piece's
number last; the map thread copies the half, checks the copy, installs it, and acknowledges with
ACCEPTED and the number of grids taken. Then that half may carry piece k + 2. A client that gives up,
dies, leaves its slot or is too slow is not waited for: the old map is gone by then, so what is left
is an empty map over the announced grids, and the answer ERR_CANCELLED.
"""

from __future__ import annotations

from typing import Any

from numba import njit

from surffollow.map.install import install_begin, install_end, install_grids, reject
from surffollow.service import memory as m
from surffollow.service.inbox import slot_address
from surffollow.service.mapper_memory import (
    JOB_BEGAN_NS,
    JOB_CLAIM,
    JOB_COUNTER,
    JOB_PIECE,
    JOB_SLOT,
)
from surffollow.service.requests import holder_is_gone
from surffollow.shm import atomics as at
from surffollow.shm import map_layout as ml
from surffollow.shm.clock import now_ns
from surffollow.shm.latch import latch_write
from surffollow.shm.latch_shape import latch_bytes
from surffollow.shm.layout_board import ACCEPTED, PIECE_BYTES, PIECE_GRIDS, SLOT_STREAM, Ack

_ACK_STEP, _ACK_BYTES = latch_bytes(Ack.SIZE), Ack.SIZE
_PIECE_WORDS = PIECE_BYTES // 8
# beyond the lease, an installation must go on at half a million grids per second
NS_PER_GRID = 2000
NOTHING, TAKEN, WHOLE, FAILED = range(4)


@njit(cache=True, nogil=True)
def begin_install(mem: Any, words: Any) -> Any:
    """Announce the map whose numbers the request left at `words`.

    Returns
    -------
    int64  OK, BAD_MAP, TOO_SMALL, BUSY of the map library
    """
    f, i = at.load_relaxed_f64, at.load_relaxed_i64
    w, job = mem.header[0], mem.job
    first = words + 8 * m.INSTALL_WORD
    answer = install_begin(
        mem.header,
        i(first + 40),
        i(first + 48),
        f(first),
        f(first + 8),
        f(first + 16),
        f(first + 24),
        f(first + 32),
    )
    if answer == ml.OK:
        for k in range(4):
            w.journal_region_m[k] = f(words + 8 * k)
        w.journal_datum_set = 1 if i(first + 56) != 0 else 0
        job[JOB_PIECE], job[JOB_BEGAN_NS] = 1, now_ns()
    return answer


@njit(cache=True, nogil=True)
def _acknowledge(mem: Any) -> None:
    """Tell the client how many grids were taken."""
    a, job = mem.ack[0], mem.job
    a.counter, a.claim = job[JOB_COUNTER], job[JOB_CLAIM]
    a.result, a.detail = ACCEPTED, mem.header[0].journal_progress
    latch_write(mem.ctx[m.MAP_ACKS] + job[JOB_SLOT] * _ACK_STEP, mem.ack.ctypes.data, _ACK_BYTES)


@njit(cache=True, nogil=True)
def take_piece(mem: Any) -> Any:
    """Install the next piece when it is there; NOTHING, TAKEN, WHOLE or FAILED."""
    ctx, job, piece, w = mem.ctx, mem.job, mem.piece, mem.header[0]
    number = job[JOB_PIECE]
    half = slot_address(ctx[m.INBOX], job[JOB_SLOT]) + SLOT_STREAM + (number & 1) * PIECE_BYTES
    if at.load_acquire_i64(half) != number:
        return NOTHING
    for k in range(_PIECE_WORDS):
        piece[k] = at.load_relaxed_i64(half + 8 * k)
    # of an earlier installation through this slot
    if piece[1] != job[JOB_COUNTER] or piece[2] != job[JOB_CLAIM]:
        return NOTHING
    start, n = piece[3], piece[4]
    total = w.journal_nx * w.journal_ny
    if start < 0 or n != min(total - w.journal_progress, PIECE_GRIDS):
        return FAILED
    heights, counts = mem.piece_heights[:n], mem.piece_counts[:n]
    if install_grids(mem.header, mem.pairs, start, heights, counts) != ml.OK:
        return FAILED
    job[JOB_PIECE] = number + 1
    _acknowledge(mem)
    if start + n < total:
        return TAKEN
    install_end(mem.header)
    return WHOLE


@njit(cache=True, nogil=True)
def step_install(mem: Any, t_ns: Any) -> Any:
    """Go on with the installation; NOTHING, TAKEN, WHOLE, or FAILED: rejected, `reset_step` clears it."""
    job, ctx = mem.job, mem.ctx
    answer = take_piece(mem)
    if answer == NOTHING:
        late = t_ns - job[JOB_BEGAN_NS] > ctx[m.LEASE_NS] + NS_PER_GRID * mem.header[0].journal_progress
        if late or holder_is_gone(ctx, job[JOB_SLOT], job[JOB_CLAIM], job[JOB_BEGAN_NS]):
            answer = FAILED
    if answer == FAILED:
        reject(mem.header)
    return answer
