"""Run a kernel over bands of rows, one thread per processor; kernels release the GIL."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

MIN_ROWS = 16  # a band below this costs more in overlap than it gains


def in_bands(rows: int, work: Callable[[int, int], object], *, threads: int | None = None) -> None:
    """Call work(first, last) for bands that cover range(rows); an exception of any is raised.

    `work` allocates its own scratch, so that no two bands share memory that they write.
    """
    n = processors() if threads is None else threads
    n = max(1, min(n, rows // MIN_ROWS))
    if n == 1:
        work(0, rows)
        return
    edges = [rows * k // n for k in range(n + 1)]
    with ThreadPoolExecutor(n) as pool:
        for done in [pool.submit(work, a, b) for a, b in itertools.pairwise(edges)]:
            done.result()


def processors() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0))
