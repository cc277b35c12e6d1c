"""A/D converters of Linux IIO (kind = "iio"): buffered reads of the character device, with its timestamps.

Every file is looked for under a configurable root, so that a tree of plain files and a FIFO can stand for a
device. Units: an IIO voltage is (raw + offset) · scale in millivolts.
"""

from __future__ import annotations

import contextlib
import math
import os
import time
from pathlib import Path
from typing import Any

import msgspec

from surffollow.config.key_errors import convert_table
from surffollow.errors import ConfigError, DriverError
from surffollow.hw.driver import Driver, DriverInfo, Mount, mounts_of
from surffollow.hw.polled import PolledDriver
from surffollow.hw.range_settings import SILENCE_S, check_times
from surffollow.hw.ranges import pack_counts
from surffollow.hw.wire.iio_scan import calibration_of, eight_channels, find_device, scan_layout
from surffollow.shm.layout_follow import CHANNELS
from surffollow.shm.readable import wait_readable

READ_SCANS = 256


class IioConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A converter of Linux IIO.

    Attributes
    ----------
    device : its name (the file `name` of the device, "ads1115") or directory ("iio:device0")
    inputs : channels by their IIO names ("voltage0"), in the order of this service's channels
    metres_per_volt, metres_at_zero : distance of a voltage [m/V], [m]; 1 and 0 leave volts for a calibration
    range_min_m, range_max_m : the sensors' window [m]
    buffer : scans that the kernel keeps
    trigger : name of an IIO trigger to set; empty: as it is
    root : where sys and dev are looked for
    latency_s : age of the distance at a scan's timestamp [s]
    mounts, silence_s : see `RangeSettings`
    """

    device: str
    inputs: tuple[str, ...]
    range_min_m: float
    range_max_m: float
    metres_per_volt: float = 1.0
    metres_at_zero: float = 0.0
    buffer: int = 1024
    trigger: str = ""
    root: str = "/"
    latency_s: float = 0.0
    mounts: tuple[Mount, ...] = ()
    silence_s: float = SILENCE_S

    def __post_init__(self) -> None:
        if not 1 <= len(self.inputs) <= CHANNELS:
            raise ConfigError(f"{len(self.inputs)} inputs, expected 1 to {CHANNELS}")
        if len(set(self.inputs)) < len(self.inputs):
            raise ConfigError(f"inputs {', '.join(self.inputs)} name one twice; each is one sensor")
        if not 0.0 <= self.range_min_m < self.range_max_m < math.inf:
            raise ConfigError(
                f"window {self.range_min_m} to {self.range_max_m} m, expected 0 <= range_min_m < range_max_m"
            )
        if self.metres_per_volt == 0.0 or not math.isfinite(self.metres_per_volt):
            raise ConfigError(
                f"metres_per_volt is {self.metres_per_volt:g}; a distance must follow from a voltage"
            )
        if not math.isfinite(self.metres_at_zero):
            raise ConfigError(f"metres_at_zero = {self.metres_at_zero}, expected a number [m]")
        check_times(self.latency_s, self.silence_s)


class IioSource:
    """The device; see `polled.Source`."""

    def __init__(self, config: IioConfig) -> None:
        self.name = f"IIO device {config.device}"
        self.rejected = 0
        self._config, self._root = config, Path(config.root)
        self._folder: Path | None = None
        self._fd = -1
        self._rest = b""

    def open(self) -> None:
        """Enable the inputs and the timestamp, set the clock, start the buffer."""
        c = self._config
        folder = self._folder = find_device(self._root, c.device)
        self._write("buffer/enable", "0")
        with contextlib.suppress(OSError):  # kernels before 4.8 use the wall clock
            self._write("current_timestamp_clock", "monotonic")
        for path in sorted((folder / "scan_elements").glob("*_en")):
            name = path.name.removeprefix("in_").removesuffix("_en")
            path.write_text("1" if name in c.inputs or name == "timestamp" else "0")
        if c.trigger:
            self._write("trigger/current_trigger", c.trigger)
        self._layout, self._size = scan_layout(folder, c.inputs)
        self._write("buffer/length", str(c.buffer))
        with contextlib.suppress(OSError):
            self._write("buffer/watermark", "1")
        self._write("buffer/enable", "1")
        self._fd = os.open(self._root / "dev" / folder.name, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        self._rest = b""

    def _write(self, name: str, text: str) -> None:
        assert self._folder is not None
        (self._folder / name).write_text(text)

    def read(self, timeout_s: float) -> list[tuple[int, int]]:
        """Conversions, with timestamps of the device."""
        if not wait_readable(self._fd, timeout_s):
            return []
        try:
            data = os.read(self._fd, self._size * READ_SCANS)
        except BlockingIOError:
            return []
        if not data:
            raise DriverError("the device is gone")
        data, out = self._rest + data, []
        whole = len(data) // self._size * self._size
        self._rest = data[whole:]
        stamp, now_ns = self._layout["timestamp"], time.monotonic_ns()
        for at in range(0, whole, self._size):
            t_ns = stamp.value(data, at)
            # a device with another clock: the time of arrival
            if not 0 <= now_ns - t_ns <= 2_000_000_000:
                t_ns = now_ns
            for channel, name in enumerate(self._config.inputs):
                element = self._layout[name]
                raw = element.value(data, at) >> element.dropped
                out.append((t_ns, pack_counts(raw, channel)))
        return out

    def close(self) -> None:
        """Stop the buffer."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)
        if self._folder is not None:
            with contextlib.suppress(OSError):
                self._write("buffer/enable", "0")


def describe(config: IioConfig) -> DriverInfo:
    """The driver's description, from sysfs; the device must be there once, for its scale.

    Raises
    ------
    ConfigError
        it is not, or an input is missing
    """
    try:
        folder = find_device(Path(config.root), config.device)
        layout, _ = scan_layout(folder, config.inputs)
        calibrations = [calibration_of(folder, name) for name in config.inputs]
    except (OSError, DriverError) as error:
        raise ConfigError(f"driver 'iio': {error}") from error
    scale, zero = [], []
    for name, (volts, offset) in zip(config.inputs, calibrations, strict=True):
        if volts == 0.0 or not math.isfinite(volts) or not math.isfinite(offset):
            raise ConfigError(
                f"driver 'iio': {config.device} reports scale {1e3 * volts:g} and offset {offset:g} of "
                f"{name}, from which no distance follows; look at in_{name}_scale and in_{name}_offset "
                f"in {folder}"
            )
        scale.append(config.metres_per_volt * volts * (1 << layout[name].dropped))
        zero.append(config.metres_at_zero + config.metres_per_volt * volts * offset)
    return DriverInfo(
        name=f"IIO device {config.device}",
        n_channels=len(config.inputs),
        scale_m=eight_channels(scale),
        zero_m=eight_channels(zero),
        range_min_m=config.range_min_m,
        range_max_m=config.range_max_m,
        latency_ns=round(config.latency_s * 1e9),
        conversion_period_ns=0,
        mounts=mounts_of(list(config.mounts), len(config.inputs)),
    )


def make(settings: dict[str, Any], name: str) -> Driver:
    """Make an IIO driver from its settings."""
    config = convert_table(settings, IioConfig)
    return PolledDriver(describe(config), IioSource(config), config.silence_s)
