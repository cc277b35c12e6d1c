"""The one interface between the service and range sensors of any kind.

A driver fills a queue in process-private memory from a thread of its own; the service's cycle drains it.
Each item is the time at which a conversion ended and the conversion's word (`shm.conversion`, dt 0).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Protocol, runtime_checkable

import msgspec
import numpy as np
from numpy.typing import NDArray

from surffollow.errors import ConfigError
from surffollow.shm import atomics as at
from surffollow.shm.conversion import ITEM_WORDS
from surffollow.shm.jit import jit
from surffollow.shm.layout_follow import CHANNELS
from surffollow.shm.ring import make_ring, ring_drop, ring_length, ring_peek, ring_push

IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
Mount = tuple[float, float, float, float, float, float, float]
Eight = tuple[float, float, float, float, float, float, float, float]


class DriverInfo(msgspec.Struct, frozen=True):
    """Description of a driver for the service; constant while it runs.

    Attributes
    ----------
    name : for messages
    n_channels : channels 0 … n-1 deliver
    scale_m, zero_m : per channel, range_m = zero_m + scale_m · counts
    range_min_m, range_max_m : the sensors' window [m]
    latency_ns : mean age of the range in a conversion, at the conversion's timestamp [ns]
    conversion_period_ns : from one conversion of any channel to the next [ns]; 0: irregular
    mounts : tool from sensor per channel, x y z [m] and a unit quaternion; the beam leaves along −z

    Examples
    --------
    >>> from surffollow.hw import metre_info
    >>> info = metre_info("laser", 0.05, 0.3, latency_ns=500_000)
    >>> round(info.zero_m[0] + 100_000 * info.scale_m[0], 6)      # range_m of 100 000 counts
    0.1
    """

    name: str
    n_channels: int
    scale_m: Eight
    zero_m: Eight
    range_min_m: float
    range_max_m: float
    latency_ns: int
    conversion_period_ns: int
    mounts: tuple[Mount, ...] = (IDENTITY,) * CHANNELS

    def __post_init__(self) -> None:
        if not 1 <= self.n_channels <= CHANNELS or len(self.mounts) != CHANNELS:
            raise ConfigError(f"a driver has 1 to {CHANNELS} channels and {CHANNELS} mounts")


def mounts_of(given: list[Mount] | tuple[Mount, ...], n_channels: int) -> tuple[Mount, ...]:
    """Eight mounts from those given: normalised, identity for the rest.

    Parameters
    ----------
    given : one mount per channel; none: every sensor at the tool's origin, looking along −z

    Raises
    ------
    ConfigError
        another number of mounts than channels, or one that is no pose
    """
    if given and len(given) != n_channels:
        raise ConfigError(
            f"{len(given)} mounts for {n_channels} channels; give one mount per channel, or none when every "
            "sensor looks from the tool's origin along -z"
        )
    out: list[Mount] = []
    for n, mount in enumerate(given):
        if not np.isfinite(mount).all():
            raise ConfigError(f"mount {n} holds {mount}; x y z [m] and qx qy qz qw must be finite numbers")
        norm = float(np.linalg.norm(mount[3:]))
        if abs(norm - 1.0) > 1e-3:
            raise ConfigError(
                f"mount {n}: qx qy qz qw = {mount[3:]} is no unit quaternion, its norm is {norm:.4g}; "
                "it must be 1"
            )
        x, y, z, qx, qy, qz, qw = mount
        out.append((x, y, z, qx / norm, qy / norm, qz / norm, qw / norm))
    return tuple(out) + (IDENTITY,) * (CHANNELS - len(out))


class ConversionQueue:
    """The queue between one driver and one cycle; bounded, wait-free on both sides.

    Parameters
    ----------
    capacity : int, a power of two; 16384 holds 0.65 s of a 25 kHz converter

    Attributes
    ----------
    address : int, of the ring, for `shm.ring`'s kernels
    lost_address : int, of the count of conversions that found no room
    ahead_ns : int, how far a time given to a `RangeWriter` lay ahead of CLOCK_MONOTONIC at most [ns]

    Examples
    --------
    >>> from surffollow.hw import ConversionQueue, metre_info, pack_range
    >>> queue = ConversionQueue(64)
    >>> queue.push(1_000_000, pack_range(metre_info("laser", 0.05, 0.3), 0, 0.1234))
    >>> queue.drain()
    array([[1000000,  123400]])
    >>> len(queue), queue.overflow
    (0, 0)
    """

    def __init__(self, capacity: int = 16384) -> None:
        self.capacity, self.ahead_ns = capacity, 0
        self._ring = make_ring(capacity, ITEM_WORDS)
        self._lost = np.zeros(1, np.int64)
        self._item = np.zeros(ITEM_WORDS, np.int64)
        self.address = int(self._ring.ctypes.data)
        self.lost_address = int(self._lost.ctypes.data)
        self._item_address = int(self._item.ctypes.data)

    @property
    def overflow(self) -> int:
        """Conversions lost because the queue was full."""
        return int(self._lost[0])

    def __len__(self) -> int:
        return int(ring_length(self.address))

    def push(self, t_ns: int, word: int) -> None:
        """Append a conversion (producer only).

        Parameters
        ----------
        t_ns : int
            when it was true, CLOCK_MONOTONIC [ns]
        word : int
            packed conversion, see `pack_range`
        """
        push_conversion(self.address, self.capacity, self.lost_address, self._item_address, t_ns, word)

    def drain(self, at_most: int | None = None) -> NDArray[np.int64]:
        """Take what is there (consumer only): (n, 2) int64, time [ns] and word.

        Parameters
        ----------
        at_most : int, optional
            most conversions; None: all

        Returns
        -------
        (n, 2) int64
            time [ns] and word of each conversion
        """
        waiting = len(self)
        out = np.zeros((waiting if at_most is None else min(waiting, at_most), ITEM_WORDS), np.int64)
        first = int(out.ctypes.data)
        for row in range(first, first + out.nbytes, ITEM_WORDS * out.itemsize):
            ring_peek(self.address, self.capacity, ITEM_WORDS, row)
            ring_drop(self.address, 1)
        return out


REPORT_WORDS = 8  # timestamp [ns], x y z [m] and unit quaternion


class PoseQueue:
    """Poses that the service accepted, for a driver that simulates sensors on them; see `reports_of`.

    Parameters
    ----------
    capacity : int, a power of two; 256 holds 0.25 s of the fastest reports

    Attributes
    ----------
    address : int, of the ring, for `shm.ring`'s kernels
    """

    def __init__(self, capacity: int = 256) -> None:
        self.capacity = capacity
        self._ring = make_ring(capacity, REPORT_WORDS)
        self.address = int(self._ring.ctypes.data)

    def push(self, t_ns: int, pose: Sequence[float]) -> bool:
        """Append a pose (producer only); False when the queue is full."""
        item = np.zeros(REPORT_WORDS, np.int64)
        item[0] = t_ns
        item[1:].view(np.float64)[:] = pose
        return bool(ring_push(self.address, self.capacity, REPORT_WORDS, item.ctypes.data))


@jit
def push_conversion(ring: Any, capacity: Any, lost: Any, item: Any, t_ns: Any, word: Any) -> None:
    """Append a conversion, or count it as lost.

    Parameters
    ----------
    ring, capacity, lost : int64, `ConversionQueue.address`, `.capacity`, `.lost_address`
    item : int64, address of two private words
    t_ns, word : int64 [ns], packed conversion
    """
    at.store_relaxed_i64(item, t_ns)
    at.store_relaxed_i64(item + 8, word)
    if ring_push(ring, capacity, ITEM_WORDS, item) == 0:
        at.store_relaxed_i64(lost, at.load_relaxed_i64(lost) + 1)


@runtime_checkable
class Driver(Protocol):
    """Interface of a sensor driver to the service.

    Examples
    --------
    >>> import time
    >>> from surffollow.hw import ConversionQueue, Driver, RangeWriter, metre_info
    >>> class Fixed:
    ...     '''A driver that measures 0.1 m once.'''
    ...     info = metre_info("fixed", 0.05, 0.3)
    ...     def start(self, queue):     # a real driver starts a thread, which pushes
    ...         RangeWriter(queue, self.info).push(time.monotonic_ns(), 0.1)
    ...     def stop(self): ...
    ...     def faults(self):
    ...         return []
    >>> driver, queue = Fixed(), ConversionQueue(64)
    >>> driver.start(queue)
    >>> isinstance(driver, Driver), len(queue)
    (True, 1)
    """

    @property
    def info(self) -> DriverInfo:
        """Calibration, window, latency and mounts."""
        ...

    def start(self, queue: ConversionQueue) -> None:
        """Begin to fill the queue; returns when the driver's kernels are compiled and its thread runs.

        Parameters
        ----------
        queue : ConversionQueue
            to be filled; the service drains it
        """
        ...

    def stop(self) -> None:
        """End the thread; nothing is pushed after this returns. Harmless when not started."""
        ...

    def faults(self) -> list[str]:
        """Present faults, one line each; empty without any."""
        ...


def reports_of(driver: Driver) -> PoseQueue | None:
    """The queue of reported poses that a driver takes: its attribute `reports`, if it has one."""
    found = getattr(driver, "reports", None)
    return found if isinstance(found, PoseQueue) else None


def texts_of(answer: Iterable[object]) -> list[str]:
    """Texts that a driver answered; a single one is not taken for its letters."""
    return [answer] if isinstance(answer, str) else [str(text) for text in answer]


def notes_of(driver: Driver) -> list[str]:
    """Notes of a driver that are no faults: its method `notes()`, if it has one."""
    notes = getattr(driver, "notes", None)
    return texts_of(notes()) if callable(notes) else []
