"""The contract of drivers, as checks that run on any driver.

In a test:

    from surffollow.hw.contract import check_driver
    check_driver(lambda: MyDriver({"port": "/dev/pts/3"}, "test"))

From a shell, with a configuration file's [driver] table:

    python -m surffollow.hw.contract service.toml
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from surffollow.errors import DriverError, SurffollowError
from surffollow.hw.driver import ConversionQueue, Driver, DriverInfo
from surffollow.hw.ranges import AHEAD_NS
from surffollow.shm.conversion import (
    FLAG_INVALID,
    FLAG_OUTSIDE,
    OUTSIDE_M,
    conversion_channel,
    conversion_counts,
    conversion_dt_ns,
    conversion_flags,
)
from surffollow.shm.layout_follow import CHANNELS
from surffollow.units import format_ns

OLDEST_NS = 2_000_000_000  # a conversion handed over after a start may be that much older than the start
STOP_S = 5.0
QUIET_S = 0.05


class ContractError(AssertionError):
    """A driver does not do what drivers must; the text says what, and what was expected."""


def _demand(met: bool, text: str) -> None:
    if not met:
        raise ContractError(text)


def _wait(met: Callable[[], bool], timeout_s: float, text: str) -> None:
    end = time.monotonic() + timeout_s
    while not met():
        _demand(time.monotonic() < end, f"{text} within {timeout_s:g} s")
        time.sleep(0.001)


def check_description(driver: Driver) -> None:
    """Its description can be used: window, scales, mounts, latency; and stays the same."""
    _demand(isinstance(driver, Driver), f"{type(driver).__name__} lacks info, start, stop or faults")
    info = driver.info
    _demand(isinstance(info, DriverInfo), f"info is a {type(info).__name__}, expected a DriverInfo")
    _demand(
        0.0 <= info.range_min_m < info.range_max_m < np.inf,
        f"window {info.range_min_m} to {info.range_max_m} m, expected 0 <= range_min_m < range_max_m",
    )
    scales = info.scale_m[: info.n_channels]
    _demand(
        all(s != 0.0 and np.isfinite(s) for s in scales),
        f"scale_m {scales}: expected finite, not 0, per channel",
    )
    _demand(len(info.mounts) == len(info.scale_m) == len(info.zero_m) == CHANNELS, "expected eight of each")
    _demand(info.latency_ns >= 0, f"latency_ns is {info.latency_ns}, expected 0 or more")
    _demand(driver.info == info, "info changed from one look to the next")


def check_items(driver: Driver, queue: ConversionQueue, items: NDArray[np.int64], started_ns: int) -> None:
    """Times ascend and are past; channels are its own; the time part of a word is 0.

    Parameters
    ----------
    driver : Driver
    queue : ConversionQueue
        that it filled
    items : (n, 2) int64
        what was drained of it
    started_ns : int
        when the driver was started [ns]
    """
    t_ns, now_ns = items[:, 0], time.monotonic_ns()
    _demand(bool((np.diff(t_ns) >= 0).all()), "timestamps go back")
    _demand(bool((t_ns <= now_ns).all()), "a timestamp lies ahead; use CLOCK_MONOTONIC (time.monotonic_ns)")
    _demand(
        queue.ahead_ns <= AHEAD_NS,
        f"timestamps lie ahead of CLOCK_MONOTONIC, by up to {format_ns(queue.ahead_ns)}; use "
        "time.monotonic_ns()",
    )
    _demand(
        bool((t_ns >= started_ns - OLDEST_NS).all()),
        f"a timestamp is older than the start by more than {OLDEST_NS * 1e-9:g} s; use CLOCK_MONOTONIC",
    )
    for word in items[:, 1].tolist():
        channel = conversion_channel(word)
        _demand(channel < driver.info.n_channels, f"channel {channel} of {driver.info.n_channels}")
        _demand(conversion_dt_ns(word) == 0, "bits 32-63 of a queued word must be 0")


def _distance_m(info: DriverInfo, word: int) -> float:
    """The distance of a conversion [m]; NaN: the sensor sees nothing."""
    counts, flags, channel = conversion_counts(word), conversion_flags(word), conversion_channel(word)
    if flags & FLAG_OUTSIDE:
        return OUTSIDE_M * float(counts)
    return np.nan if flags & FLAG_INVALID else info.zero_m[channel] + info.scale_m[channel] * float(counts)


def _await_distance(driver: Driver, queue: ConversionQueue, timeout_s: float) -> NDArray[np.int64]:
    """Take a driver's conversions until there are five, and one of them is a distance inside the window."""
    info, items, inside, last_m = driver.info, [], 0, np.nan

    def delivered() -> bool:
        nonlocal inside, last_m
        for t_ns, word in queue.drain().tolist():
            items.append((t_ns, word))
            last_m = _distance_m(info, word)
            inside += info.range_min_m < last_m < info.range_max_m
        return len(items) >= 5 and inside > 0

    try:
        _wait(delivered, timeout_s, "")
    except ContractError:
        if len(items) < 5:
            faults = "".join(f"; {text}" for text in driver.faults())
            raise ContractError(f"no five conversions within {timeout_s:g} s{faults}") from None
        last = f"the last one is {last_m:.6g} m; is the unit metres?"
        raise ContractError(
            f"no distance was inside the window {info.range_min_m:g} to {info.range_max_m:g} m: "
            + ("the sensor sees nothing; give it a target" if np.isnan(last_m) else last)
        ) from None
    return np.array(items, np.int64)


def check_faults(driver: Driver) -> None:
    """`faults` gives a list of texts, in every state."""
    faults = driver.faults()
    _demand(
        isinstance(faults, list) and all(isinstance(f, str) and f for f in faults),
        f"faults() gave {faults!r}, expected a list of texts",
    )


def _stop(driver: Driver) -> None:
    began = time.monotonic()
    driver.stop()
    took_s = time.monotonic() - began
    _demand(took_s <= STOP_S, f"stop() took {took_s:.1f} s, expected at most {STOP_S:g} s")


def check_driver(make: Callable[[], Driver], *, delivers: bool = True, timeout_s: float = 20.0) -> list[str]:
    """Run every check on drivers made by `make`; the device behind them must deliver all the time.

    Parameters
    ----------
    make : makes a driver that is not started
    delivers : False for one that may never deliver anything
    timeout_s : how long to wait for conversions [s]

    Returns
    -------
    list of str
        what was checked

    Raises
    ------
    ContractError
        (an AssertionError) the first check that fails
    """
    done = []
    driver = make()
    check_description(driver)
    check_faults(driver)
    driver.stop()
    driver.stop()
    done.append("description; faults and stop before a start")

    for turn in range(2):
        queue, started_ns, before = ConversionQueue(), time.monotonic_ns(), threading.active_count()
        driver.start(queue)
        try:
            items = _await_distance(driver, queue, timeout_s) if delivers else queue.drain()
            try:
                driver.start(queue)
            except DriverError:
                pass
            else:
                raise ContractError("a second start() without stop() must raise DriverError")
            check_faults(driver)
        finally:
            _stop(driver)
        check_items(driver, queue, np.concatenate((items, queue.drain())), started_ns)
        time.sleep(QUIET_S)
        _demand(len(queue) == 0, f"{len(queue)} conversions were pushed after stop() had returned")
        _demand(threading.active_count() <= before, "a thread is left after stop()")
        done.append(f"conversions, start twice, stop, silence after it (start {turn + 1})")

    queue = ConversionQueue(4)
    driver.start(queue)
    try:
        if delivers:
            _wait(lambda: queue.overflow > 0, timeout_s, "a full queue was not counted as such")
    finally:
        _stop(driver)
    _demand(len(queue) <= 4, "a full queue grew")
    done.append("a full queue is counted and stops nothing")
    return done


def main(words: list[str]) -> int:
    """Check the driver of a configuration file."""
    from surffollow.config.service import load_config
    from surffollow.hw.registry import make_driver

    if len(words) != 1:
        print("usage: python -m surffollow.hw.contract CONFIG.toml", file=sys.stderr)
        return 2
    try:
        config = load_config(words[0])
        for line in check_driver(lambda: make_driver(config.driver, config.name)):
            print(f"ok: {line}")
    except (SurffollowError, ContractError) as error:
        print(f"contract: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
