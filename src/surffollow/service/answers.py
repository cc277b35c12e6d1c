"""Answers of the cycle thread: acknowledgements, parameters in force, entries of the cycle log."""

from __future__ import annotations

from typing import Any

from surffollow.service import memory as m
from surffollow.shm import atomics as at
from surffollow.shm import journal
from surffollow.shm.cycle_log import log_append
from surffollow.shm.jit import jit_pasted, jit_uncounted
from surffollow.shm.latch import latch_write
from surffollow.shm.latch_shape import latch_bytes
from surffollow.shm.layout_board import (
    Ack,
)
from surffollow.shm.layout_follow import Params
from surffollow.shm.map_layout import MapHeader

ACK_STEP = latch_bytes(Ack.SIZE)
ACK_BYTES = Ack.SIZE
_PARAMS_BYTES = Params.SIZE
_PARAMS_HASH = MapHeader.offset("params_hash")
_FNV_START, _FNV_PRIME = -3750763034362895579, 1099511628211


@jit_pasted
def count(stats: Any, offset: Any, n: Any) -> None:
    """Add to a counter that only this thread writes."""
    at.store_relaxed_i64(stats + offset, at.load_relaxed_i64(stats + offset) + n)


@jit_uncounted
def write_ack(latch: Any, ack: Any, request: Any, result: Any, detail: Any) -> None:
    """Publish the answer to a request.

    Parameters
    ----------
    latch : int64               address of the client's latch
    ack : (1,) record of `Ack`  scratch
    request : (1,) record of `Request`
    result, detail : int64
    """
    a = ack[0]
    a.counter, a.claim = request[0].counter, request[0].claim
    a.result, a.detail = result, detail
    latch_write(latch, ack.ctypes.data, ACK_BYTES)


@jit_uncounted
def params_hash(mem: Any) -> Any:
    """A number that other parameters do not have; never 0 (FNV-1a over words)."""
    h = _FNV_START
    for k in range(journal.PARAMS_WORDS):
        h = (h ^ mem.param_words[k]) * _FNV_PRIME
        h ^= h >> 29
    return h | 1


@jit_uncounted
def keep_params_hash(mem: Any) -> None:
    """Keep the hash of the parameters in force for the service's next start: a robot follows with them."""
    at.store_release_i64(mem.header.ctypes.data + _PARAMS_HASH, params_hash(mem))


@jit_uncounted
def publish_params(mem: Any) -> None:
    """Publish the parameters in force, and keep their hash unless no robot has followed with any yet."""
    known = at.load_relaxed_i64(mem.header.ctypes.data + _PARAMS_HASH)
    if known != 0 or mem.ctx[m.POSE_SLOT] >= 0:
        keep_params_hash(mem)
    latch_write(mem.ctx[m.PARAMS_LATCH], mem.params.ctypes.data, _PARAMS_BYTES)


@jit_uncounted
def log_params(mem: Any, t_ns: Any) -> None:
    """Write a PARAMS entry: in force from the next cycle on."""
    n = 2 + journal.PARAMS_WORDS
    mem.entry[0], mem.entry[1] = journal.entry_head(journal.PARAMS, n), t_ns
    for i in range(journal.PARAMS_WORDS):
        mem.entry[2 + i] = mem.param_words[i]
    log_append(mem.ctx[m.LOG], mem.ctx[m.LOG_CAPACITY], mem.entry.ctypes.data, n)


@jit_uncounted
def log_value(mem: Any, kind: Any, t_ns: Any, value: Any) -> None:
    """Write an entry of one float64, e.g. RESET.

    Parameters
    ----------
    mem : CycleMemory
    kind : int    of the entry
    t_ns : int64  now
    value : float64
    """
    mem.entry[0], mem.entry[1] = journal.entry_head(kind, 3), t_ns
    mem.entry_floats[2] = value
    log_append(mem.ctx[m.LOG], mem.ctx[m.LOG_CAPACITY], mem.entry.ctypes.data, 3)
