"""Blocks under unique names, and children that attach by themselves and can be killed or stopped."""

from __future__ import annotations

import os
import signal
import struct
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from surffollow.blocks import F64, I64, Block, Nested, Text


class Wheel(Block):
    """One wheel."""

    speed = F64(unit="rad/s")
    slips = I64()


class Platform(Block):
    """A platform with two wheels."""

    t_ns = I64(unit="ns", doc="when it was true")
    pose = F64(3, unit="m, m, rad")
    wheel = Nested(Wheel, 2)
    state = Text(16)


class Words(Block):
    """All words equal in every whole publication: a mixture shows."""

    word = I64(256)


class Child:
    """A forked child; it speaks through a pipe of 8-byte numbers and never returns into pytest."""

    def __init__(self, work: Callable[[Child], None]) -> None:
        self._r, self._w = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            signal.alarm(300)  # it must not outlive a test run that was killed
            try:
                work(self)
            except BaseException:
                os._exit(1)
            os._exit(0)
        os.close(self._w)

    def say(self, number: int) -> None:
        os.write(self._w, struct.pack("<q", number))

    def receive(self) -> int | None:
        data = os.read(self._r, 8)
        return struct.unpack("<q", data)[0] if data else None

    def signal(self, number: int) -> None:
        os.kill(self.pid, number)
        if number == signal.SIGSTOP:
            os.waitpid(self.pid, os.WUNTRACED)

    def end(self) -> int:
        """Wait for its end; returns its wait status."""
        if self.pid < 0:
            return 0
        status = os.waitpid(self.pid, 0)[1]
        self.pid = -1
        os.close(self._r)
        return status

    def kill(self) -> None:
        if self.pid > 0:
            os.kill(self.pid, signal.SIGKILL)
            self.end()


@pytest.fixture
def space() -> Iterator[str]:
    """A name for blocks; what bears it is removed at the end."""
    name = f"t{uuid.uuid4().hex[:10]}"
    yield name
    for left in Path("/dev/shm").glob(f"{name}*"):
        left.unlink()


@pytest.fixture
def child() -> Iterator[Callable[[Callable[[Child], None]], Child]]:
    """Start children that are gone when the test ends."""
    made: list[Child] = []

    def start(work: Callable[[Child], None]) -> Child:
        made.append(Child(work))
        return made[-1]

    yield start
    for one in made:
        one.kill()


def forever() -> None:
    """Work of a child that is to be killed."""
    while True:
        signal.pause()
