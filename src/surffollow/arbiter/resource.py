"""One resource as a client uses it: ask for it, command it, give it back."""

from __future__ import annotations

import contextlib
import math
import operator
import struct
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from surffollow.arbiter import exchange as ex
from surffollow.arbiter import layout as al
from surffollow.arbiter import table
from surffollow.client.fence import FENCED, fence
from surffollow.errors import FaultError, RequestTimeoutError, UsageError
from surffollow.units import real_number

if TYPE_CHECKING:
    from surffollow.arbiter.client import ArbiterClient

_HEAD, _HEARTBEAT, _ITEMS, _MASK, _ITEM_BYTES = ex.HEAD, ex.HEARTBEAT, ex.ITEMS, ex.MASK, ex.ITEM_BYTES
_RESULT, _TOKEN = ex.RESULT, ex.TOKEN
_reply: Callable[..., Reply] = tuple.__new__  # half the time of the constructor
_clock = time.monotonic_ns
_NO_POSE = (0.0,) * al.POSE
RELINQUISH_NS = 1_000_000_000
MAX_TIMEOUT_S = 1e6


class Reply(NamedTuple):
    """The answer to a request; true when this client holds the resource.

    Attributes
    ----------
    granted : bool
        whether this client holds the resource
    reason : str
        GRANT, KEEP (this client held it already), DENY, DENY_LEASE, or TIMEOUT (queued in vain)
    token : int
        under which this client's commands are forwarded; 0: none
    holder : str
        name of the client that holds it instead; "" for none
    holder_priority : int
        priority of that client; 0: none

    Examples
    --------
    >>> from surffollow.arbiter import attach
    >>> with attach("cell", "avoid") as first, attach("cell", "go") as second:
    ...     _ = first.resource("robot").request(timeout_s=5.0)
    ...     reply = second.resource("robot").request(timeout_s=5.0)
    >>> bool(reply), reply.reason, reply.holder, reply.holder_priority
    (False, 'DENY', 'avoid', 40)
    """

    granted: bool
    reason: str
    token: int
    holder: str
    holder_priority: int

    def __bool__(self) -> bool:
        return self.granted


class Resource:
    """One resource as its clients see it; made by `ArbiterClient.resource`.

    Attributes
    ----------
    name : str
        of the resource
    n_values : int
        numbers of one command
    fields : tuple of str
        names of these numbers

    Examples
    --------
    >>> from surffollow.arbiter import attach
    >>> with attach("cell", "go") as arbiter:
    ...     robot = arbiter.resource("robot")
    ...     if robot.request(wait=True, timeout_s=5.0):
    ...         sent = robot.command(0.2, 0.0)      # False: a client of higher priority has it now
    ...     robot.relinquish()
    >>> robot.fields, sent
    (('speed', 'turn_rate'), True)
    """

    def __init__(self, client: ArbiterClient, exchange: ex.Exchange, number: int) -> None:
        self._client, self._exchange = client, exchange
        config = client.board.resources[number]
        self.name, self.n_values = str(config["name"]), int(config["n_values"])
        self.fields = tuple(str(config["fields"]).split(","))
        self._held, self._asked = exchange.grant_words(number)
        self._words, self._mailbox = exchange.words, exchange.mailbox
        self._mailbox_words = exchange.mailbox_words
        self._consumed = exchange.consumed
        self._padding = (0.0,) * (al.VALUES - self.n_values)
        self._command = al.ITEM_COMMAND | number << 8
        self._request = al.ITEM_REQUEST | number << 8
        self._queue_up = self._request | al.FLAG_WAIT << 16
        self._relinquish = al.ITEM_RELINQUISH | number << 8
        self._pack = ex.COMMAND.pack_into

    @property
    def token(self) -> int:
        """The token that this client holds, 0: none."""
        return 0 if self._exchange.ended else int(self._words[self._held])

    @property
    def held(self) -> bool:
        """Whether this client holds the resource, as the server said last; never waits."""
        return self._words[self._held] != 0 and not self._exchange.ended

    @property
    def asked(self) -> bool:
        """Whether the server asks this holder to relinquish (cooperative policy)."""
        return self._words[self._asked] != 0 and self.held

    def holder(self) -> Any:
        """Holder of the resource.

        Returns
        -------
        Holder or None
            None: no client, or the server ended
        """
        return None if self._exchange.ended else self._client.holder(self.name)

    def request(self, *, wait: bool = False, timeout_s: float = 1.0) -> Reply:
        """Ask for control.

        Parameters
        ----------
        wait : bool
            stand in the queue for `timeout_s` when another client holds it
        timeout_s : float
            for the server's answer, and in the queue

        Returns
        -------
        Reply
            true when control was granted; otherwise with reason and holder

        Raises
        ------
        RequestTimeoutError
            the server did not answer; the request is withdrawn
        NotRunningError
            it ended
        UsageError
            no such time

        Notes
        -----
        An exception that ends the wait, such as KeyboardInterrupt, withdraws the request, too.
        """
        if not 0.0 <= real_number(timeout_s, "timeout_s") < MAX_TIMEOUT_S:
            raise UsageError(f"timeout_s is {timeout_s}; expected 0 to {MAX_TIMEOUT_S:g} s")
        before, sent = self._words[self._held], self._mailbox_words[_HEAD]
        try:
            return self._ask(wait, timeout_s)
        except BaseException:
            # a server that answers later grants nothing: this program does not know that it would hold it
            if before == 0 and self._mailbox_words[_HEAD] != sent:
                with contextlib.suppress(FaultError):
                    self._exchange.send(self._relinquish, _clock())
            raise

    def _ask(self, wait: bool, timeout_s: float) -> Reply:
        timeout_ns, words = int(timeout_s * 1e9), self._words
        at = self._exchange.request(self._queue_up if wait else self._request, timeout_ns)
        if at < 0:
            raise RequestTimeoutError(f"arbiter {self._client.name!r} did not answer in {timeout_s:g} s")
        result = words[at + _RESULT]
        if result == table.GRANT:
            return _reply(Reply, (True, "GRANT", words[at + _TOKEN], "", 0))
        if result == table.KEEP:
            return Reply(True, "KEEP", words[at + _TOKEN], "", 0)
        other = (self._name_of(words[at + ex.HOLDER]), words[at + ex.HOLDER_PRIORITY])
        if result != table.ENQUEUE:
            return Reply(False, al.EVENT_NAMES.get(result, str(result)), 0, *other)
        token = self._exchange.wait_for_word(self._held, timeout_ns)
        if token == 0:
            self.relinquish()
            token = self.token
        return Reply(True, "GRANT", token, "", 0) if token else Reply(False, "TIMEOUT", 0, *other)

    def _name_of(self, number: int) -> str:
        """Name of the client of this number, "" for none."""
        entries = (self._client.board.entry(slot) for slot in range(al.CLIENTS)) if number else ()
        return next((str(e["name"]) for e in entries if e["number"] == number), "")

    def command(
        self,
        *values: float,
        t_ns: int | None = None,
        ref_t_ns: int = 0,
        ref_pose: Any = None,
    ) -> bool:
        """Send one command; never waits.

        Parameters
        ----------
        values : float
            as many as the resource's command has, in the declared units; finite
        t_ns : int, optional
            when it was made, CLOCK_MONOTONIC [ns]; now when absent
        ref_t_ns : int
            timestamp of the pose that the values are relative to [ns]; 0: relative to none
        ref_pose : seven floats, optional
            that pose: x y z [m], qx qy qz qw; needs `ref_t_ns`. The timestamp alone is enough where nothing
            is summed that is relative to another pose

        Returns
        -------
        bool
            False: this client does not hold the resource, the server ended, or the mailbox is full; nothing
            was sent

        Raises
        ------
        UsageError
            another number of values, a value that is no finite number, a time that is no whole number, no
            such pose, or a pose without its time; nothing was sent

        Notes
        -----
        A command is valid for the `ttl` of the resource. Send the next one before that time is over.
        """
        token = self._words[self._held]
        if token == 0 or self._exchange.ended:
            return False
        if len(values) != self.n_values:
            raise UsageError(
                f"{self.name!r} takes {self.n_values} values ({', '.join(self.fields)}), not {values!r}"
            )
        try:
            finite = math.isfinite(math.fsum(values))
        except (TypeError, ValueError, OverflowError):
            finite = False
        if not finite:
            raise self._no_numbers(values)
        if ref_pose is not None and ref_t_ns == 0:
            raise UsageError("ref_pose needs ref_t_ns, the time of its report [ns of CLOCK_MONOTONIC], not 0")
        mailbox_words = self._mailbox_words
        head = mailbox_words[_HEAD]
        if head - self._words[self._consumed] >= al.MAILBOX_ITEMS:
            return False
        now = _clock()
        at = _ITEMS + (head & _MASK) * _ITEM_BYTES
        t = now if t_ns is None else t_ns
        try:
            if ref_t_ns == 0:
                self._pack(
                    self._mailbox, at, head + 1, self._command, token, t, ref_t_ns, *values, *self._padding
                )
            else:
                pose = tuple(ref_pose) if ref_pose is not None else _NO_POSE  # not what the place held before
                ex.COMMAND_AT_POSE.pack_into(
                    self._mailbox,
                    at,
                    head + 1,
                    self._command,
                    token,
                    t,
                    ref_t_ns,
                    *values,
                    *self._padding,
                    *pose,
                )
        except (struct.error, TypeError, OverflowError):
            raise self._no_command(t, ref_t_ns, ref_pose) from None
        if FENCED:
            fence()
        mailbox_words[_HEAD] = head + 1
        mailbox_words[_HEARTBEAT] = now
        return True

    def _no_numbers(self, values: tuple[Any, ...]) -> UsageError:
        """The error that names the first value that is no finite number."""
        for field, value in zip(self.fields, values, strict=True):
            try:
                finite = math.isfinite(math.fsum((value,)))
            except (TypeError, ValueError, OverflowError):
                finite = False
            if not finite:
                return UsageError(f"{field} of {self.name!r} is {value!r}; it must be a finite number")
        return UsageError(f"values of {self.name!r} are too large: {values!r}")

    def _no_command(self, t_ns: object, ref_t_ns: object, ref_pose: object) -> UsageError:
        """The error that names the time or the pose that cannot be sent."""
        for name, time_ns in (("t_ns", t_ns), ("ref_t_ns", ref_t_ns)):
            try:
                fits = abs(operator.index(time_ns)) < 1 << 63  # type: ignore[arg-type]
            except TypeError:
                fits = False
            if not fits:
                return UsageError(f"{name} must be a whole number of ns of CLOCK_MONOTONIC, not {time_ns!r}")
        return UsageError(f"ref_pose is seven numbers x y z qx qy qz qw, not {ref_pose!r}")

    def relinquish(self) -> None:
        """Give control back, or leave the queue.

        Raises
        ------
        ClosedError
            this client was closed
        NotRunningError
            the server ended
        RequestTimeoutError
            the server did not answer; it is given back when the server runs again and this client still lives
        """
        if self._exchange.request(self._relinquish, RELINQUISH_NS) < 0:
            raise RequestTimeoutError(
                f"arbiter {self._client.name!r} did not answer in {1e-9 * RELINQUISH_NS:g} s; {self.name!r} "
                "is not given back yet"
            )
