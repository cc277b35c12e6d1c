"""The kernel that takes pushed ranges out of a client's slot, beside a slow twin that does the same."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import pytest

from hw.wires import Ring
from surffollow.errors import ConfigError, DriverError
from surffollow.hw.driver import ConversionQueue
from surffollow.hw.external import ExternalConfig, ExternalDriver
from surffollow.hw.pushed_ranges import FUTURE_NS, OLDEST_NS, REASONS, _take_item, close_queue, take_pushed
from surffollow.hw.registry import make_driver
from surffollow.shm import layout_slot as ls
from surffollow.shm.conversion import conversion_channel, conversion_counts, conversion_flags

NOW = 10_000_000_000
WINDOW = {"range_min_m": "50 mm", "range_max_m": "300 mm"}


class Twin:
    """Slow twin of `take_pushed`."""

    def __init__(self, channels: int) -> None:
        self.channels, self.seen, self.newest = channels, 0, [0] * 8
        self.out: list[tuple[int, int, float | None]] = []
        self.refused, self.skipped = [0] * REASONS, 0

    def take(self, ring: Ring, held: int, at_most: int, now_ns: int) -> None:
        new = ring.pushed[self.seen :]
        self.skipped += max(0, len(new) - at_most)
        first = max(self.seen, len(ring.pushed) - at_most)
        for index in range(first, len(ring.pushed)):
            number, t_ns, channel, range_m = ring.pushed[index]
            if number != index + 1:
                self.refused[3] += 1
            elif not (0 <= channel < self.channels and held >> channel & 1):
                self.refused[0] += 1
            elif t_ns > now_ns + FUTURE_NS or t_ns < now_ns - OLDEST_NS:
                self.refused[1] += 1
            elif t_ns <= self.newest[channel]:
                self.refused[2] += 1
            else:
                self.newest[channel] = t_ns
                seen = math.isfinite(range_m) and abs(range_m) < 8.0
                self.out.append((t_ns, channel, range_m if seen else None))
        self.seen = len(ring.pushed)


def started(channels: int = 3) -> tuple[ExternalDriver, ConversionQueue]:
    driver = make_driver({"kind": "external", "channels": channels, **WINDOW}, "x")
    assert isinstance(driver, ExternalDriver)
    queue = ConversionQueue(1 << 12)
    driver.start(queue)
    return driver, queue


def delivered(driver: ExternalDriver, queue: ConversionQueue) -> list[tuple[int, int, float | None]]:
    out: list[tuple[int, int, float | None]] = []
    for t_ns, word in queue.drain().tolist():
        channel = conversion_channel(word)
        range_m = conversion_counts(word) * driver.info.scale_m[channel]
        out.append((t_ns, channel, None if conversion_flags(word) & 1 else range_m))
    return out


def random_push(rng: np.random.Generator, ring: Ring, now_ns: int) -> None:
    """As a rule an honest range; now and then what no client should write."""
    t_ns = now_ns - int(rng.integers(0, 1_000_000))
    channel, range_m, number = int(rng.integers(0, 4)), float(rng.uniform(0.05, 0.3)), None
    kind = rng.integers(0, 12)
    if kind == 0:
        t_ns = int(rng.choice([0, -(2**63), 2**63 - 1, now_ns + 10**9, now_ns - 2 * 10**9]))
    elif kind == 1:
        channel = int(rng.choice([-1, 8, 2**40, -(2**63)]))
    elif kind == 2:
        range_m = float(rng.choice([math.nan, math.inf, -math.inf, 1e300, -1.0, 0.0]))
    elif kind == 3:
        number = int(rng.integers(-(2**62), 2**62))
    ring.push(t_ns, channel, range_m, number)


@pytest.mark.parametrize("seed", range(20))
def test_what_is_taken_is_what_the_slow_twin_takes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    driver, queue = started()
    ring, twin, now_ns, seen = Ring(), Twin(3), NOW, 0
    for _ in range(60):
        now_ns += int(rng.integers(0, 3_000_000))
        for _ in range(int(rng.choice([0, 1, 2, 5, 20, 100]))):
            random_push(rng, ring, now_ns)
        held, at_most = int(rng.integers(0, 8)), int(rng.integers(1, 65))
        seen, *_ = take_pushed(driver.pushed, ring.address, seen, held, at_most, now_ns)
        twin.take(ring, held, at_most, now_ns)
    found = delivered(driver, queue)
    assert len(found) == len(twin.out) > 20, seed
    for (t_ns, channel, range_m), (t_twin, c_twin, r_twin) in zip(found, twin.out, strict=True):
        assert (t_ns, channel) == (t_twin, c_twin), seed
        assert range_m == (None if r_twin is None else pytest.approx(r_twin, abs=0.51e-6)), seed
    record = driver.pushed[0]
    assert record["refused"].tolist() == twin.refused, seed
    assert (record["skipped"], record["taken"]) == (twin.skipped, len(twin.out)), seed


@pytest.mark.parametrize("head", [5000, -1, 2**63 - 1, -(2**63), 1 << 50])
def test_a_head_that_is_no_count_of_pushes_gives_no_distance_and_the_next_push_counts(head: int) -> None:
    driver, queue = started()
    ring = Ring()
    ring.push(NOW, 0, 0.1)
    ring.words[0] = head
    seen, *_ = take_pushed(driver.pushed, ring.address, 0, 1, 64, NOW)
    assert len(queue) == 0
    record = driver.pushed[0]
    assert record["refused"].sum() > 0
    assert record["skipped"] >= 0
    if head == 2**63 - 1:
        return
    ring.push(NOW + 1, 0, 0.2)
    take_pushed(driver.pushed, ring.address, seen, 1, 64, NOW)
    assert delivered(driver, queue) == [(NOW + 1, 0, pytest.approx(0.2))]


@pytest.mark.parametrize(("ahead", "taken"), [(0, 1), (126, 1), (127, 0), (128, 0), (-1, 0)])
def test_an_item_that_may_have_been_written_over_while_it_was_copied_is_left_out(
    ahead: int, taken: int
) -> None:
    driver, queue = started()
    ring = Ring()
    ring.push(NOW, 0, 0.1)
    item, number = ring.address + ls.RANGES_AT, 1
    ring.words[0] = number + ahead  # as the second look at the head finds it
    answer = _take_item(driver.pushed, queue.address, item, number, 1, NOW, ring.address)
    assert (answer, len(queue)) == (taken, taken)


def test_of_a_flood_the_newest_few_are_looked_at() -> None:
    driver, queue = started()
    ring = Ring()
    for k in range(2000):
        ring.push(NOW + k, 0, 0.1)
    assert take_pushed(driver.pushed, ring.address, 0, 1, 64, NOW) == (2000, 64, 0, 1936)
    assert [t_ns for t_ns, _, _ in delivered(driver, queue)] == [NOW + k for k in range(1936, 2000)]
    driver.faults()
    assert "left out: they come faster than the cycle takes them" in "; ".join(driver.faults())


def test_after_stop_nothing_is_pushed_and_a_new_start_goes_on() -> None:
    driver, queue = started()
    ring = Ring()
    driver.stop()
    ring.push(NOW, 0, 0.1)
    seen, *_ = take_pushed(driver.pushed, ring.address, 0, 1, 64, NOW)
    assert len(queue) == 0
    driver.start(queue)
    ring.push(NOW + 1, 0, 0.1)
    take_pushed(driver.pushed, ring.address, seen, 1, 64, NOW)
    assert len(queue) == 1


def test_stop_waits_until_the_cycle_has_left_the_queue() -> None:
    driver, _ = started()
    driver.pushed[0]["busy"] = 1  # the cycle hangs in the middle of a push
    with pytest.raises(DriverError, match="has been pushing one range"):
        driver.stop()
    assert close_queue(driver.pushed.ctypes.data) == 1
    driver.pushed[0]["busy"] = 0
    driver.stop()


def test_faults_say_who_is_silent_and_what_was_refused() -> None:
    driver, _ = started(2)
    # before the first range a channel's silence is no fault: the sensor's program starts after the service
    assert [t.split(":")[0] for t in driver.notes()] == ["channel 0", "channel 1"]
    assert driver.faults() == []
    now_ns = time.monotonic_ns()
    driver.pushed[0]["received_ns"][:2] = now_ns, now_ns - 3_000_000_000
    assert driver.notes() == []
    assert [t.split(":")[0] for t in driver.faults()] == ["channel 0", "channel 1"]
    driver.pushed[0]["claimed_ns"][:2] = now_ns, now_ns - 2_000_000_000
    assert "has pushed no range for 2" in "; ".join(driver.faults())
    assert "silence_s is 500 ms" in "; ".join(driver.faults())  # it may be a slow sensor
    driver.pushed[0]["received_ns"][1] = now_ns
    assert driver.faults() == []
    ring = Ring()
    ring.push(NOW, 0, 0.1)
    take_pushed(driver.pushed, ring.address, 0, 1, 64, now_ns)
    assert "1 pushed ranges were refused, with a time" in "; ".join(driver.faults())


def test_settings_that_cannot_be_are_reported() -> None:
    for wrong in ({"latency_s": 2.0}, {"silence_s": 0.0}, {"channels": 9}, {"range_max_m": 0.01}):
        settings: dict[str, Any] = {"range_min_m": 0.05, "range_max_m": 0.3, **wrong}
        with pytest.raises(ConfigError):
            ExternalDriver(ExternalConfig(**settings))
