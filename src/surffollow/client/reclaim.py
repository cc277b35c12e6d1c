"""Claim anew, in steps that never wait, what a restart of the service took: the pose, channels of ranges."""

from __future__ import annotations

import time

from surffollow.client.requests import Ticket
from surffollow.client.slot_watch import SlotWatcher
from surffollow.errors import BusyError, NotRunningError, RefusedError
from surffollow.shm import layout_board as lb

CLAIM_RETRY_S, CLAIM_ANSWER_S = 0.3, 1.0
POSE = (lb.RQ_CLAIM_POSE, 0)


class Reclaimer(SlotWatcher):
    """An attachment that may hold the pose and channels of pushed ranges.

    A claim is (request, channel). The slot carries one request at a time: the claim under way is collected
    before the next one is sent, whichever call comes first.
    """

    _claiming: tuple[tuple[int, int], Ticket] | None = None

    def _hold(self, claim: tuple[int, int]) -> None:
        code, channel = claim
        self._had.add(claim)
        if code == lb.RQ_CLAIM_POSE:
            self._pose_held, self._pose_held_ns = True, time.monotonic_ns()
        else:
            self._pushed[channel] = 0

    def _reclaim(self, claim: tuple[int, int]) -> None:
        """One step towards a claim in a control loop; returns when it is held.

        Raises
        ------
        NotRunningError
            not there yet
        RefusedError
            the service refused it
        """
        # another thread that steps does so for both
        if self._lock.acquire(blocking=False):
            try:
                if self._collect(claim) or (self._send(claim) and self._collect(claim)):
                    return
            finally:
                self._lock.release()
        raise NotRunningError(
            f"service {self.name!r} has not answered the new claim of "
            f"{'the pose' if claim == POSE else f'channel {claim[1]}'} yet; call again"
        )

    def _send(self, claim: tuple[int, int]) -> bool:
        if self._claiming is None:
            code, channel = claim
            numbers = () if claim == POSE else (channel,)
            try:
                self._claiming = claim, self._request(code, numbers, n=len(numbers))
            except BusyError:  # a request of the user's is under way
                return False
        return True

    def _collect(self, expected: tuple[int, int]) -> bool:
        """Take the answer to the claim under way, if it is there; whether `expected` is held now."""
        if self._claiming is None:
            return False
        claim, ticket = self._claiming
        if self._grant is None or ticket._claim != self._claim:
            self._claiming = None  # of a slot that is gone
            return False
        if not ticket._answered():
            if time.monotonic() > ticket._sent_s + CLAIM_ANSWER_S:
                ticket._given_up, self._claiming = True, None
            return False
        self._claiming = None
        try:
            ticket.result(0.0)
        except RefusedError:
            if claim == expected:
                raise
            return False  # the caller asks again for that one
        self._hold(claim)
        return claim == expected
