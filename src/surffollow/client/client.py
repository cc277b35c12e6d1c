"""A robot controller's attachment: poses in, demands out, requests (`service_requests`, `map_requests`)."""

from __future__ import annotations

import contextlib
import struct
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from surffollow.client.fence import FENCED, fence
from surffollow.client.map_requests import MapRequests
from surffollow.client.observer import Observer
from surffollow.client.pose import FUTURE_NS, checked_pose, checked_stamp
from surffollow.client.reclaim import CLAIM_ANSWER_S, POSE
from surffollow.client.slot import GENERATION
from surffollow.config.pose_limits import MAX_POSITION_M
from surffollow.errors import BusyError, PoseError, SurffollowError
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_slot as ls
from surffollow.shm.latch_shape import SLOTS, stride

if TYPE_CHECKING:
    from surffollow.client.sim_pose import SimulatedTool

_POST = ls.PosePost.struct_of("t_ns", "pose")
_POSE_STRIDE = stride(ls.PosePost.SIZE)
_MAX_SIZE2 = MAX_POSITION_M**2


class Client(MapRequests):
    """An attachment that may send poses and requests; see `attach`.

    Examples
    --------
    >>> from surffollow.client import attach
    >>> with attach("surf") as robot:
    ...     ticket = robot.sf_reset(0.1)                            # stand-off [m]
    ...     robot.ee_pos((0.05, 0.05, 0.1, 0.0, 0.0, 0.0, 1.0))     # x y z [m], qx qy qz qw
    ...     demand = robot.dev_vector()                             # add it to that pose while it is valid
    >>> ticket.done(), len(demand)
    (True, 6)
    """

    _tool: SimulatedTool | None = None

    # -- poses ------------------------------------------------------------------------------------

    def ee_pos(self, pose: Sequence[float], t_ns: int | None = None) -> None:
        """Report the pose of the tool, now or at a past time.

        Parameters
        ----------
        pose : seven floats
            measured, not commanded (docs/explanation/frames.md#measured-not-commanded): x y z [m],
            qx qy qz qw (unit), world from tool; z of the world is up, a beam leaves along -z of its sensor
        t_ns : int, optional
            when that was true, the time of its measurement, CLOCK_MONOTONIC [ns]; now when absent

        Raises
        ------
        PoseError
            (a ValueError) not seven finite numbers, quaternion norm off by more than 1e-3,
            with a timestamp more than 1 ms ahead or older than `pose_timeout_ns`
        BusyError
            another live client sends the pose; its process is named. The service is then asked once in 1 s,
            without waiting, and the calls between are refused at once; `claim_pose` asks it and waits
        NotRunningError
            the service ended, or the pose is being claimed anew of one that was started again:
            call again, poses go on a few calls later

        Notes
        -----
        The first call of an attachment waits for the pose (`claim_pose` does that beforehand), 0.3 s where
        another client has it. No call waits that follows one which had the pose, in any state of the service
        or its socket.

        Examples
        --------
        >>> import time
        >>> from surffollow.client import attach
        >>> from surffollow.errors import PoseError
        >>> with attach("surf") as robot:
        ...     robot.ee_pos((0.05, 0.05, 0.1, 0.0, 0.0, 0.0, 1.0), time.monotonic_ns())
        ...     try:
        ...         robot.ee_pos((0.05, 0.05, 0.1, 0.0, 0.0, 0.0, 0.9))
        ...     except PoseError:
        ...         print("no unit quaternion")
        no unit quaternion
        """
        try:
            x, y, z, qx, qy, qz, qw = pose
            norm2 = qx * qx + qy * qy + qz * qz + qw * qw
            size2 = x * x + y * y + z * z + norm2
            sane = size2 < _MAX_SIZE2 and -2e-15 < norm2 - 1.0 < 2e-15
        except (TypeError, ValueError, OverflowError):
            raise PoseError(f"a pose is seven numbers (x y z qx qy qz qw), not {pose!r}") from None
        # NaN compares false; the slow check says what is wrong, if anything
        if not sane:
            x, y, z, qx, qy, qz, qw = checked_pose(pose)
        now = time.monotonic_ns()
        if now > self._next_look_ns:
            self._check_service(now)
        if t_ns is None:
            t_ns = now
        elif t_ns.__class__ is not int or not -FUTURE_NS <= now - t_ns <= self._pose_timeout_ns:
            t_ns = checked_stamp(t_ns, now, self._pose_timeout_ns)
        if not self._pose_held:
            self._claim_in_loop(POSE, self._claim_pose)
        words, memory, index, base = self._pose_view
        g = (words[index] + 1) & GENERATION or 1  # the bytes there are untrusted
        if FENCED:
            fence()
        try:
            _POST.pack_into(memory, base + (g & (SLOTS - 1)) * _POSE_STRIDE, t_ns, x, y, z, qx, qy, qz, qw)
        except struct.error:  # an array of one number compares like a number; nothing is posted yet
            raise PoseError(f"a pose is seven numbers (x y z qx qy qz qw), not {pose!r}") from None
        if FENCED:
            fence()
        words[index] = g

    def _claim_pose(self) -> None:
        self._claim_waiting(POSE, self._ask_for_pose)

    def _ask_for_pose(self) -> None:
        stall_s = self._slot_stall_s()
        self._request(lb.RQ_CLAIM_POSE, patience_s=CLAIM_ANSWER_S, stall_s=stall_s).result(CLAIM_ANSWER_S)

    def _slot_stall_s(self) -> float:
        """How long a claim that may wait waits for a slot; a service that stands still is not waited for."""
        return CLAIM_ANSWER_S if self._grant is None and self.alive() else 0.0

    def claim_pose(self) -> None:
        """Become the one who sends the pose, and may so set parameters; `ee_pos` does it when needed.

        Raises
        ------
        BusyError
            another live client sends the pose; its process is named
        """
        self._require_service()
        if not self._pose_held:
            self._claim_pose()

    def _before_asking(self, code: int, wait: bool) -> None:
        """Claim the pose anew that a restart took, where the request may wait and is no stop."""
        if wait and code != lb.RQ_STOP and not self._pose_held and POSE in self._had:
            with contextlib.suppress(BusyError):  # another one has it: the service says what that means
                self._claim_pose()

    def release_pose(self) -> None:
        """Let another client send the pose."""
        self._follow()  # of a service that was started anew this client holds nothing
        if self._pose_held:
            self._request(lb.RQ_RELEASE_POSE, patience_s=1.0).result(1.0)
            self._pose_held = False
        self._had.discard(POSE)

    def sim_pose(self, t_ns: int, pose: Sequence[float], velocity: Sequence[float] | None = None) -> None:
        """Give the simulated sensor the true pose of the tool, where reports are noisy or late.

        The service itself never reads it. Without it the simulated sensor takes its pose from the
        reports, whose errors then cancel. The first call makes the block NAME.world, `close` removes it.

        Parameters
        ----------
        t_ns : int
            when that is true, CLOCK_MONOTONIC [ns]
        pose : seven floats
            x y z [m], qx qy qz qw (unit), world from tool
        velocity : six floats
            linear [m/s] and angular [rad/s], world axes; by default the difference to
            the pose before

        Raises
        ------
        PoseError
            (a ValueError) no pose, no velocity, or no time
        BusyError
            a simulated robot or another client publishes it
        """
        if self._tool is None:
            from surffollow.client.sim_pose import SimulatedTool

            self._tool = SimulatedTool(self.name)
        self._tool.publish(t_ns, pose, velocity)

    def close(self) -> None:
        """Release the pose, give back the slot, remove the world block, unmap everything.

        Notes
        -----
        The pose is not lost: the cause `pose_lost` latches no stop. It waits for the service's answer to the
        release, 1 s at most, and not for a service that is silent. A `with` block that an exception leaves,
        Ctrl-C too, does not release: the service counts the pose as lost, as of a process that died.
        """
        with self._lock:  # a thread that sends poses claims no pose in between
            try:
                self._give_pose_back()
            finally:
                self._let_go()

    def _give_pose_back(self) -> None:
        """Release what this client holds or is claiming; a service that is silent is not waited for."""
        grant = self._grant
        if grant is None or POSE not in self._had or not grant.is_open():
            return
        with contextlib.suppress(SurffollowError):
            self._request(lb.RQ_RELEASE_POSE, patience_s=CLAIM_ANSWER_S).result(CLAIM_ANSWER_S)
        self._had.discard(POSE)

    def _let_go(self) -> None:
        if self._tool is not None:
            tool, self._tool = self._tool, None
            tool.close()
        super().close()

    def __exit__(self, *exc: object) -> None:
        if any(exc):
            self._let_go()
        else:
            self.close()

    EEPos = ee_pos
    DevVector = Observer.dev_vector
    RawDistance = Observer.raw_distance
    SFReset = MapRequests.sf_reset
    MapReset = MapRequests.map_reset
    MapRefocus = MapRequests.map_refocus
    UpLoadMap = MapRequests.upload_map
