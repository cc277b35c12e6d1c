"""The cycle log: a stream of words that one writer appends and any number of readers follow.

Entries are whole 64-bit words, the first of which holds their length. The writer
never waits: a reader that falls more than the capacity behind has lost entries,
sees it, and goes on at the newest.

L1 store `reserved` = end of the entry; L2 fence(release) so that it is seen before
the words; L3 write the words; L4 store-release `head` = end.
A reader copies words below `head` (acquire), then fence(acquire), then checks that
`reserved` has not come within the copied words once around.
"""

from __future__ import annotations

from typing import Any

from surffollow.shm import atomics as at
from surffollow.shm.jit import jit
from surffollow.shm.layout_board import LogHead

RESERVED = LogHead.offset("reserved")
HEAD = LogHead.offset("head")
WORDS = LogHead.SIZE


@jit
def log_append(log: Any, capacity: Any, entry: Any, n_words: Any) -> None:
    """Append `n_words` words at private address `entry` (steps L1-L4).

    Parameters
    ----------
    log : int64     address of the log
    capacity : int  words of the log, a power of two
    entry : int64   address of the words, of this process alone
    n_words : int
    """
    head = at.load_relaxed_i64(log + HEAD)
    at.store_relaxed_i64(log + RESERVED, head + n_words)
    at.fence_release()
    mask = capacity - 1
    for i in range(n_words):
        at.store_relaxed_i64(log + WORDS + 8 * ((head + i) & mask), at.load_relaxed_i64(entry + 8 * i))
    at.store_release_i64(log + HEAD, head + n_words)


@jit
def log_head(log: Any) -> Any:
    """Words appended so far: where a new reader begins (an entry starts there)."""
    return at.load_acquire_i64(log + HEAD)


@jit
def log_copy(log: Any, capacity: Any, position: Any, target: Any, most: Any) -> Any:
    """Copy at most `most` words from `position` on to private address `target`.

    Parameters
    ----------
    log : int64       address of the log
    capacity : int    words of the log, a power of two
    position : int64  number of the first word
    target : int64    address of memory for `most` words, of this process alone
    most : int

    Returns
    -------
    int64  words copied (0: nothing new), or -1: the words were overwritten, or `position` was never
        written (of another log); go on at `log_head`
    """
    n = min(at.load_acquire_i64(log + HEAD) - position, most)
    if n < 0:
        return -1
    mask = capacity - 1
    for i in range(n):
        at.store_relaxed_i64(target + 8 * i, at.load_relaxed_i64(log + WORDS + 8 * ((position + i) & mask)))
    at.fence_acquire()
    if at.load_relaxed_i64(log + RESERVED) - position > capacity:
        return -1
    return n
