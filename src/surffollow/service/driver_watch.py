"""Ask the driver for faults and notes in a thread of its own: one that fails or blocks delays no other."""

from __future__ import annotations

import contextlib
import threading
import time

from surffollow.hw.driver import Driver, notes_of, texts_of

EVERY_S = 0.05
SILENT_S = 1.0


class DriverWatch:
    """The driver's newest answer; `faults` never blocks and never raises.

    Parameters
    ----------
    driver : Driver, started or not
    """

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self._faults: list[str] = []
        self._notes: list[str] = []
        self._asked_s = 0.0  # 0: not asked now
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._ask, name="driver-faults", daemon=True)

    def start(self) -> None:
        """Begin to ask."""
        self._thread.start()

    def faults(self) -> list[str]:
        """Faults that the driver reported last, or that it does not answer."""
        asked, now = self._asked_s, time.monotonic()
        if asked and now - asked > SILENT_S:
            return [f"the driver has not answered faults() for {now - asked:.0f} s"]
        return self._faults

    def notes(self) -> list[str]:
        """Notes of the driver that are no faults, as it reported last."""
        return self._notes

    def _ask(self) -> None:
        while not self._over.wait(EVERY_S):
            self._asked_s = time.monotonic()
            try:
                found = texts_of(self._driver.faults())
                self._notes = notes_of(self._driver)
            except Exception as e:
                found = [f"the driver's faults() raised {e!r}"]
            self._faults, self._asked_s = found, 0.0
        self._end_driver()  # here: a thread for it cannot always be had

    def stop(self, patience_s: float) -> None:
        """Ask no more and stop the driver; one that does not return in time is left to itself."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(patience_s)
            if not self._thread.is_alive():
                return
        # it was never asked, or it hangs in `faults`
        ending = threading.Thread(target=self._end_driver, name="driver-stop", daemon=True)
        with contextlib.suppress(RuntimeError):  # no more threads: its process ends in a moment
            ending.start()
            ending.join(patience_s)

    def _end_driver(self) -> None:
        try:
            self._driver.stop()
        except Exception as e:
            self._faults = [f"the driver's stop() raised {e!r}"]
