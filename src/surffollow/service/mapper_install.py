"""Install a map that a client streams through its slot, piece by piece (docs/explanation/maps.md).

When an installation's turn comes, the map thread checks its numbers and acknowledges with ACCEPTED and
0 grids taken. The client writes piece k (k = 1, 2, …) into half k & 1 of its stream area and stores the
piece's number last; the map thread copies the half, checks the copy, installs it, and acknowledges with
ACCEPTED and the number of grids taken. Then that half may carry piece k + 2. A client that gives up,
dies, leaves its slot, is too slow or writes before it is called is not waited for, and the answer is
ERR_CANCELLED. Up to its first piece the old map is untouched; from then on what is left is an empty map
over the announced grids.
"""

from __future__ import annotations

from typing import Any

from surffollow.map.kernels.install import install_begin, install_end, install_fault, install_grids, reject
from surffollow.service import memory as m
from surffollow.service.mapper_memory import (
    JOB_BEGAN_NS,
    JOB_CLAIM,
    JOB_CODE,
    JOB_COUNTER,
    JOB_PIECE,
    JOB_SLOT,
)
from surffollow.service.pose_role import holder_is_gone
from surffollow.service.slot_inputs import slot_address
from surffollow.shm import atomics as at
from surffollow.shm import map_layout as ml
from surffollow.shm.clock import now_ns
from surffollow.shm.jit import jit_uncounted
from surffollow.shm.latch import latch_write
from surffollow.shm.latch_shape import latch_bytes
from surffollow.shm.layout_board import ACCEPTED, RQ_MAP_INSTALL, Ack
from surffollow.shm.layout_slot import PIECE_BYTES, PIECE_GRIDS, SLOT_STREAM

_ACK_STEP, _ACK_BYTES = latch_bytes(Ack.SIZE), Ack.SIZE
_PIECE_WORDS = PIECE_BYTES // 8
# beyond the lease, an installation must go on at half a million grids per second
NS_PER_GRID = 2000
NOTHING, TAKEN, WHOLE, FAILED = range(4)


@jit_uncounted
def _announced(mem: Any) -> Any:
    """Numbers of the request under way: region, then the map's."""
    return mem.ctx.ctypes.data + 8 * (m.REGION + mem.job[JOB_SLOT] * m.REGION_WORDS)


@jit_uncounted
def _announced_grids(mem: Any) -> Any:
    """Columns, rows, side of a grid, corner, datum and quantum of the announced map."""
    f, i = at.load_relaxed_f64, at.load_relaxed_i64
    w = _announced(mem) + 8 * m.INSTALL_WORD
    return i(w + 40), i(w + 48), f(w), f(w + 8), f(w + 16), f(w + 24), f(w + 32)


@jit_uncounted
def _acknowledge(mem: Any, taken: Any) -> None:
    """Report to the client that it is its turn, and how many grids were taken."""
    a, job = mem.ack[0], mem.job
    a.counter, a.claim = job[JOB_COUNTER], job[JOB_CLAIM]
    a.result, a.detail = ACCEPTED, taken
    latch_write(mem.ctx[m.MAP_ACKS] + job[JOB_SLOT] * _ACK_STEP, mem.ack.ctypes.data, _ACK_BYTES)


@jit_uncounted
def _is_early(mem: Any) -> Any:
    """Whether the first piece lies there uncalled for: it is unknown whether its client still runs."""
    i, job = at.load_acquire_i64, mem.job
    if holder_is_gone(mem.ctx, job[JOB_SLOT], job[JOB_CLAIM]):
        return False
    half = slot_address(mem.ctx[m.SLOTS_AT], job[JOB_SLOT]) + SLOT_STREAM + PIECE_BYTES
    return i(half) == 1 and i(half + 8) == job[JOB_COUNTER] and i(half + 16) == job[JOB_CLAIM]


@jit_uncounted
def begin_install(mem: Any) -> Any:
    """Check the numbers of the announced map and call for its first piece; the map is untouched.

    Returns
    -------
    int64  OK, BAD_MAP, TOO_SMALL, BUSY of the map library
    """
    answer = install_fault(mem.header, *_announced_grids(mem))
    if answer == ml.OK:
        mem.job[JOB_PIECE], mem.job[JOB_BEGAN_NS] = 0 if _is_early(mem) else 1, now_ns()
        _acknowledge(mem, 0)
    return answer


@jit_uncounted
def awaits_first_piece(mem: Any) -> Any:
    """Whether an installation is under way that has not begun: the old map is whole."""
    job = mem.job
    return job[JOB_SLOT] >= 0 and job[JOB_CODE] == RQ_MAP_INSTALL and mem.header[0].journal_op == 0


@jit_uncounted
def _open_install(mem: Any) -> Any:
    """Let the old map go: the first piece is here; whether the map library agrees."""
    f, i = at.load_relaxed_f64, at.load_relaxed_i64
    words = _announced(mem)
    first, w = words + 8 * m.INSTALL_WORD, mem.header[0]
    answer = install_begin(mem.header, *_announced_grids(mem))
    if answer != ml.OK:
        return False
    for k in range(4):
        w.journal_region_m[k] = f(words + 8 * k)
    w.journal_datum_set = 1 if i(first + 56) != 0 else 0
    mem.job[JOB_BEGAN_NS] = now_ns()
    return True


@jit_uncounted
def take_piece(mem: Any) -> Any:
    """Install the next piece when it is there; NOTHING, TAKEN, WHOLE or FAILED."""
    ctx, job, piece, w = mem.ctx, mem.job, mem.piece, mem.header[0]
    number, slot = job[JOB_PIECE], job[JOB_SLOT]
    if number == 0 or holder_is_gone(ctx, slot, job[JOB_CLAIM]):
        return FAILED
    half = slot_address(ctx[m.SLOTS_AT], slot) + SLOT_STREAM + (number & 1) * PIECE_BYTES
    if at.load_acquire_i64(half) != number:
        return NOTHING
    for k in range(_PIECE_WORDS):
        piece[k] = at.load_relaxed_i64(half + 8 * k)
    if piece[1] != job[JOB_COUNTER] or piece[2] != job[JOB_CLAIM]:
        # of an earlier installation through this slot, or of a later one: the client is past this one
        return FAILED if piece[2] == job[JOB_CLAIM] and piece[1] > job[JOB_COUNTER] else NOTHING
    numbers = _announced(mem) + 8 * (m.INSTALL_WORD + 5)
    total = at.load_relaxed_i64(numbers) * at.load_relaxed_i64(numbers + 8)
    start, n = piece[3], piece[4]
    begun = 0 if number == 1 else w.journal_progress
    if start != begun or n != min(total - begun, PIECE_GRIDS):
        return FAILED
    if number == 1 and not _open_install(mem):
        return FAILED
    heights, counts = mem.piece_heights[:n], mem.piece_counts[:n]
    if install_grids(mem.header, mem.pairs, start, heights, counts) != ml.OK:
        return FAILED
    job[JOB_PIECE] = number + 1
    _acknowledge(mem, w.journal_progress)
    if start + n < total:
        return TAKEN
    install_end(mem.header)
    return WHOLE


@jit_uncounted
def step_install(mem: Any, t_ns: Any) -> Any:
    """Go on with the installation; NOTHING, TAKEN, WHOLE or FAILED.

    One that failed after its first piece is rejected: `reset_step` clears the map.
    """
    job, ctx = mem.job, mem.ctx
    answer = take_piece(mem)
    if answer == NOTHING:
        taken = 0 if job[JOB_PIECE] <= 1 else mem.header[0].journal_progress
        if t_ns - job[JOB_BEGAN_NS] > ctx[m.LEASE_NS] + NS_PER_GRID * taken:
            answer = FAILED
    if answer == FAILED:
        reject(mem.header)
    return answer
