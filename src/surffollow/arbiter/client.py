"""Take part: ask for resources, command them, give them back."""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import os
import struct
import threading
import time
import weakref
from typing import Any, NamedTuple

from surffollow.arbiter import layout as al
from surffollow.arbiter import python_futex, table
from surffollow.arbiter.handshake import Welcomed, enter, knock
from surffollow.arbiter.observer import ArbiterObserver, BoardReader
from surffollow.client.fence import FENCED, fence
from surffollow.config.names import check_name
from surffollow.errors import ClosedError, NotRunningError, RefusedError, RequestTimeoutError, UsageError
from surffollow.shm.latch_shape import HEAD_BYTES, SLOTS, stride

_DESK = -(-al.ClientDesk.SIZE // 64) * 64
_ENTRY = -(-al.ClientEntry.SIZE // 64) * 64
_CONSUMED = al.ClientEntry.offset("consumed")
_BELL, _HELD, _ASKED = (al.ClientDesk.offset(n) for n in ("bell", "held", "asked"))
_BEAT, _HEAD, _DOORBELL, _ITEMS = (al.Mailbox.offset(n) // 8 for n in ("beat_ns", "head", "doorbell", "item"))
_ITEM = struct.Struct(f"<5q{al.VALUES}d{al.POSE}d")
_PLAIN = struct.Struct(f"<5q{al.VALUES}d")
_MASK = al.MAILBOX_ITEMS - 1
_REPLY, _REPLY_STRIDE = al.Reply.struct_of("seq", "holder_priority"), stride(al.Reply.SIZE)
_clock = time.monotonic_ns
_NO_POSE = (0.0,) * al.POSE
BEATS_PER_LEASE = 5
ATTACH_POLL_S = 0.02
DYING_S = 0.3
WAIT_SLICE_S = 0.05
SPINS = 500  # looks at the board before sleeping, some 15 us


class Reply(NamedTuple):
    """The answer to a request; true when the resource is ours.

    Attributes
    ----------
    reason : str            GRANT, KEEP (it was ours), DENY, DENY_LEASE, or TIMEOUT (queued in vain)
    token : int
    holder : str            who holds it instead; "" for nobody
    holder_priority : int
    """

    granted: bool
    reason: str
    token: int
    holder: str
    holder_priority: int

    def __bool__(self) -> bool:
        return self.granted


class Resource:
    """One resource as its clients see it; made by `ArbiterClient.resource`."""

    def __init__(self, client: ArbiterClient, number: int) -> None:
        self._client, self._number = client, number
        config = client.board.resources[number]
        self.name, self.n_values = str(config["name"]), int(config["n_values"])
        self.fields = tuple(str(config["fields"]).split(","))
        self._held, self._asked = client._desk_words(number)
        self._words = client._board_words
        self._padding = (0.0,) * (al.VALUES - self.n_values)
        self._command = al.ITEM_COMMAND | number << 8
        self._put, self._post_words = client._put, client._post_words
        self._pack = _PLAIN.pack_into

    @property
    def token(self) -> int:
        """The token that this client holds, 0: none."""
        return int(self._words[self._held])

    @property
    def held(self) -> bool:
        """Whether this client holds the resource, as the server said last; never waits."""
        return self._words[self._held] != 0 and self._client.connected

    @property
    def asked(self) -> bool:
        """Whether the server asks this holder to relinquish (cooperative policy)."""
        return self._words[self._asked] != 0 and self.held

    def holder(self) -> Any:
        """Who holds the resource (`observer.Holder`), None: nobody."""
        return self._client.holder(self.name)

    def request(self, *, wait: bool = False, timeout_s: float = 1.0) -> Reply:
        """Ask for control.

        Parameters
        ----------
        wait : bool         stand in the queue for `timeout_s` when another client holds it
        timeout_s : float   for the server's answer, and in the queue

        Raises
        ------
        RequestTimeoutError  the server did not answer
        NotRunningError      it ended
        """
        return self._client._request(self._number, wait, timeout_s)

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
        values : as many floats as the resource's command has
        t_ns : int, optional     when it was made [ns]; now when absent
        ref_t_ns, ref_pose       stamp and value (7 floats) of the pose that it is relative to

        Returns
        -------
        bool  False: this client does not hold the resource, or the mailbox is full; nothing was sent

        Raises
        ------
        UsageError  another number of values
        """
        token = self._words[self._held]
        if token == 0:
            return False
        if len(values) != self.n_values:
            raise UsageError(
                f"{self.name!r} takes {self.n_values} values ({', '.join(self.fields)}), not {values!r}"
            )
        client, words = self._client, self._post_words
        head = words[_HEAD]
        if head - self._words[client._consumed] >= al.MAILBOX_ITEMS:
            return False
        now = _clock()
        at = 8 * _ITEMS + (head & _MASK) * al.Item.SIZE
        t = now if t_ns is None else t_ns
        if ref_pose is None:
            self._pack(self._put, at, head + 1, self._command, token, t, ref_t_ns, *values, *self._padding)
        else:
            pose = tuple(ref_pose)
            _ITEM.pack_into(
                self._put, at, head + 1, self._command, token, t, ref_t_ns, *values, *self._padding, *pose
            )
        if FENCED:
            fence()
        words[_HEAD] = head + 1
        words[_BEAT] = now
        return True

    def relinquish(self) -> None:
        """Give control back, or leave the queue."""
        self._client._relinquish(self._number)


class ArbiterClient(ArbiterObserver):
    """A client with a slot of its own; a thread shows that it lives; one other thread at a time may use it.

    Attributes
    ----------
    client : str       its name in the configuration
    number : int       as in the history
    """

    def __init__(self, name: str, client: str, met: Welcomed) -> None:
        mailbox, board = met.fds
        memory = mmap.mmap(board, 0, mmap.MAP_SHARED, mmap.PROT_READ)
        super().__init__(name, BoardReader(name, memory))
        self.client, self.number, self.slot, self._met = client, met.number, met.slot, met
        self._put = mmap.mmap(mailbox, al.MAILBOX_BYTES)
        self._post_words = memoryview(self._put).cast("q")
        os.close(mailbox)
        os.close(board)
        met.fds.clear()
        enter(met.sock, name)
        self._board_words = self.board.words
        regions = self.board.regions
        self._desk = regions["desks"][0] + self.slot * _DESK
        self._consumed = (regions["clients"][0] + self.slot * _ENTRY + _CONSUMED) // 8
        self._bell = (self._desk + _BELL) // 8
        self._bell_address = _address(memory) + self._desk + _BELL
        self._doorbell = ctypes.addressof(ctypes.c_char.from_buffer(self._put)) + 8 * _DOORBELL
        base = regions["replies"][0] + self.slot * al.REPLY_BYTES
        self._reply_word, self._reply_at = base // 8, base + HEAD_BYTES
        self._over = threading.Event()
        self._gone = False
        self._lock = threading.Lock()
        self._beat_s = self.board.header["lease_ns"] / 1e9 / BEATS_PER_LEASE
        self._thread = threading.Thread(target=self._show_life, name="arbiter heartbeat", daemon=True)
        self._thread.start()
        _clients.add(self)

    @property
    def connected(self) -> bool:
        """Whether the server is there and this client was not closed."""
        return not self._gone

    def resource(self, name: str) -> Resource:
        """A resource by its name."""
        return Resource(self, self.board.number_of(name))

    def _desk_words(self, resource: int) -> tuple[int, int]:
        return (self._desk + _HELD) // 8 + resource, (self._desk + _ASKED) // 8 + resource

    def _show_life(self) -> None:
        import select

        poll = select.poll()
        poll.register(self._met.sock.fileno(), select.POLLIN)
        while not self._over.is_set():
            self._post_words[_BEAT] = _clock()
            # the server never writes: what can be read is its end
            if poll.poll(self._beat_s * 1e3):
                self._gone = True
                return

    def _here(self) -> None:
        if self._over.is_set():
            raise ClosedError("this client was closed; attach again")
        if self._gone:
            raise NotRunningError(
                f"arbiter {self.name!r} ended; attach again and ask again: every token is void"
            )

    def _post(self, what: int) -> int:
        """Put a request or relinquishment into the mailbox and ring; its sequence number."""
        self._here()
        words = self._post_words
        with self._lock:
            head = words[_HEAD]
            deadline = time.monotonic() + 1.0
            while head - self._board_words[self._consumed] >= al.MAILBOX_ITEMS:
                if time.monotonic() > deadline:
                    raise RequestTimeoutError(
                        f"arbiter {self.name!r} takes nothing from this client's mailbox"
                    )
                time.sleep(0.001)
            at = 8 * _ITEMS + (head & _MASK) * al.Item.SIZE
            now = _clock()
            _PLAIN.pack_into(self._put, at, head + 1, what, 0, now, 0, *(0.0,) * al.VALUES)
            if FENCED:
                fence()
            words[_BEAT] = now
            words[_HEAD] = head + 1
            words[_DOORBELL] = words[_DOORBELL] + 1
        python_futex.wake(self._doorbell)
        return int(head) + 1

    def _await_bell(self, seen: int, deadline: float) -> None:
        words, index = self._board_words, self._bell
        for _ in range(SPINS):  # an answer takes less time than falling asleep and waking up
            if words[index] != seen:
                return
        left = deadline - time.monotonic()
        if left > 0:
            python_futex.wait(self._bell_address, seen, min(left, WAIT_SLICE_S))

    def _request(self, resource: int, wait: bool, timeout_s: float) -> Reply:
        deadline = time.monotonic() + timeout_s
        words, held = self._board_words, self._desk_words(resource)[0]
        reply = self._ask(al.ITEM_REQUEST | resource << 8 | (al.FLAG_WAIT << 16 if wait else 0), deadline)
        if reply is None:
            raise RequestTimeoutError(f"arbiter {self.name!r} did not answer in {timeout_s:g} s")
        result = reply[1]
        if result in (table.GRANT, table.KEEP):
            return Reply(True, al.EVENT_NAMES[result], reply[2], "", 0)
        if result != table.ENQUEUE:
            return self._denied(reply, al.EVENT_NAMES.get(result, str(result)))
        while words[held] == 0 and time.monotonic() < deadline:
            self._here()
            bell = words[self._bell]
            if words[held] == 0:
                self._await_bell(bell, deadline)
        if words[held] == 0:
            self._relinquish(resource)
        if words[held] != 0:
            return Reply(True, "GRANT", int(words[held]), "", 0)
        return self._denied(reply, "TIMEOUT")

    def _ask(self, what: int, deadline: float) -> tuple[int, ...] | None:
        """Post something; the answer to it: (seq, result, token, holder, its priority), or None: too late."""
        words, index = self._board_words, self._reply_word
        bell = words[self._bell]
        seq = self._post(what)
        while True:
            # R1-R4 of the latch; one that is overtaken is read again
            g = words[index]
            if FENCED:
                fence()
            at = self._reply_at + (g & (SLOTS - 1)) * _REPLY_STRIDE
            reply = _REPLY.unpack_from(self.board.memory, at)
            if FENCED:
                fence()
            if words[index] - g > SLOTS - 2:
                continue
            if reply[0] == seq:
                return reply
            self._here()
            if time.monotonic() > deadline:
                return None
            self._await_bell(bell, deadline)
            bell = words[self._bell]

    def _denied(self, reply: tuple[int, ...], reason: str) -> Reply:
        name = ""
        for slot in range(al.CLIENTS):
            entry = self.board.entry(slot)
            if reply[3] and entry["number"] == reply[3]:
                name = str(entry["name"])
        return Reply(False, reason, 0, name, reply[4])

    def _relinquish(self, resource: int) -> None:
        self._ask(al.ITEM_RELINQUISH | resource << 8, time.monotonic() + 1.0)

    def close(self) -> None:
        """End: whatever this client holds or waits for is given up."""
        if self._over.is_set():
            return
        self._over.set()
        with contextlib.suppress(OSError):
            self._met.sock.shutdown(2)
        self._gone = True
        self._thread.join(1.0)
        self._met.sock.close()
        # mappings stay until the last handle goes: a thread may still look at `held`


_clients: weakref.WeakSet[ArbiterClient] = weakref.WeakSet()


def _forget_in_child() -> None:
    # the connection is the parent's life: a child must not keep it
    for client in list(_clients):
        client._gone = True
        client._over.set()
        with contextlib.suppress(OSError):
            client._met.sock.close()


os.register_at_fork(after_in_child=_forget_in_child)


def _address(memory: mmap.mmap) -> int:
    """Address of a read-only mapping."""
    view = ctypes.py_object(memory)
    buffer = _PyBuffer()
    ctypes.pythonapi.PyObject_GetBuffer(view, ctypes.byref(buffer), 0)
    try:
        return int(buffer.buf or 0)
    finally:
        ctypes.pythonapi.PyBuffer_Release(ctypes.byref(buffer))


class _PyBuffer(ctypes.Structure):
    """Py_buffer of CPython; its first member is all that is used."""

    _fields_ = (
        ("buf", ctypes.c_void_p),
        ("obj", ctypes.c_void_p),
        ("len", ctypes.c_ssize_t),
        ("itemsize", ctypes.c_ssize_t),
        ("readonly", ctypes.c_int),
        ("ndim", ctypes.c_int),
        ("format", ctypes.c_char_p),
        ("shape", ctypes.c_void_p),
        ("strides", ctypes.c_void_p),
        ("suboffsets", ctypes.c_void_p),
        ("internal", ctypes.c_void_p),
    )


def attach(name: str, client: str, *, timeout_s: float = 5.0) -> ArbiterClient:
    """Attach to an arbiter under a name that its configuration declares.

    Parameters
    ----------
    name : str          of the arbiter
    client : str        its priority is the configuration's
    timeout_s : float   how long to wait for a server that has not started

    Raises
    ------
    NotRunningError  no server in that time
    RefusedError     unknown or taken name, no free slot, not a user who may
    """
    check_name(f"{name}.arbiter")
    check_name(client)
    began = time.monotonic()
    deadline = began + timeout_s
    while True:
        try:
            return ArbiterClient(name, client, knock(name, client, timeout_s))
        except NotRunningError:
            if time.monotonic() >= deadline:
                raise
        except RefusedError as e:
            # a client that ended just now holds its name until the server has let it go
            if e.code not in (al.HELLO_TAKEN, al.HELLO_FULL) or time.monotonic() - began > DYING_S:
                raise
        time.sleep(ATTACH_POLL_S)
