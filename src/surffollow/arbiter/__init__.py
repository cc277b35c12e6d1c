"""Several clients share a robot: the one with the highest priority commands it.

from surffollow.arbiter import attach, command_reader, observe

with attach("cell", "go") as arbiter:
    robot = arbiter.resource("robot")
    if robot.request():
        robot.command(0.2, 0.0)

Light (no NumPy, no numba); the server is `surffollow arbiter start`. See docs/reference/arbiter.md.
"""

from __future__ import annotations

from surffollow.arbiter.board_reader import Holder
from surffollow.arbiter.client import ArbiterClient, attach
from surffollow.arbiter.controller import CommandReader, ResourceCommand, command_reader
from surffollow.arbiter.events import History, HistoryEvent
from surffollow.arbiter.observer import ArbiterObserver, observe
from surffollow.arbiter.resource import Reply, Resource

__all__ = [
    "ArbiterClient",
    "ArbiterObserver",
    "CommandReader",
    "History",
    "HistoryEvent",
    "Holder",
    "Reply",
    "Resource",
    "ResourceCommand",
    "attach",
    "command_reader",
    "observe",
]
