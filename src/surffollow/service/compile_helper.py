"""At a cold start, compile half of the kernels in a second process.

The service compiles the default follower and the cycle's machine code. The helper compiles what the follower
does with several sensors and with known ground, the rest of the step and of the cycle, the map thread and
simulated sensors. All end up in the kernel cache, where the other process finds them.
A service whose helper dies, or that cannot start one, compiles everything by itself. The helper dies with
the service.
"""

from __future__ import annotations

import contextlib
import fcntl
import gc
import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from surffollow.forecast.adaptive_step import plan_period
from surffollow.forecast.attitude import attitude
from surffollow.forecast.step import adaptive_cycle, demand_z, find_targets, follow_step
from surffollow.forecast.terrain import lookahead_sensor
from surffollow.hw.simulation import simulated
from surffollow.service.cycle import give_outputs, take_inputs
from surffollow.service.mapper import run_map
from surffollow.service.mapper_memory import make_map_memory
from surffollow.service.memory import CycleMemory, make_cycle_memory
from surffollow.shm import map_layout as ml
from surffollow.shm.cache_directory import cache_directory
from surffollow.shm.dtypes import zeros
from surffollow.shm.kernel import types_of
from surffollow.shm.kernel_cache import compiled_for
from surffollow.shm.python_child import end_with_parent, module_command
from surffollow.shm.readable import wait_readable
from surffollow.shm.source_stamp import source_stamp

PATIENCE_S = 120.0  # after the service's own part: a helper that takes longer is stopped or stuck
LOOK_S = 0.1


def _marker() -> Path:
    return Path(cache_directory(), "complete")


def _stamp() -> str:
    """Changes with the source of the service and with what compiles it."""
    source = source_stamp(Path(__file__).with_name("daemon.py"))
    return hashlib.blake2b(" ".join((source, *compiled_for())).encode(), digest_size=16).hexdigest()


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

    def compile_step(self, mem: CycleMemory) -> None:
        """Compile the follower's step before the rest of the cycle, which the helper compiles meanwhile.

        The default follower comes first, because the helper begins with the rest of the step.
        """
        if self._process is not None:
            p, s, i, o = mem.params[0], mem.state[0], mem.inputs[0], mem.output[0]
            adaptive_cycle.part(types_of(p, mem.state, s["sense"], s["fold"], i, o, mem.pose, True))
            follow_step.part(types_of(mem.params, mem.state, mem.inputs, mem.output, mem.pose))

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


def compile_share() -> None:
    """Compile the cycle without most of the default follower, then the map thread, or find them kept.

    First what the service needs first: stages that the default follower calls last, the rest of the step, and
    the two halves of a cycle around the step.
    """
    cycle = make_cycle_memory()
    p, s, i, o = cycle.params[0], cycle.state[0], cycle.inputs[0], cycle.output[0]
    attitude.demand_rotation.part(types_of(p, s["adaptive"], s["sense"], o))
    lookahead_sensor.observe_lookahead.part(types_of(p, s["adaptive"], s["sense"], cycle.pose))
    plan_period.part(types_of(p, s["adaptive"], i, 0, 0.0, 0.0))
    demand_z.part(types_of(p, s, i, o, 0.0, cycle.pose))
    find_targets.part(types_of(p, s, o, cycle.pose))
    take_inputs.part(types_of(cycle, 0))
    give_outputs.part(types_of(cycle, 0, 0))
    nothing = zeros(ml.MapHeader), zeros(ml.GridPair), np.zeros(1)
    run_map.compile(types_of(make_map_memory(cycle.ctx, *nothing)))


def main(parent: int, with_sensors: bool = False) -> None:
    """The helper: ends with its parent, for any cause. One compiles at a time, the others load."""
    end_with_parent(parent)
    gc.disable()  # a process that ends in 15 s: a tenth less time, and memory that it gives back at its end
    with open(Path(cache_directory(), ".compile_helper"), "a") as lock_file:
        with contextlib.suppress(OSError):
            fcntl.flock(lock_file, fcntl.LOCK_EX)
        compile_share()
        if with_sensors:
            simulated.warm_up()
    os._exit(0)  # Python would free each of its millions of objects


if __name__ == "__main__":
    main(int(sys.argv[1]), "sensors" in sys.argv[2:])
