"""Times of an embedder as the kernels take them."""

from __future__ import annotations

import numpy as np

from surffollow.errors import UsageError

# the kernels take a reading at 0 ns for none: their time runs ahead of the caller's by an hour
SHIFT_NS = 3_600_000_000_000


def kernel_time(t_ns: int) -> int:
    """A time of the caller's clock [ns] in that of the kernels; UsageError beyond what they can count."""
    if isinstance(t_ns, (int, np.integer, float)) and -SHIFT_NS < t_ns < 1 << 62:
        return int(t_ns) + SHIFT_NS
    raise UsageError(f"time {t_ns} ns must be after -1 hour and before 2^62 ns of the clock in use")
