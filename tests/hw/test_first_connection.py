"""A polled driver's first attempt to connect is no fault while it lasts."""

from __future__ import annotations

import threading

import pytest

from running_service import until
from surffollow.errors import DriverError
from surffollow.hw import ConversionQueue, PolledDriver, metre_info


class SlowDevice:
    """A device whose opening waits, and then fails."""

    name, rejected = "slow device", 0

    def __init__(self) -> None:
        self.asked, self.fails = threading.Event(), threading.Event()

    def open(self) -> None:
        self.asked.set()
        self.fails.wait()
        raise DriverError("it is not there")

    def read(self, timeout_s: float) -> list[tuple[int, int]]:
        return []

    def close(self) -> None:
        pass


@pytest.mark.parametrize(("silence_s", "faulty"), [(60.0, False), (0.0, True)])
def test_a_first_attempt_is_no_fault_until_it_fails_or_lasts(silence_s: float, faulty: bool) -> None:
    device = SlowDevice()
    driver = PolledDriver(metre_info("laser", 0.05, 0.3), device, silence_s=silence_s)
    driver.start(ConversionQueue(64))
    try:
        # GIVEN an attempt that lasts, THEN only one that takes too long is a fault
        assert device.asked.wait(60.0)
        assert bool(driver.faults()) == faulty
        # WHEN it fails, THEN it is one
        device.fails.set()
        until(lambda: driver.faults() and "it is not there" in driver.faults()[0], "the fault")
    finally:
        device.fails.set()
        driver.stop()
