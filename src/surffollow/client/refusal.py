"""A refused claim: another client holds the pose or a channel of ranges."""

from __future__ import annotations

from typing import NamedTuple

# between two requests of a control loop for it: each pause is twice the one before
FIRST_PAUSE_NS, REFUSED_NS = 20_000_000, 1_000_000_000


class Refusal(NamedTuple):
    """Text of the error, and when a control loop asks the service again."""

    text: str
    pause_ns: int
    until_ns: int
