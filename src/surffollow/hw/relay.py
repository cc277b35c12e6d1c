"""The relay of a driver around another one: a thread that moves conversions from one queue to the next."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from surffollow.hw.driver import ConversionQueue, Driver, texts_of
from surffollow.hw.driver_thread import DriverThread
from surffollow.hw.wrapped_driver import WrappingDriver
from surffollow.shm.schema import I64, Schema


class RelayQueues(Schema):
    """Addresses of the two queues and of scratch."""

    inner_ring = I64(doc="queue that the inner driver fills")
    inner_capacity = I64()
    ring = I64(doc="queue of the service")
    capacity = I64()
    lost = I64(doc="counter of conversions that found the service's queue full")
    item = I64(2, doc="timestamp and packed conversion that are under way")
    item_address = I64()


class RelayDriver(WrappingDriver):
    """A driver whose conversions pass a relay thread.

    Parameters
    ----------
    inner : Driver
        the driver whose conversions are changed on their way
    name : str
        of the relay's thread
    capacity : int
        conversions that the queue between the drivers holds, a power of two
    """

    def __init__(self, inner: Driver, name: str, capacity: int) -> None:
        super().__init__(inner)
        self._thread = DriverThread(name)
        self._between = ConversionQueue(capacity)

    def _start_relay(
        self,
        queue: ConversionQueue,
        queues: Any,
        kernel: Callable[[int], None],
        before_inner: Callable[[], None] = lambda: None,
    ) -> None:
        """Start the relay thread, then the inner driver.

        Parameters
        ----------
        queue : ConversionQueue
            of the service
        queues : (1,) `RelayQueues`
            written
        kernel : callable
            runs in the thread until its control words say `STOP`; gets their address
        before_inner : callable
            called before the inner driver starts
        """
        between = ConversionQueue(self._between.capacity)
        queues["inner_ring"], queues["inner_capacity"] = between.address, between.capacity
        queues["ring"], queues["capacity"], queues["lost"] = queue.address, queue.capacity, queue.lost_address
        queues["item_address"] = queues.ctypes.data + RelayQueues.offset("item")
        self._thread.start(kernel, keep=(queue, between))
        self._between = between
        try:
            before_inner()
            self._inner.start(between)
        except BaseException:
            self._thread.stop()
            raise

    def stop(self) -> None:
        """End both drivers; see `Driver`."""
        self._inner.stop()
        self._thread.stop()

    def _relay_faults(self, relay: str) -> list[str]:
        """Faults of the inner driver, and conversions that the relay lost."""
        lost = self._between.overflow
        return texts_of(self._inner.faults()) + ([f"{relay} lost {lost} conversions"] if lost else [])
