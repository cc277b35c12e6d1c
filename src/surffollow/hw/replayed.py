"""A driver that plays recorded ranges or conversions at their own pace, time shifted to now."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from surffollow.errors import ConfigError, RecordingError
from surffollow.hw.driver import ConversionQueue, DriverInfo, Mount, mounts_of, push_conversion
from surffollow.hw.driver_thread import PERIOD_NS, STOP, USER, DriverThread
from surffollow.hw.ranges import metre_info, pack_range
from surffollow.shm import atomics as at
from surffollow.shm.clock import now_ns, wait_until_ns
from surffollow.shm.jit import jit
from surffollow.shm.layout_follow import CHANNELS

PLAYED = USER  # control word: conversions played
_FILE_VERSION = 1


@jit
def run_replay(control: Any, t_ns: Any, words: Any, start_ns: Any, queue: Any) -> None:
    """Push each conversion when its time has come, until `STOP`.

    Parameters
    ----------
    control : int64, address of the thread's control words
    t_ns, words : (n,) int64, ascending times [ns] and packed conversions
    start_ns : int64, when the first is due [ns]
    queue : (6,) int64, address, capacity, address of the lost count, address of the scratch, 2 words scratch
    """
    n = 0
    while at.load_acquire_i64(control + 8 * STOP) == 0:
        now = now_ns()
        while n < len(t_ns) and t_ns[n] - t_ns[0] + start_ns <= now:
            push_conversion(queue[0], queue[1], queue[2], queue[3], t_ns[n] - t_ns[0] + start_ns, words[n])
            n += 1
        at.store_relaxed_i64(control + 8 * PLAYED, n)
        wait_until_ns(now + PERIOD_NS, 0)


class ReplayConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of a replay; those of conversions are in the file, and are replaced by these.

    Attributes
    ----------
    file : NPZ of ranges, or of conversions (`save_conversions`)
    range_min_m, range_max_m : the sensors' window [m]; a file of ranges needs both
    latency_s : age of a distance at its timestamp [s]
    mounts : tool from sensor, one per channel
    """

    file: str
    range_min_m: float | None = None
    range_max_m: float | None = None
    latency_s: float | None = None
    mounts: tuple[Mount, ...] | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= (self.latency_s or 0.0) <= 1.0:
            raise ConfigError(f"latency_s = {self.latency_s}, expected 0 to 1 s")

    def adapt(self, info: DriverInfo) -> DriverInfo:
        """The description in a file with what is set here."""
        low_m = info.range_min_m if self.range_min_m is None else self.range_min_m
        high_m = info.range_max_m if self.range_max_m is None else self.range_max_m
        if not 0.0 <= low_m < high_m:
            raise ConfigError(f"driver window {low_m} to {high_m} m, expected 0 <= range_min_m < range_max_m")
        changed: dict[str, Any] = {"range_min_m": low_m, "range_max_m": high_m}
        if self.latency_s is not None:
            changed["latency_ns"] = round(self.latency_s * 1e9)
        if self.mounts is not None:
            changed["mounts"] = mounts_of(self.mounts, info.n_channels)
        return msgspec.structs.replace(info, **changed)


class ReplayedDriver:
    """Recorded conversions in place of sensors.

    Parameters
    ----------
    t_ns : (n,) int64, when each conversion ended [ns], ascending
    words : (n,) int64, packed conversions; their dt is dropped
    info : of the driver that was recorded

    Raises
    ------
    RecordingError
        no conversions, unequal lengths, or times that go back
    """

    def __init__(self, t_ns: NDArray[np.int64], words: NDArray[np.int64], info: DriverInfo) -> None:
        if t_ns.ndim != 1 or t_ns.shape != words.shape or len(t_ns) == 0:
            raise RecordingError(
                f"a replay needs times and words in equal rows, got {t_ns.shape}, {words.shape}"
            )
        if (np.diff(t_ns) < 0).any():
            raise RecordingError(f"times go back at conversion {int(np.argmax(np.diff(t_ns) < 0)) + 1}")
        self._t_ns = np.ascontiguousarray(t_ns, np.int64)
        self._words = np.ascontiguousarray(words, np.int64) & np.int64(0xFFFFFFFF)
        self._info = msgspec.structs.replace(info, name=f"replay of {info.name}")
        self._thread = DriverThread("replay")

    @classmethod
    def from_file(cls, path: str | Path, config: ReplayConfig | None = None) -> ReplayedDriver:
        """Read a file of ranges, or what `save_conversions` wrote.

        Raises
        ------
        RecordingError
            when the file cannot be read or is no such recording
        ConfigError
            a file of ranges without a window, or settings that contradict each other
        """
        config = config or ReplayConfig(file=str(path))
        try:
            with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
                if "range_m" in file:
                    given = {n: file[n] for n in ("t_ns", "range_m", "channel") if n in file}
                    info = None
                else:
                    if int(file["version"]) != _FILE_VERSION:
                        raise RecordingError(
                            f"'{path}' has version {file['version']}, expected {_FILE_VERSION}"
                        )
                    info = msgspec.json.decode(bytes(file["info"]), type=DriverInfo)
                    given = {"t_ns": file["t_ns"], "word": file["word"]}
        except OSError as error:
            raise RecordingError(f"cannot read '{path}': {error.strerror or error}") from None
        except RecordingError:
            raise
        except Exception:  # messages of numpy, zip and JSON about foreign bytes do not help
            raise RecordingError(
                f"'{path}' is no recording of conversions, or is cut short; a replay driver's file is an "
                ".npz with t_ns and range_m, or the one that hw.replayed.save_conversions writes "
                f"(drivers.md, Replay; a recorder's .mcap plays with `surffollow replay {path} --live`)"
            ) from None
        if info is None:
            return _of_ranges(path, given, config)
        t_ns, words = given["t_ns"], given["word"]
        if t_ns.dtype.kind != "i" or words.dtype.kind != "i":
            raise RecordingError(
                f"'{path}' holds times as {t_ns.dtype} and words as {words.dtype}; expected int64"
            )
        return cls(t_ns, words, config.adapt(info))

    @property
    def info(self) -> DriverInfo:
        """Of the driver that was recorded."""
        return self._info

    @property
    def finished(self) -> bool:
        """True when all has been played."""
        return int(self._thread.control[PLAYED]) == len(self._t_ns)

    def start(self, queue: ConversionQueue) -> None:
        """Begin to fill the queue; see `Driver`."""
        plumbing = np.array([queue.address, queue.capacity, queue.lost_address, 0, 0, 0], np.int64)
        plumbing[3] = plumbing.ctypes.data + 32

        def kernel(control: int) -> None:
            run_replay(control, self._t_ns, self._words, time.monotonic_ns(), plumbing)

        self._thread.start(kernel, keep=queue)

    def stop(self) -> None:
        """End the thread; see `Driver`."""
        self._thread.stop()

    def faults(self) -> list[str]:
        """Say when the recording is over."""
        if self._thread.running and self.finished:
            return [f"the recording of {len(self._t_ns)} conversions is over"]
        return []


def _of_ranges(path: str | Path, given: dict[str, NDArray[Any]], config: ReplayConfig) -> ReplayedDriver:
    """A replay of distances in metres."""
    if config.range_min_m is None or config.range_max_m is None:
        raise ConfigError(f"'{path}' holds distances: set range_min_m and range_max_m, the sensor's window")
    range_m = given["range_m"]
    t_ns, channel = (given.get(n, np.zeros(range_m.shape, np.int64)) for n in ("t_ns", "channel"))
    shapes = {n: a.shape for n, a in given.items()}
    if "t_ns" not in given or range_m.ndim != 1 or len(set(shapes.values())) != 1:
        raise RecordingError(f"'{path}' holds arrays of the shapes {shapes}; expected t_ns, range_m (n,)")
    if t_ns.dtype.kind != "i" or channel.dtype.kind not in "iu" or range_m.dtype.kind not in "iuf":
        kinds = ", ".join(f"{n} as {a.dtype}" for n, a in given.items())
        raise RecordingError(
            f"'{path}' holds {kinds}; expected t_ns and channel as int64 [ns], range_m as float64"
        )
    n_channels = int(channel.max(initial=0)) + 1
    if not 1 <= n_channels <= CHANNELS or channel.min(initial=0) < 0:
        raise RecordingError(f"'{path}' has a channel outside 0 to {CHANNELS - 1}")
    info = config.adapt(
        metre_info(Path(path).name, config.range_min_m, config.range_max_m, n_channels=n_channels)
    )
    words = [pack_range(info, c, r) for c, r in zip(channel.tolist(), range_m.tolist())]
    return ReplayedDriver(t_ns, np.array(words, np.int64), info)


def save_conversions(
    path: str | Path, t_ns: NDArray[np.int64], words: NDArray[np.int64], info: DriverInfo
) -> None:
    """Write conversions and the calibration that goes with them, for `ReplayedDriver.from_file` (NPZ).

    Parameters
    ----------
    path : path             replaced when it exists
    t_ns : (n,) int64 [ns]  times of the conversions
    words : (n,) int64      packed conversions
    info : DriverInfo       calibration
    """
    text = np.frombuffer(msgspec.json.encode(info), np.uint8)
    np.savez_compressed(path, version=_FILE_VERSION, t_ns=t_ns, word=words, info=text)
