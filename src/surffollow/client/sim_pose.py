"""Publish where the tool of a simulation truly is, for the service's simulated sensor."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence

from surffollow.client.fence import fence
from surffollow.client.pose import checked_pose
from surffollow.errors import PoseError
from surffollow.shm import world_block as wb
from surffollow.shm.latch_shape import HEAD_BYTES, SLOTS, stride
from surffollow.shm.objects import unlink

_POSE = wb.WorldPose.struct_of("t_ns", "step")
_STRIDE = stride(wb.WorldPose.SIZE)
LOOK_EVERY_NS = 100_000_000
NO_VELOCITY = (0.0,) * 6
# a difference over a longer time says nothing about the velocity now
LONGEST_GAP_NS = 100_000_000


class SimulatedTool:
    """The one writer of a service's world block.

    Parameters
    ----------
    name : str   of the service

    Raises
    ------
    BusyError    a simulated robot or another client writes the block
    """

    def __init__(self, name: str) -> None:
        self._block = wb.object_name(name)
        self._claim()
        self._next_look_ns, self._step = 0, 0
        self._last: tuple[int, tuple[float, ...]] | None = None

    def _claim(self) -> None:
        self._object, self._lock = wb.claim_world(self._block)
        self._words, self._pid = memoryview(self._object.memory).cast("Q"), os.getpid()

    def publish(self, t_ns: int, pose: Sequence[float], velocity: Sequence[float] | None) -> None:
        """Store a pose; see `Client.sim_pose`.

        Raises
        ------
        PoseError         no pose, no velocity, or a time that is no whole number
        BusyError         the block was removed, and another process writes its successor
        """
        if t_ns.__class__ is not int:
            raise PoseError(f"t_ns must be a whole number of ns of CLOCK_MONOTONIC, not {t_ns!r}")
        seven = checked_pose(pose)
        six = self._velocity(t_ns, seven) if velocity is None else _checked_velocity(velocity)
        if self._pid != os.getpid():
            self._claim()  # fails while the parent writes
        if t_ns > self._next_look_ns:
            self._next_look_ns = t_ns + LOOK_EVERY_NS
            if not self._object.is_current():
                self._claim()
        self._step += 1
        words, index = self._words, wb.PAGE // 8
        g = words[index] + 1
        base = wb.PAGE + HEAD_BYTES + (g & (SLOTS - 1)) * _STRIDE
        fence()
        nan = math.nan
        _POSE.pack_into(self._object.memory, base, t_ns, *seven, *six, nan, nan, 0.0, 0, self._step)
        fence()
        words[index] = g
        self._last = (t_ns, seven)

    def _velocity(self, t_ns: int, pose: tuple[float, ...]) -> tuple[float, ...]:
        """From the pose before, linear and angular; zero when there is none or it is too old."""
        if self._last is None or not 0 < t_ns - self._last[0] <= LONGEST_GAP_NS:
            return NO_VELOCITY
        rate, old = 1e9 / (t_ns - self._last[0]), self._last[1]
        ax, ay, az, aw = pose[3:]
        bx, by, bz, bw = -old[3], -old[4], -old[5], old[6]
        # twice the vector part of (new attitude ∘ inverse of the old one): the angle, where it is small
        turn = 2.0 * rate if aw * bw - ax * bx - ay * by - az * bz >= 0.0 else -2.0 * rate
        return (
            *((pose[k] - old[k]) * rate for k in range(3)),
            turn * (aw * bx + ax * bw + ay * bz - az * by),
            turn * (aw * by - ax * bz + ay * bw + az * bx),
            turn * (aw * bz + ax * by - ay * bx + az * bw),
        )

    def close(self) -> None:
        """Remove the block: from now on the true pose of the tool is unknown."""
        if self._object.fd >= 0:
            # a forked child's copy is no writer: the block is its parent's
            if self._pid == os.getpid() and self._object.is_current():
                unlink(self._object.name)
            self._words.release()
            self._lock.release()
            self._object.close()


def _checked_velocity(velocity: Sequence[float]) -> tuple[float, ...]:
    values: tuple[float, ...]
    try:
        values = tuple(float(v) for v in velocity)
    except (TypeError, ValueError, OverflowError):
        values = ()
    if len(values) != 6 or not all(map(math.isfinite, values)):
        raise PoseError(f"a velocity is six finite numbers (m/s, rad/s, world axes), not {velocity!r}")
    return values
