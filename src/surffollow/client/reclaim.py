"""Claim anew, in steps that never wait, what a restart of the service took: the pose, channels of ranges."""

from __future__ import annotations

import time
from collections.abc import Callable

from surffollow.client.refusal import FIRST_PAUSE_NS, REFUSED_NS, Refusal
from surffollow.client.requests import Ticket
from surffollow.client.slot_watch import SlotWatcher
from surffollow.errors import BusyError, NotRunningError, RefusedError
from surffollow.shm import layout_board as lb

CLAIM_RETRY_S, CLAIM_ANSWER_S = 0.3, 1.0
POSE = (lb.RQ_CLAIM_POSE, 0)
HELD = (lb.ERR_POSE_HELD, lb.ERR_RANGE_HELD)


class Reclaimer(SlotWatcher):
    """An attachment that may hold the pose and channels of pushed ranges.

    A claim is (request, channel). The slot carries one request at a time: the claim under way is collected
    before the next one is sent, whichever call comes first.
    """

    _claiming: tuple[tuple[int, int], Ticket] | None = None

    def _hold(self, claim: tuple[int, int]) -> None:
        code, channel = claim
        self._refusals.pop(claim, None)
        self._had.add(claim)
        if code == lb.RQ_CLAIM_POSE:
            self._pose_held, self._pose_held_ns = True, time.monotonic_ns()
        else:
            self._pushed[channel] = 0

    def _claim_waiting(self, claim: tuple[int, int], ask: Callable[[], None]) -> None:
        """Ask for a claim and wait; the service looks for dead holders at its own pace: it is given 0.3 s.

        Parameters
        ----------
        claim : (int, int)
        ask : callable      sends the request and waits for its answer

        Raises
        ------
        BusyError     another client holds it
        RefusedError  the service refused it otherwise
        """
        deadline, pause_ns = time.monotonic_ns() + round(1e9 * CLAIM_RETRY_S), FIRST_PAUSE_NS
        while True:
            try:
                ask()
                self._hold(claim)
                return
            except RefusedError as e:
                now = time.monotonic_ns()
                if e.code not in HELD:
                    raise
                if now >= deadline:
                    raise self._refused(claim, e, REFUSED_NS) from None
                time.sleep(1e-9 * min(pause_ns, deadline - now))
                pause_ns *= 2

    def _refused(self, claim: tuple[int, int], refused: RefusedError, pause_ns: int) -> BusyError:
        way = "release_pose()" if claim == POSE else "release_range()"
        text = f"{refused}; end that client or let it call {way}"
        self._refusals[claim] = Refusal(text, pause_ns, time.monotonic_ns() + pause_ns)
        return BusyError(text)

    def _claim_in_loop(self, claim: tuple[int, int], wait: Callable[[], None]) -> None:
        """Claim in a control loop: the first claim waits, no later one does.

        While another client holds it the service is asked once in 1 s, and the calls between are refused.

        Parameters
        ----------
        claim : (int, int)
        wait : callable     claims and waits

        Raises
        ------
        BusyError        another client holds it
        NotRunningError  not there yet
        RefusedError     the service refused it otherwise
        """
        refusal = self._refusals.get(claim)
        if refusal is not None and time.monotonic_ns() < refusal.until_ns:
            raise BusyError(refusal.text)
        if refusal is None and claim not in self._had:
            wait()
            return
        try:
            self._reclaim(claim)
        except RefusedError as e:
            if e.code not in HELD:
                raise
            pause_ns = FIRST_PAUSE_NS if refusal is None else min(2 * refusal.pause_ns, REFUSED_NS)
            raise self._refused(claim, e, pause_ns) from None
        except NotRunningError:
            if refusal is None or self._claiming is None:
                raise
            raise BusyError(refusal.text) from None  # the service is there and has not answered yet

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
