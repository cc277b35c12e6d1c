"""A latch: one writer publishes a structure, readers copy it whole, no side waits.

In memory: a u64 generation (own cache line), then SLOTS copies of the payload.
Generation g lives in slot g % SLOTS. Steps (docs/reference/protocol.md):

W1 fence(release): the last published generation is ordered before what follows;
W2 write the payload of g+1 into slot (g+1) % SLOTS with relaxed stores;
W3 store-release the generation g+1.

R1 load-acquire the generation g; R2 copy slot g % SLOTS with relaxed loads;
R3 fence(acquire); R4 load the generation again: the copy is whole while at most
SLOTS-2 newer ones were published, for only then the writer may be in this slot.
"""

from __future__ import annotations

from typing import Any

from surffollow.shm import atomics as at
from surffollow.shm.jit import jit, jit_pasted
from surffollow.shm.latch_shape import HEAD_BYTES, MAX_TRIES, SLOTS


@jit_pasted
def copy_words_out(source: Any, n_words: Any, target: Any) -> None:
    """Relaxed loads from shared `source` to private `target` (addresses; 8-byte words)."""
    for i in range(n_words):
        at.store_relaxed_i64(target + 8 * i, at.load_relaxed_i64(source + 8 * i))


@jit
def latch_write(latch: Any, payload: Any, payload_bytes: Any) -> None:
    """Publish the payload at private address `payload` (steps W1-W3)."""
    g = at.load_relaxed_i64(latch) + 1
    step = ((payload_bytes + 63) >> 6) << 6
    slot = latch + HEAD_BYTES + step * (g & (SLOTS - 1))
    at.fence_release()
    copy_words_out(payload, payload_bytes >> 3, slot)
    at.store_release_i64(latch, g)


@jit
def latch_read(latch: Any, payload: Any, payload_bytes: Any) -> Any:
    """Copy the newest payload to private address `payload` (steps R1-R4).

    Returns
    -------
    int64  its generation; 0: nothing published yet; -1: torn MAX_TRIES times
    """
    step = ((payload_bytes + 63) >> 6) << 6
    for _ in range(MAX_TRIES):
        g = at.load_acquire_i64(latch)
        if g == 0:
            return 0
        copy_words_out(latch + HEAD_BYTES + step * (g & (SLOTS - 1)), payload_bytes >> 3, payload)
        at.fence_acquire()
        if at.load_relaxed_i64(latch) - g <= SLOTS - 2:
            return g
    return -1
