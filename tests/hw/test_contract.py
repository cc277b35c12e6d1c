"""The public contract, run on every built-in driver, on the example, and on drivers that break it."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from hw.wires import FRAME_FORMAT, WINDOW, FakeIio, Pty, Ring, datagrams, feeding, frame
from running_service import World, unique_name, until
from surffollow.hw import (
    ConversionQueue,
    Driver,
    DriverInfo,
    PolledDriver,
    RangeWriter,
    metre_info,
    pack_range,
)
from surffollow.hw.contract import ContractError, check_driver
from surffollow.hw.pushed_ranges import pushed_of, take_pushed
from surffollow.hw.registry import make_driver
from surffollow.hw.replayed import save_conversions

ROOT = Path(__file__).parents[2]
MS = 1_000_000
Made = tuple[Callable[[], Driver], bool]


@contextlib.contextmanager
def simulated(folder: Path) -> Iterator[Made]:
    name = unique_name()
    world = World(name)
    settings = {"world": {"surface": "flat", "region": [0, 0, 0.1, 0.1]}}
    yield (lambda: make_driver(settings, name)), True
    world.close()


@contextlib.contextmanager
def silent(folder: Path) -> Iterator[Made]:
    yield (lambda: make_driver({"kind": "none"}, "x")), False


@contextlib.contextmanager
def replayed(folder: Path) -> Iterator[Made]:
    import numpy as np

    info = make_driver({"kind": "none"}, "x").info
    save_conversions(folder / "log.npz", np.arange(400) * MS, np.arange(400), info)
    settings = {"kind": "replay", "file": str(folder / "log.npz"), "faults": [{"kind": "spike"}]}
    yield (lambda: make_driver(settings, "x")), True


@contextlib.contextmanager
def serial(folder: Path) -> Iterator[Made]:
    pytest.importorskip("serial")
    tty = Pty(folder)
    settings = {"kind": "serial", "port": str(tty.path), "format": FRAME_FORMAT, **WINDOW}
    with feeding(lambda range_m: tty.write(frame(range_m))):
        yield (lambda: make_driver(settings, "x")), True
    tty.unplug()


@contextlib.contextmanager
def udp(folder: Path) -> Iterator[Made]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    settings = {"kind": "udp", "port": port, "sender": "any", "format": FRAME_FORMAT, **WINDOW}
    send = datagrams(lambda: port)
    with feeding(lambda range_m: send(frame(range_m))):
        yield (lambda: make_driver(settings, "x")), True


@contextlib.contextmanager
def unix(folder: Path) -> Iterator[Made]:
    path = folder / "laser.sock"
    settings = {"kind": "unix", "path": str(path), "format": FRAME_FORMAT, **WINDOW}
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:

        def send(range_m: float) -> None:
            with contextlib.suppress(OSError):
                sender.sendto(frame(range_m), socket.MSG_DONTWAIT, str(path))

        with feeding(send):
            yield (lambda: make_driver(settings, "x")), True


@contextlib.contextmanager
def can(folder: Path) -> Iterator[Made]:
    library = pytest.importorskip("can")
    name = unique_name()
    settings = {
        "kind": "can",
        "interface": "virtual",
        "bus": name,
        "messages": [{"id": 0x123, "format": FRAME_FORMAT}],
        **WINDOW,
    }
    with library.Bus(channel=name, interface="virtual") as bus:

        def send(range_m: float) -> None:
            bus.send(library.Message(arbitration_id=0x123, data=frame(range_m), is_extended_id=False))

        with feeding(send):
            yield (lambda: make_driver(settings, "x")), True


@contextlib.contextmanager
def iio(folder: Path) -> Iterator[Made]:
    device = FakeIio(folder)
    settings = {
        "kind": "iio",
        "device": device.name,
        "inputs": ["voltage0", "voltage1"],
        "root": str(folder),
        "metres_per_volt": 0.1,
        **WINDOW,
    }
    with feeding(lambda range_m: device.write(device.scan(3000, 100))):
        yield (lambda: make_driver(settings, "x")), True


@contextlib.contextmanager
def example(folder: Path) -> Iterator[Made]:
    settings = {"kind": "own_driver:make", "range_m": 0.1}
    sys.path.insert(0, str(ROOT / "examples/driver"))
    try:
        yield (lambda: make_driver(settings, "x")), True
    finally:
        sys.path.remove(str(ROOT / "examples/driver"))


@contextlib.contextmanager
def external(folder: Path) -> Iterator[Made]:
    """A ring that is pushed into, and a thread that takes out of it as the service's cycle does."""
    drivers: list[Driver] = []
    ring, over = Ring(), threading.Event()

    def make() -> Driver:
        drivers.append(make_driver({"kind": "external", **WINDOW}, "x"))
        return drivers[-1]

    def cycle() -> None:
        seen = 0
        while not over.wait(0.0005):
            now_ns = time.monotonic_ns()
            ring.push(now_ns, 0, 0.1)
            for driver in drivers[-1:]:
                seen, *_ = take_pushed(pushed_of(driver), ring.address, seen, 1, 64, now_ns)

    thread = threading.Thread(target=cycle)
    thread.start()
    yield make, True
    over.set()
    thread.join()


DRIVERS = (simulated, silent, replayed, serial, udp, unix, can, iio, external, example)


@pytest.mark.parametrize("there", DRIVERS, ids=lambda f: f.__name__)
def test_every_driver_keeps_the_contract(there: Callable[[Path], Any], tmp_path: Path) -> None:
    with there(tmp_path) as (make, delivers):
        assert len(check_driver(make, delivers=delivers)) == 4


def test_the_contract_runs_from_a_shell(tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text('[driver]\nkind = "own_driver:make"\nrange_m = 0.1\n')
    done = subprocess.run(
        [sys.executable, "-m", "surffollow.hw.contract", str(tmp_path / "own.toml")],
        capture_output=True,
        text=True,
        cwd=ROOT / "examples/driver",
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("ok:") == 4
    wrong = subprocess.run(
        [
            sys.executable,
            "-c",
            "import sys; from surffollow.hw import contract as c; sys.exit(c.main(sys.argv[1:]))",
        ]
        + [str(tmp_path / "none.toml")],
        capture_output=True,
        text=True,
    )
    assert wrong.returncode == 1
    assert "cannot read" in wrong.stderr


class Good:
    """A driver that is right, for others to be wrong in one thing."""

    word = 100_000  # 0.1 m
    ahead_ns, channel, quiet_after_stop, twice = 0, 0, True, False

    def __init__(self) -> None:
        self._info = metre_info("good", 0.05, 0.5)
        self._writer: RangeWriter | None = None

    @property
    def info(self) -> DriverInfo:
        return self._info

    def start(self, queue: ConversionQueue) -> None:
        from surffollow.errors import DriverError

        if self._writer is not None and not self.twice:
            raise DriverError("started twice")
        self._writer = RangeWriter(queue, self._info)
        for k in range(20):
            queue.push(
                time.monotonic_ns() + self.ahead_ns - (k if self.ahead_ns < 0 else 0) * MS,
                self.word | self.channel << 24,
            )

    def stop(self) -> None:
        if self._writer is not None and not self.quiet_after_stop:
            import threading

            writer = self._writer
            threading.Timer(0.01, lambda: writer.push(time.monotonic_ns(), 0.1)).start()
        self._writer = None

    def faults(self) -> list[str]:
        return []


SOURCES: dict[str, Callable[[DriverInfo], tuple[Any, Any]]] = {
    "ahead of CLOCK_MONOTONIC, by up to .*; use": lambda info: (time.time_ns(), pack_range(info, 0, 0.1)),
    "inside the window 0.05 to 0.3 m: the last one is 100 m; is the unit metres": lambda info: (
        time.monotonic_ns(),
        pack_range(info, 0, 100.0),
    ),
    "no distance was inside .* sees nothing": lambda info: (
        time.monotonic_ns(),
        pack_range(info, 0, float("nan")),
    ),
    r"two whole numbers, not \(\d+, 0.1\)": lambda info: (time.monotonic_ns(), 0.1),
    r"two whole numbers, not \(\d+\.\d+, \d+\)": lambda info: (time.monotonic(), pack_range(info, 0, 0.1)),
}


class Reading:
    """A source whose every reading is the same."""

    name, rejected = "laser", 0

    def __init__(self, info: DriverInfo, measured: Callable[[DriverInfo], tuple[Any, Any]]) -> None:
        self._info, self._measured, self._pause = info, measured, threading.Event()

    def open(self) -> None: ...

    def close(self) -> None: ...

    def read(self, timeout_s: float) -> list[tuple[Any, Any]]:
        self._pause.wait(0.002)
        return [self._measured(self._info)]


def driver_of(measured: Callable[[DriverInfo], tuple[Any, Any]]) -> PolledDriver:
    info = metre_info("laser", 0.05, 0.3)
    return PolledDriver(info, Reading(info, measured))


WRONG = {
    "lies ahead": {"ahead_ns": 10**9},
    "go back": {"ahead_ns": -1},
    "channel 3 of 1": {"channel": 3},
    "after stop": {"quiet_after_stop": False},
    "no distance was inside the window 0.05 to 0.5 m: the last one is 0 m": {"word": 0},
    "second start": {"twice": True},
    "expected a list of texts": {"faults": lambda self: ["", 3]},
    "lacks info, start, stop or faults": {"start": None, "faults": 5, "info": 3, "stop": None},
}


def test_a_driver_that_is_right_passes() -> None:
    assert len(check_driver(Good)) == 4


@pytest.mark.parametrize("says", WRONG)
def test_a_driver_that_breaks_the_contract_is_reported_with_the_reason(says: str) -> None:
    if says.startswith("lacks"):
        broken: Any = type("Broken", (), {})
    else:
        broken = type("Broken", (Good,), WRONG[says])
    with pytest.raises(ContractError, match=says):
        check_driver(broken, timeout_s=1.0)


@pytest.mark.parametrize("says", SOURCES)
def test_a_source_with_a_wrong_clock_unit_or_type_does_not_pass(says: str) -> None:
    with pytest.raises(ContractError, match=says):
        check_driver(lambda: driver_of(SOURCES[says]), timeout_s=1.0)


def test_a_polled_driver_notes_timestamps_of_another_clock() -> None:
    driver, queue = driver_of(lambda info: (time.time_ns(), pack_range(info, 0, 0.1))), ConversionQueue(64)
    assert driver.notes() == []
    driver.start(queue)
    try:
        (note,) = until(driver.notes, "a note")
    finally:
        driver.stop()
    assert "ahead of CLOCK_MONOTONIC; the time of arrival is used instead" in note


@pytest.mark.parametrize("error", [SystemExit(5), KeyboardInterrupt(), GeneratorExit()], ids=repr)
def test_a_polled_driver_survives_any_exception_of_its_source(error: BaseException) -> None:
    def measured(info: DriverInfo) -> tuple[int, int]:
        if driver.connections == 1:
            raise error
        return time.monotonic_ns(), pack_range(info, 0, 0.1)

    driver, queue = driver_of(measured), ConversionQueue(64)
    driver.start(queue)
    try:
        until(lambda: any(type(error).__name__ in text for text in driver.faults()), "the fault")
        until(lambda: len(queue) > 0 and driver.faults() == [], "distances")
    finally:
        driver.stop()
