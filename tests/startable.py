"""Base of the server processes that tests start and end."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing_extensions import Self


class Startable:
    """Base of servers that a test starts, kills and starts again."""

    def start(self) -> Self:
        """Start it and wait until it is ready."""
        raise NotImplementedError

    def purge(self) -> None:
        """End it in any state and remove all that it left."""
        raise NotImplementedError

    @contextlib.contextmanager
    def running(self) -> Iterator[Self]:
        """Start it; at the end of this, end it in any state and remove all that it left."""
        try:
            self.start()
            yield self
        finally:
            self.purge()
