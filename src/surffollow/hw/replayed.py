"""A driver that plays recorded conversions at their own pace, time shifted to now."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from surffollow.errors import RecordingError
from surffollow.hw.driver import ConversionQueue, DriverInfo, push_conversion
from surffollow.hw.driver_thread import PERIOD_NS, STOP, USER, DriverThread
from surffollow.shm import atomics as at
from surffollow.shm.clock import now_ns, wait_until_ns
from surffollow.shm.jit import jit

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
    def from_file(cls, path: str | Path) -> ReplayedDriver:
        """Read what `save_conversions` wrote.

        Raises
        ------
        RecordingError
            when the file cannot be read or is no such recording
        """
        try:
            with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
                if int(file["version"]) != _FILE_VERSION:
                    raise RecordingError(f"'{path}' has version {file['version']}, expected {_FILE_VERSION}")
                info = msgspec.json.decode(bytes(file["info"]), type=DriverInfo)
                t_ns, words = file["t_ns"], file["word"]
        except OSError as error:
            raise RecordingError(f"cannot read '{path}': {error.strerror or error}") from None
        except RecordingError:
            raise
        except Exception:  # messages of numpy, zip and JSON about foreign bytes do not help
            raise RecordingError(
                f"'{path}' is no recording of conversions, or is cut short; a replay driver's file is the "
                ".npz that hw.replayed.save_conversions writes (a recorder's .mcap plays with "
                f"`surffollow replay {path} --live`)"
            ) from None
        if t_ns.dtype.kind != "i" or words.dtype.kind != "i":
            raise RecordingError(
                f"'{path}' holds times as {t_ns.dtype} and words as {words.dtype}; expected int64"
            )
        return cls(t_ns, words, info)

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
