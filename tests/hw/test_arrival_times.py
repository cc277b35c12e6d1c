"""Stamps from delayed arrivals: right for a sensor with a rhythm, those of its arrivals for any other."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow.hw.wire.arrival_times import MIN_INCREMENTS, ArrivalClock

FRAME_NS = 694_000  # 8 bytes at 115200 baud
PERIOD_NS = 1_000_000


def reads(begin_ns: np.ndarray, delay_ns: np.ndarray) -> list[tuple[list[int], list[int]]]:
    """Frames as a reader gets them: those that are there when a read returns, with what it knows of them.

    A frame can be read `delay_ns` after its end; the frames of one read count back from its time.
    """
    ready = np.maximum.accumulate(begin_ns + FRAME_NS + delay_ns)
    out: list[tuple[list[int], list[int]]] = []
    k = 0
    while k < len(begin_ns):
        now = ready[k]
        n = int(np.searchsorted(ready, now, side="right")) - k
        arrivals = [int(now) - FRAME_NS * (n - j) for j in range(n)]
        out.append((list(range(k, k + n)), arrivals))
        k += n
    return out


def stamped(begin_ns: np.ndarray, delay_ns: np.ndarray) -> np.ndarray:
    clock, out, last = ArrivalClock(), np.zeros(len(begin_ns)), 0
    for frames, arrivals in reads(begin_ns, delay_ns):
        stamps = clock.stamps(arrivals)
        before = [last, *stamps[:-1]]
        latest = [max(a, b + 1) for a, b in zip(arrivals, before, strict=True)]
        assert all(s <= most for s, most in zip(stamps, latest, strict=True)), "later than it arrived"
        assert all(b > a for a, b in zip([last, *stamps], stamps, strict=False)), "times must ascend"
        last = stamps[-1]
        out[frames] = stamps
    return out


def busy(rng: np.random.Generator, begin_ns: np.ndarray) -> np.ndarray:
    """Delays on a busy machine: a little always; now and then nothing is handed over for milliseconds."""
    end_ns = begin_ns + FRAME_NS
    delay = rng.exponential(0.1e6, len(begin_ns))
    over = end_ns[0]
    while over < end_ns[-1]:
        start = over + rng.exponential(60e6)
        over = start + rng.uniform(1e6, 20e6)
        first, last = np.searchsorted(end_ns, (start, over))
        delay[first:last] = np.maximum(delay[first:last], over - end_ns[first:last])
    return delay


@pytest.mark.parametrize("seed", range(8))
def test_a_regular_sensor_on_a_busy_machine_is_stamped_within_a_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 20_000
    period = PERIOD_NS * (1.0 + rng.uniform(-2e-3, 2e-3))  # the sensor's clock is not ours
    begin = 10**12 + np.cumsum(np.full(n, period) + rng.normal(0.0, 5e3, n))
    delay = busy(rng, begin)
    error = np.abs(stamped(begin, delay) - begin)[1000:]
    assert np.percentile(error, 99) < FRAME_NS, seed
    arrivals = np.array([a for _, found in reads(begin, delay) for a in found])
    assert np.percentile(np.abs(arrivals - begin)[1000:], 99) > 3 * FRAME_NS  # or the test shows nothing


def test_after_a_pause_the_rhythm_begins_with_the_arrival() -> None:
    rng = np.random.default_rng(5)
    steps = np.full(3000, float(PERIOD_NS))
    steps[1000], steps[2000] = 0.5e9, 7.3e6
    begin = 10**12 + np.cumsum(steps)
    error = stamped(begin, rng.exponential(0.02e6, 3000)) - begin
    assert np.abs(error[200:]).max() < 0.3 * FRAME_NS


def test_a_frame_that_is_missing_is_noticed_within_a_window() -> None:
    begin = 10**12 + np.cumsum(np.full(3000, float(PERIOD_NS)))
    begin[1500:] += PERIOD_NS  # one period without a frame: by itself it looks like a delay
    error = stamped(begin, np.full(3000, 1e3)) - begin
    assert np.abs(error[1500:1570]).max() <= 1.01 * PERIOD_NS
    assert np.abs(error[1570:]).max() < 0.05 * FRAME_NS


@pytest.mark.parametrize("seed", range(4))
def test_a_sensor_without_rhythm_keeps_its_arrivals(seed: int) -> None:
    rng = np.random.default_rng(seed)
    begin = 10**12 + np.cumsum(rng.uniform(0.8e6, 5e6, 3000))
    delay = rng.exponential(0.02e6, 3000)
    expected = [a for _, found in reads(begin, delay) for a in found]
    assert stamped(begin, delay).tolist() == expected


def test_a_sensor_that_changes_its_rate_is_followed() -> None:
    begin = 10**12 + np.cumsum(np.r_[np.full(2000, 1.0e6), np.full(3000, 4.0e6), np.full(3000, 2.0e6)])
    error = np.abs(stamped(begin, np.full(8000, 1e3)) - begin)
    assert error[2000:].max() <= 3.01e6  # greatest delay: three periods of before, for a moment
    assert np.percentile(error, 95) < 0.05 * FRAME_NS


def test_the_first_frames_keep_their_arrivals() -> None:
    clock = ArrivalClock()
    for k in range(MIN_INCREMENTS // 2):
        assert clock.stamps([k * PERIOD_NS + 5]) == [k * PERIOD_NS + 5]
    assert clock.stamps([]) == []


@pytest.mark.parametrize("hertz", [98, 96, 92, 88, 84, 60, 110])
def test_a_sensor_that_changes_its_rate_is_stamped_at_the_new_one(hertz: int) -> None:
    # GIVEN a sensor of 100 Hz WHEN it measures more slowly from one frame on
    steps_ns = np.concatenate([np.full(1000, 10_000_000), np.full(3000, round(1e9 / hertz))])
    begin_ns = np.cumsum(steps_ns) + 10**9
    delay_ns = FRAME_NS + np.random.default_rng(3).uniform(0.0, 0.2e6, len(begin_ns))
    # THEN its times are right again, and do not fall back by periods
    late_ns = (stamped(begin_ns, delay_ns) - begin_ns)[2000:]
    assert np.abs(late_ns).max() < 1e6
