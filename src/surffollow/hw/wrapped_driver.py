"""A driver around another one: what a service asks of the inner driver goes through."""

from __future__ import annotations

from typing import Any

from surffollow.hw.driver import Driver, DriverInfo, PoseQueue, notes_of, reports_of
from surffollow.hw.pushed_ranges import pushed_of


class WrappingDriver:
    """Common parts of drivers around another driver; `start`, `stop` and `faults` are their own.

    Parameters
    ----------
    inner : the driver whose conversions are changed on their way
    """

    def __init__(self, inner: Driver) -> None:
        self._inner = inner

    @property
    def info(self) -> DriverInfo:
        """The inner driver's."""
        return self._inner.info

    @property
    def reports(self) -> PoseQueue | None:
        """The inner driver's."""
        return reports_of(self._inner)

    @property
    def pushed(self) -> Any:
        """The inner driver's."""
        return pushed_of(self._inner)

    def notes(self) -> list[str]:
        """The inner driver's."""
        return notes_of(self._inner)
