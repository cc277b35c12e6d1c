"""At a cold start, compile the kernels of the map thread and of simulated sensors in a second process.

They take about as long as the cycle's, and all end up in the kernel cache: the service then loads
what the other process compiled. A service whose helper dies, or that cannot start one, compiles
everything by itself. The helper dies with the service.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import hashlib
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
from llvmlite import binding as llvm

from surffollow.hw.simulation import simulated
from surffollow.service.mapper import run_map
from surffollow.service.mapper_memory import make_map_memory
from surffollow.service.memory import make_cycle_memory
from surffollow.shm import map_layout as ml
from surffollow.shm.cache_directory import cache_directory
from surffollow.shm.dtypes import zeros
from surffollow.shm.python_child import module_command
from surffollow.shm.readable import wait_readable
from surffollow.shm.source_stamp import source_stamp

PATIENCE_S = 120.0  # after the service's own part: a helper that takes longer is stopped or stuck
LOOK_S = 0.1
_PR_SET_PDEATHSIG = 1


def _marker() -> Path:
    return Path(cache_directory(), "complete")


def _stamp() -> str:
    """Changes with the source of the service and with what compiles it."""
    source = source_stamp(Path(__file__).with_name("daemon.py"))
    parts = (source, numba.__version__, platform.python_version(), llvm.get_host_cpu_name())
    return hashlib.blake2b(" ".join(parts).encode(), digest_size=16).hexdigest()


def is_cold() -> bool:
    """Whether no service of this source has filled the kernel cache yet (an estimate)."""
    try:
        return _marker().read_text() != _stamp()
    except OSError:
        return True


def note_complete() -> None:
    """Remember that every kernel of a service was compiled."""
    with contextlib.suppress(OSError):
        if is_cold():
            _marker().write_text(_stamp())


class SideCompile:
    """The helper process of one start; none when the cache is warm or there is one processor only.

    Parameters
    ----------
    with_sensors : whether simulated sensors will be needed
    """

    def __init__(self, with_sensors: bool = False) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        if not is_cold() or len(os.sched_getaffinity(0)) < 2:
            return
        command = module_command("surffollow.service.compile_helper", str(os.getpid()))
        if with_sensors:
            command.append("sensors")
        with contextlib.suppress(OSError, ValueError):
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=os.environ | {"SURFFOLLOW_CACHE_DIR": str(Path(cache_directory()).parent)},
                start_new_session=True,  # a Ctrl-C is the service's to answer
            )

    def wait(self, report: Callable[[], None], stop_fd: int) -> bool:
        """Until the helper has ended, calling `report` now and then; False when `stop_fd` became readable."""
        deadline = time.monotonic() + PATIENCE_S
        while self._process is not None and self._process.poll() is None:
            if wait_readable(stop_fd, LOOK_S):
                return False
            if time.monotonic() > deadline:
                self.end()
            report()
        return True

    def end(self) -> None:
        """Kill the helper if it still runs."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


def compile_map() -> None:
    """Compile the map thread into the cache, or find it there."""
    ctx = make_cycle_memory().ctx
    mem = make_map_memory(ctx, zeros(ml.MapHeader), zeros(ml.GridPair), np.zeros(1), ml.DEFAULT_QUANTUM_M)
    run_map.compile((numba.typeof(mem),))  # type: ignore[no-untyped-call]


def main(parent: int, with_sensors: bool = False) -> None:
    """The helper: ends with its parent, for any cause. One compiles at a time, the others load."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before the line above
        return
    with open(Path(cache_directory(), ".compile_helper"), "a") as lock_file:
        with contextlib.suppress(OSError):
            fcntl.flock(lock_file, fcntl.LOCK_EX)
        compile_map()
        if with_sensors:
            simulated.warm_up()


if __name__ == "__main__":
    main(int(sys.argv[1]), "sensors" in sys.argv[2:])
