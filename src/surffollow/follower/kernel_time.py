"""Times of an embedder as the kernels take them."""

from __future__ import annotations

import operator

import numpy as np

from surffollow.errors import PoseError, UsageError

# the kernels take a reading at 0 ns for none: their time runs ahead of the caller's by an hour
SHIFT_NS = 3_600_000_000_000
# sensors measure at up to 0.4 MHz, controllers report poses far more seldom
CLOSEST_POSES_NS = 1_000
CLOSE_POSES = 100  # so many in succession are not jitter


def kernel_time(t_ns: int, error: type[UsageError] = UsageError) -> int:
    """A time of the caller's clock [ns] in that of the kernels.

    Parameters
    ----------
    t_ns : int
        of Python or NumPy
    error : class
        what to raise

    Raises
    ------
    UsageError
        no whole number, or beyond what the kernels can count
    """
    try:
        if isinstance(t_ns, bool | np.bool_):
            raise TypeError
        whole = operator.index(t_ns)
    except TypeError:
        raise error(
            f"t_ns must be a whole number of ns, not {t_ns!r}; times in s: round(1e9 * t_s)"
        ) from None
    if -SHIFT_NS < whole < 1 << 62:
        return whole + SHIFT_NS
    raise error(f"time {whole} ns must be after -1 hour and before 2^62 ns of the clock in use")


class PoseIntervals:
    """Find times in s or ms: poses that come in quicker succession than any controller reports them."""

    def __init__(self) -> None:
        self._last_ns = self._close = 0

    def check(self, t_ns: int) -> None:
        """Check the time of a pose.

        Parameters
        ----------
        t_ns : int
            when the pose was true [ns]

        Raises
        ------
        PoseError
            the last `CLOSE_POSES` intervals were all below `CLOSEST_POSES_NS`
        """
        interval_ns, self._last_ns = t_ns - self._last_ns, t_ns
        if not 0 < interval_ns < CLOSEST_POSES_NS:
            self._close = 0
            return
        self._close += 1
        if self._close >= CLOSE_POSES:
            raise PoseError(
                f"times are in ns, but the last {CLOSE_POSES} poses came less than {CLOSEST_POSES_NS} ns "
                f"apart, this one after {interval_ns} ns; times in s: round(1e9 * t_s), "
                "in ms: 1_000_000 * t_ms"
            )
