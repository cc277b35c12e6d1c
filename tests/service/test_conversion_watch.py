"""A driver whose times or channels cannot be: refused and counted, and the status says why nothing comes."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest

from running_service import Service, until
from surffollow.hw import ConversionQueue, metre_info, pack_range
from surffollow.service import memory as m
from surffollow.service.conversion_watch import NOTED_RUN, conversion_notes, drain_conversions
from surffollow.shm.layout_board import Stats
from surffollow.shm.layout_follow import MAX_CONVERSIONS

INFO = metre_info("laser", 0.05, 0.3, n_channels=2)
NOW = "time.monotonic_ns()"
DRIVER = """
import time
from surffollow.hw import PolledDriver, metre_info, pack_range

class Laser:
    name, rejected = "odd laser", 0
    def open(self): pass
    def close(self): pass
    def read(self, timeout_s):
        time.sleep(0.002)
        return [({time}, pack_range(metre_info("odd laser", 0.05, 0.3), 0, 0.1) | {channel} << 24)]

def make(settings, name):
    return PolledDriver(metre_info("odd laser", 0.05, 0.3), Laser())
"""


class Drain:
    """A cycle's memory and the queue of a driver of two channels."""

    def __init__(self) -> None:
        self.queue, self.mem = ConversionQueue(256), m.make_cycle_memory()
        self._stats = np.zeros(Stats.SIZE // 8, np.int64)
        self.mem.params[0]["n_channels"] = 2
        self.mem.ctx[m.CONVERSIONS] = self.queue.address
        self.mem.ctx[m.CONVERSIONS_CAPACITY] = self.queue.capacity
        self.mem.ctx[m.STATS] = self._stats.ctypes.data

    def cycle(self, *items: tuple[int, int]) -> list[str]:
        """Notes after a cycle that finds conversions of these ages [ns] and channels."""
        now_ns = time.monotonic_ns()
        for age_ns, channel in items:
            self.queue.push(now_ns - age_ns, pack_range(INFO, 0, 0.1) | channel << 24)
        drain_conversions(self.mem, now_ns)
        return conversion_notes(self.mem.ctx)

    def count(self, name: str) -> int:
        return int(self._stats[Stats.offset(name) // 8])


@pytest.mark.parametrize(
    ("age_s", "text", "refused"),
    [
        (40.0, "lie 40.0 s behind CLOCK_MONOTONIC", 1),
        (1.0, "lie 1.0 s behind CLOCK_MONOTONIC", 0),
        (-40.0, "lie 40.0 s ahead of CLOCK_MONOTONIC", 1),
    ],
)
def test_times_of_another_clock_are_noted_and_counted(age_s: float, text: str, refused: int) -> None:
    drain, item = Drain(), (round(age_s * 1e9), 0)
    for _ in range(NOTED_RUN - 1):
        assert drain.cycle(item) == []
    assert text in drain.cycle(item)[0]
    assert drain.count("conversions_refused") == NOTED_RUN * refused
    assert drain.count("conversions") == NOTED_RUN * (1 - refused)


def test_old_conversions_in_the_queue_of_a_start_are_no_other_clock() -> None:
    drain = Drain()
    for _ in range(3 * NOTED_RUN):
        assert drain.cycle(*[(40_000_000_000, 0)] * 5, (0, 0)) == []
    assert drain.cycle() == []
    drain.cycle((40_000_000_000, 0))
    assert drain.count("conversions_refused") == 5 * 3 * NOTED_RUN + 1


def test_a_channel_that_does_not_exist_is_noted_and_the_others_go_on() -> None:
    drain = Drain()
    (note,) = drain.cycle((0, 0), (0, 3), (0, 1))
    assert "channel 3 of the driver is not one of its 2 channels" in note
    assert drain.mem.inputs[0]["n_conversions"] == drain.count("conversions") == 2
    assert drain.count("conversions_refused") == 1
    drain.cycle(*[(0, 0)] * (MAX_CONVERSIONS + 7))
    assert (drain.count("conversions_skipped"), drain.count("conversions_refused")) == (7, 1)


@pytest.mark.parametrize(
    ("time_text", "channel", "says"),
    [
        ("0", 0, "behind CLOCK_MONOTONIC"),
        (f"{NOW} // 1000", 0, "behind CLOCK_MONOTONIC"),
        (f"{NOW} - 40 * 10**9", 0, "the driver's timestamps lie 40.0 s behind CLOCK_MONOTONIC"),
        (NOW, 3, "channel 3 of the driver is not one of its 1 channels"),
    ],
)
def test_the_status_names_what_is_wrong_with_an_own_driver(
    tmp_path: Path, time_text: str, channel: int, says: str
) -> None:
    (tmp_path / "oddlaser.py").write_text(DRIVER.format(time=time_text, channel=channel))
    config = "log_words = 65536\n[map]\ngrids = 20000\n[driver]\nkind = 'oddlaser:make'\n"
    service = Service(tmp_path, config)
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    try:
        service.start(env=os.environ | {"PYTHONPATH": path})
        with service.observe() as watcher:
            until(lambda: says in watcher.status()["main"]["text"], "the note")
            found = watcher.status()
        assert found["conversions"] == 0
        assert found["conversions_refused"] > 0
        assert "0 conversions taken, " in service.run("status").stdout
    finally:
        service.purge()
