"""A driver without sensors: for services that only keep a map, and for tests."""

from __future__ import annotations

from surffollow.errors import DriverError
from surffollow.hw.driver import ConversionQueue, DriverInfo, Eight
from surffollow.hw.simulation.adc import calibration
from surffollow.hw.simulation.led_config import FAR_M, NEAR_M


class SilentDriver:
    """Never delivers anything."""

    def __init__(self) -> None:
        s, z = calibration(NEAR_M, FAR_M)
        scale: Eight = (s, s, s, s, s, s, s, s)
        zero: Eight = (z, z, z, z, z, z, z, z)
        self._info = DriverInfo("no sensors", 1, scale, zero, NEAR_M, FAR_M, 0, 0)
        self._started = False

    @property
    def info(self) -> DriverInfo:
        """Window and calibration of the default sensor, so that a follower has something to divide by."""
        return self._info

    def start(self, queue: ConversionQueue) -> None:
        """Do nothing."""
        if self._started:
            raise DriverError("driver 'no sensors' was started twice; stop it first")
        self._started = True

    def stop(self) -> None:
        """Do nothing."""
        self._started = False

    def faults(self) -> list[str]:
        """Nothing can be wrong."""
        return []
