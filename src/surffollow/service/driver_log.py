"""Lines of the service's log about the driver: when it gets faulty, and when it works again."""

from __future__ import annotations

from collections.abc import Callable, Sequence

LASTING_NS = 1_000_000_000  # a device that opens within a second is no line
EVERY_NS = 10_000_000_000  # a loose plug writes no more lines than that


class DriverLog:
    """Reports each lasting change between faulty and working.

    Parameters
    ----------
    report : takes one line
    """

    def __init__(self, report: Callable[[str], object]) -> None:
        self._report = report
        self._is_faulty = False  # as reported
        self._changed_ns: int | None = None  # since when it is otherwise
        self._line_ns: int | None = None

    def update(self, faults: Sequence[str], now_ns: int) -> None:
        """Look once.

        Parameters
        ----------
        faults : texts of the driver's faults; none: it works
        now_ns : CLOCK_MONOTONIC [ns]
        """
        if bool(faults) == self._is_faulty:
            self._changed_ns = None
            return
        if self._changed_ns is None:
            self._changed_ns = now_ns
        too_soon = self._line_ns is not None and now_ns - self._line_ns < EVERY_NS
        if too_soon or now_ns - self._changed_ns < LASTING_NS:
            return
        self._is_faulty, self._line_ns, self._changed_ns = bool(faults), now_ns, None
        self._report(f"driver: {'; '.join(faults)}" if faults else "driver: no fault any more")
