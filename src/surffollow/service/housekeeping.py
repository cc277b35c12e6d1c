"""Housekeeping that may fail without ending the service: faults are latched, work is repeated."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


class Guard:
    """Runs parts of the main thread's work; an exception of one is kept as text and never passed on.

    Parameters
    ----------
    report : called with one line when a part begins to fail, and when it works again
    """

    def __init__(self, report: Callable[[str], object]) -> None:
        self._report = report
        self._failed: dict[str, int] = {}  # times, since the start
        self._now: dict[str, str] = {}

    def run(self, what: str, action: Callable[[], T], otherwise: T) -> T:
        """Result of the action; `otherwise` when it raises."""
        try:
            value = action()
        except Exception as e:
            if what not in self._now:
                self._report(f"{what} failed: {e!r}; it is tried again")
            self._now[what] = repr(e)
            self._failed[what] = self._failed.get(what, 0) + 1
            return otherwise
        if self._now.pop(what, None) is not None:
            self._report(f"{what} works again")
        return value

    @property
    def failed(self) -> bool:
        """Whether any part has failed since the start."""
        return bool(self._failed)

    def texts(self) -> list[str]:
        """One line per part that has failed."""
        return [
            f"{what} failed {n} times" + (f": {self._now[what]}" if what in self._now else ", works again")
            for what, n in self._failed.items()
        ]
