"""Clock, watchdog of commands and trace of a simulated robot."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

SETTLED_M, SETTLED_TICKS = 1.5e-3, 30  # it sets out after so many demands in a row below so much


class CommandedRobot:
    """A robot that steps a record of state with `t_ns` and `trace_rows`, and holds when commands stay away.

    Attributes
    ----------
    holding : bool
        it stands still without a valid demand
    """

    TRACE_COLUMNS: ClassVar[tuple[str, ...]]
    holding: bool
    _body: NDArray[Any]
    _trace: NDArray[np.float64]
    _received_ns: int
    _command_timeout_s: float

    @property
    def t_ns(self) -> int:
        """Time of the body's state [ns]."""
        return int(self._body["t_ns"][0])

    @property
    def is_holding(self) -> bool:
        """Whether it stands still without a valid demand."""
        return self.holding

    def hold(self) -> None:
        """Come to rest along the path: there is no demand to trust."""
        raise NotImplementedError

    def watch_commands(self) -> None:
        """Hold when the controller has said nothing for too long: the drives' own watchdog."""
        received_ns = self._received_ns
        if self.t_ns - received_ns > round(self._command_timeout_s * 1e9):
            self.hold()
            self._received_ns = received_ns

    def trace(self) -> dict[str, NDArray[np.float64]]:
        """Columns of what happened so far, by the names of `TRACE_COLUMNS`."""
        rows = int(self._body["trace_rows"][0])
        return {name: self._trace[:rows, k].copy() for k, name in enumerate(self.TRACE_COLUMNS)}
