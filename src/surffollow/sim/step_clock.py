"""Steps of 1 ms of a simulated robot in real time: wait for each, publish where it led."""

from __future__ import annotations

from typing import Any

from surffollow.shm.clock import now_ns, wait_until_ns
from surffollow.shm.jit import jit_inlined
from surffollow.shm.latch import latch_write
from surffollow.sim.world import WorldPose

STEP_NS = 1_000_000
FROZEN_NS = 100_000_000  # a process that was stopped longer takes its world's time with it
_WORLD_BYTES = WorldPose.SIZE


@jit_inlined
def await_step(state: Any) -> Any:
    """Wait for the time of the next step; False: the process was stopped, and the time meanwhile is left out.

    Parameters
    ----------
    state : (1,) structured with `t_ns` and `frozen_ns` [ns]
        updated in place where the process was stopped

    Returns
    -------
    bool
    """
    behind = now_ns() - state[0].t_ns
    if behind > FROZEN_NS:
        state[0].t_ns += behind
        state[0].frozen_ns += behind
        return False
    wait_until_ns(state[0].t_ns + STEP_NS, 0)
    return True


@jit_inlined
def publish_step(latch: Any, world: Any) -> None:
    """Write the (1,) `WorldPose` through the latch at an address."""
    latch_write(latch, world.ctypes.data, _WORLD_BYTES)
