"""Requests and their answers: counters out, acknowledgements back."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from surffollow.errors import NotRunningError, RefusedError, RequestTimeoutError
from surffollow.shm.layout_board import (
    ACCEPTED,
    ERR_BAD_VALUE,
    ERR_BEYOND_LIMITS,
    ERR_NO_CHANNEL,
    ERR_NOT_POSE_HOLDER,
    ERR_POSE_HELD,
    ERR_RANGE_HELD,
    ERR_STOP_REMAINS,
    OK,
    RESULT_TEXT,
    RQ_STOP,
    Ack,
)
from surffollow.shm.layout_follow import STOPPED, Params

if TYPE_CHECKING:
    from surffollow.client.request_sender import RequestSender

LOST_S = 5.0
_POLL_S = (0.0, 0.0002, 0.0005, 0.001, 0.002)


class Ticket:
    """A request on its way; `result` waits for the answer.

    Attributes
    ----------
    code : int
        kind of the request (`layout_board.RQ_…`)
    counter : int
        number of the request in the client's slot

    Examples
    --------
    A control loop that must not wait sends the request, and looks later whether it is done:

    >>> import time
    >>> from surffollow.client import attach
    >>> with attach("surf") as robot:
    ...     ticket = robot.sf_reset(0.12, wait=False)
    ...     while not ticket.done():
    ...         time.sleep(0.001)     # the rest of the loop's period
    ...     _ = ticket.result()       # raises when the service refused
    >>> ticket.done()
    True
    """

    def __init__(self, client: RequestSender, code: int, counter: int) -> None:
        self._client, self.code, self.counter = client, code, counter
        self._board = client.board
        self._acks = client.board.latch("acks", Ack, client.slot)
        self._map_acks = client.board.latch("map_acks", Ack, client.slot)
        self._claim = client._claim
        self._answer: dict[str, Any] | None = None
        self._sent_s, self._given_up = time.monotonic(), False

    def _look(self) -> dict[str, Any] | None:
        for acks in (self._acks, self._map_acks):
            ack = acks.read()
            mine = ack is not None and ack["counter"] == self.counter and ack["claim"] == self._claim
            if mine and ack is not None and ack["result"] != ACCEPTED:
                return ack
        return None

    def done(self) -> bool:
        """Whether nothing is left to wait for: answered, or the service ended or was restarted.

        Returns
        -------
        bool
            True: `result` returns or raises at once
        """
        return self._answered() or not self._client._follow() or self._client.board is not self._board

    def _answered(self) -> bool:
        if self._answer is None:
            self._answer = self._look()
        return self._answer is not None

    def taken(self) -> bool:
        """Whether the service has seen the request; its answer may be to come (the map's).

        Returns
        -------
        bool
            True: the service has read the request
        """
        ack = self._acks.read()
        mine = ack is not None and ack["counter"] == self.counter and ack["claim"] == self._claim
        return mine or self._answered()

    def under_way(self) -> bool:
        """Whether an answer is still to be expected, and to be waited for before the next request.

        Returns
        -------
        bool
            False: answered, given up, lost for 5 s, or sent to a service that ended
        """
        if self._given_up or self._claim != self._client._claim or self.done():
            return False
        # one that was lost must not block all later ones
        return self.taken() or time.monotonic() < self._sent_s + LOST_S

    def result(self, timeout_s: float = 5.0) -> int:
        """Wait for the answer; its detail number.

        Parameters
        ----------
        timeout_s : float
            longest wait for the answer [s]

        Returns
        -------
        int
            `detail` of the answer

        Raises
        ------
        RefusedError
            the service refused; the text says why
        RequestTimeoutError
            no answer in time
        NotRunningError
            the service died meanwhile
        """
        deadline, tries = time.monotonic() + timeout_s, 0
        while not self._answered():
            there = self._client._follow()
            if self._answered():  # before it ended
                break
            if self._client.board is not self._board:
                self._given_up = True
                raise NotRunningError(
                    f"service {self._client.name!r} was restarted before it answered; ask again"
                )
            if not there or time.monotonic() > deadline:
                self._given_up = True  # the next request need not wait for this one
                if not there or not self._client.alive():
                    raise NotRunningError(f"service {self._client.name!r} does not answer any more")
                raise RequestTimeoutError(
                    f"service {self._client.name!r} did not answer within {timeout_s:g} s; "
                    "it may be busy with the map (surffollow status)"
                )
            time.sleep(_POLL_S[min(tries, len(_POLL_S) - 1)])
            tries += 1
        assert self._answer is not None
        self._client._settled(self)
        code, detail = int(self._answer["result"]), int(self._answer["detail"])
        if code != OK:
            raise RefusedError(_explain(code, detail, self._board.latch("params", Params).read() or {}), code)
        return detail

    def settle(self, timeout_s: float, wait: bool) -> Ticket:
        """Wait for the answer when asked to.

        Parameters
        ----------
        timeout_s : float
            longest wait for the answer [s]
        wait : bool
            False: return at once

        Returns
        -------
        Ticket
            this one
        """
        if wait:
            self.result(timeout_s)
        return self


def _explain(code: int, detail: int, in_force: Mapping[str, Any]) -> str:
    text = RESULT_TEXT[code] if 0 <= code < len(RESULT_TEXT) else f"result {code}"
    if code in (ERR_POSE_HELD, ERR_RANGE_HELD):
        return f"refused: {text} (pid {detail})"
    if code == ERR_NO_CHANNEL:
        channels = "one channel" if detail == 1 else f"{detail} channels"
        return f"refused: {text}; it has {channels if detail else 'another kind of driver'}"
    if code == ERR_NOT_POSE_HOLDER:
        return f"refused: {text}; " + (f"now that is pid {detail}" if detail else "no client sends it now")
    if code == ERR_STOP_REMAINS:
        from surffollow.config.stop_causes import stop_names

        return f"refused: {text} ({', '.join(stop_names(detail))})"
    if code in (ERR_BAD_VALUE, ERR_BEYOND_LIMITS) and detail >= 0:
        from surffollow.config.window_fit import FITTED, RULE

        names, rule = [f.name for f in Params.FIELDS if f.offset == 8 * detail], ""
        if code == ERR_BAD_VALUE and names and names[0] in FITTED:
            now = ", ".join(f"{n} {in_force[n]:g} m" for n in FITTED if n in in_force)
            rule = f"; {RULE} (in force: {now})"
        return f"refused: {text} ({names[0] if names else f'parameter number {detail}'}){rule}"
    return f"refused: {text}"


class StopTicket(Ticket):
    """Of a stop that was stored while a request was being sent: done when demands are stopped."""

    def __init__(self, client: RequestSender) -> None:
        super().__init__(client, RQ_STOP, 0)

    def _look(self) -> dict[str, Any] | None:
        stopped = self._client.dev_vector().status & STOPPED
        return {"result": OK, "detail": stopped} if stopped else None
