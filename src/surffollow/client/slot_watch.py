"""Look, as often as a service falls silent, whether it is there and the slot is still ours."""

from __future__ import annotations

from surffollow.client.request_sender import RequestSender
from surffollow.shm import layout_board as lb
from surffollow.shm.layout_follow import Params

_POSE_ROLE = lb.MainThreadState.struct_of("t_ns", "pose_slot")
_POSE_TIMEOUT = Params.struct_of("pose_timeout_ns", "pose_timeout_ns")
LOOK_EVERY_NS = 100_000_000


class SlotWatcher(RequestSender):
    """An attachment that notices when its service or its slot has gone."""

    def _check_service(self, now_ns: int) -> None:
        """As often as a service falls silent: whether it is there. Ten times a second: our slot."""
        self._next_look_ns = 0
        self._require_service()
        self._next_look_ns = now_ns + min(self._stale_ns, LOOK_EVERY_NS)
        if now_ns < self._next_life_ns:
            return
        self._next_life_ns = now_ns + LOOK_EVERY_NS
        timeout = self.board.latch("params", Params).copy()
        if timeout is not None:
            (self._pose_timeout_ns,) = _POSE_TIMEOUT.unpack_from(timeout, Params.offset("pose_timeout_ns"))
        # a thread that re-attaches looks after everything itself
        if self._lock.acquire(blocking=False):
            try:
                self._check_slot()
            finally:
                self._lock.release()

    def _check_slot(self) -> None:
        if self._grant is None:
            return
        if not self._grant.is_open():
            self._release_slot()  # the service took it back: the next pose or request asks for another
            return
        main_thread = self.board.latch("ticker", lb.MainThreadState).copy()
        if main_thread is not None and self._pose_held:
            reported_ns, slot = _POSE_ROLE.unpack_from(main_thread)
            if slot != self.slot and reported_ns > self._pose_held_ns + LOOK_EVERY_NS:
                self._pose_held = False  # it is not ours any more: ask for it again
