"""The example of a polled driver: lines of text from a FIFO."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hw.wires import feeding
from running_service import until
from surffollow.hw import ConversionQueue, Driver
from surffollow.hw.contract import check_driver
from surffollow.hw.registry import make_driver

EXAMPLES = Path(__file__).parents[2] / "examples/driver"


@pytest.fixture
def fifo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    os.mkfifo(tmp_path / "laser")
    return tmp_path / "laser"


@contextlib.contextmanager
def writer(fifo: Path) -> Iterator[Any]:
    """A program that has the FIFO open; gives a function that writes into it."""
    fd = os.open(fifo, os.O_RDWR | os.O_NONBLOCK)

    def write(text: str) -> None:
        with contextlib.suppress(BlockingIOError):
            os.write(fd, text.encode())

    yield write
    os.close(fd)


def driver_of(fifo: Path) -> Driver:
    return make_driver({"kind": "line_fifo:make", "path": str(fifo)}, "x")


def test_a_driver_of_text_lines_keeps_the_contract(fifo: Path) -> None:
    with writer(fifo) as write, feeding(lambda range_m: write(f"{range_m:.6f}\n")):
        assert len(check_driver(lambda: driver_of(fifo))) == 4


def test_lines_that_are_no_number_are_rejected_and_named_as_a_fault(fifo: Path) -> None:
    driver, queue = driver_of(fifo), ConversionQueue()
    with writer(fifo) as write:
        driver.start(queue)
        try:
            write("0.125000\nno number\n0.13")  # the last line is not complete
            until(lambda: len(queue) == 1, "the distance")
            write("0000\n")
            until(lambda: len(queue) == 2, "the distance in two pieces")
            assert [int(word) for word in queue.drain()[:, 1]] == [125_000, 130_000]
            write("hello\n")
            assert until(driver.faults, "the fault")[0].startswith(f"FIFO {fifo}: ")
        finally:
            driver.stop()
    assert driver.faults() == []
