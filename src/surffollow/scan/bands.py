"""Run a kernel over bands of rows, one thread per processor; kernels release the GIL."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

MIN_ROWS = 16  # a band below this costs more in overlap than it gains
MAX_ROWS = 4096  # Ctrl-C waits for the bands that run: a second or so


def in_bands(rows: int, work: Callable[[int, int], object], *, threads: int | None = None) -> None:
    """Call work(first, last) for bands that cover range(rows); an exception of any is raised.

    `work` allocates its own scratch, so that no two bands share memory that they write.
    """
    n = processors() if threads is None else threads
    n = max(1, min(n, rows // MIN_ROWS))
    parts = max(n, rows // MAX_ROWS)
    bands = list(itertools.pairwise(rows * k // parts for k in range(parts + 1)))
    if n == 1:
        for first, last in bands:
            work(first, last)
        return
    pool = ThreadPoolExecutor(n)
    try:
        for done in [pool.submit(work, first, last) for first, last in bands]:
            done.result()
    finally:
        pool.shutdown(cancel_futures=True)


def processors() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0))
