"""Hand out slots on NAME.sock, and notice when a client lets go of its own or dies.

A connection is the ownership of a slot. The kernel closes it with the client's last copy of it. A pidfd
reports the end of the process that connected, also when its children keep descriptors. Steps of the exchange:
docs/reference/protocol.md. Everything here runs in the main thread, beside the cycle: no call waits, the work
per period is bounded, and any failure costs one connection. Messages are received and connections ended by
`shm.received_descriptors` alone: a client may send descriptors whose end takes as long as it likes.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
from collections import Counter
from dataclasses import dataclass, field

from surffollow.service.client_table import ClientId, ClientTable, is_exempt
from surffollow.shm import board_regions
from surffollow.shm import layout_slot as ls
from surffollow.shm.readable import wait_readable
from surffollow.shm.received_descriptors import Disposal, receive
from surffollow.shm.unix_socket import Peer, peer_of, peer_pidfd

EXCHANGE_S = 1.0  # for a client to answer
FULL_S = 0.1  # for a slot of a client that is just ending to come free
EVENTS_PER_PASS = 256
MAX_PENDING, MAX_PENDING_PER_USER = 32, 8  # connections without a slot
BACKLOG = 64
_RENEW_S = 0.002
_MESSAGE = ls.SlotMessage.struct_of("magic", "name")
_LAYOUT_HASH = board_regions.layout_hash()
ASKED, OFFERED, HELD = range(3)


@dataclass(eq=False)
class Connection:
    """A connection of a client, with or without a slot."""

    sock: socket.socket
    peer: Peer
    deadline: float
    pidfd: int = -1
    stage: int = -1  # nothing was received yet
    name: str = ""
    slot: int = -1
    claim: int = 0
    asked: float = 0.0
    fds: list[int] = field(default_factory=list)


class SlotServer:
    """Serves the clients of one service.

    Parameters
    ----------
    listener : socket.socket   of NAME.sock, not blocking
    table : ClientTable
    epoch : int                of this start
    """

    def __init__(self, listener: socket.socket, table: ClientTable, epoch: int) -> None:
        self.table, self._listener, self._epoch = table, listener, epoch
        self._connections: dict[int, Connection] = {}  # by each of their descriptors
        self._epoll = select.epoll()
        self._epoll.register(listener.fileno(), select.EPOLLIN)
        self._listening, self._disposal = True, Disposal()
        self.failures, self.last_failure = 0, ""

    def serve(self, wake: int, seconds: float) -> bool:
        """Serve for so long; True as soon as the descriptor `wake` can be read."""
        end, events_left = time.monotonic() + seconds, EVENTS_PER_PASS
        self._listen(True)
        with contextlib.suppress(FileExistsError):
            self._epoll.register(wake, select.EPOLLIN)
        while (left := end - time.monotonic()) > 0:
            if events_left <= 0:
                return wait_readable(wake, left)
            pause = min(left, _RENEW_S) if self.table.retiring else left
            events = self._epoll.poll(pause, 16)
            for fd, mask in sorted(events, key=self._comes_later):  # leaving clients make room for new ones
                events_left -= 1
                self._guard(self._on_event, fd, mask)
            if any(fd == wake for fd, _ in events):
                return True
            self._guard(self._housekeeping)
            self._guard(self._disposal.look)
        return False

    def _comes_later(self, event: tuple[int, int]) -> bool:
        return not event[1] & (select.EPOLLHUP | select.EPOLLRDHUP) and event[0] == self._listener.fileno()

    def _guard(self, action: object, *args: object) -> None:
        try:
            action(*args)  # type: ignore[operator]
        except Exception as e:  # nothing here may end following
            self.failures, self.last_failure = self.failures + 1, f"{type(e).__name__}: {e}"
            self._listen(False)  # until the next housekeeping period: perhaps there are no descriptors left

    def _listen(self, expected: bool) -> None:
        if expected != self._listening and self._listener.fileno() >= 0:
            self._listening = expected
            self._epoll.modify(self._listener.fileno(), select.EPOLLIN if expected else 0)

    def _on_event(self, fd: int, mask: int) -> None:
        if fd == self._listener.fileno():
            self._accept()
            return
        connection = self._connections.get(fd)
        if connection is None:
            return
        try:
            if fd == connection.pidfd or mask & (select.EPOLLHUP | select.EPOLLERR | select.EPOLLRDHUP):
                self._drop(connection)
            else:
                self._receive(connection)
        except (ConnectionError, BlockingIOError):  # it left, takes nothing, or sent descriptors
            self._drop(connection)
        except Exception:
            self._drop(connection)
            raise

    def _accept(self) -> None:
        if self._disposal.full:
            self._listen(False)  # until the next housekeeping period
            return
        try:
            sock, _ = self._listener.accept()
        except (BlockingIOError, ConnectionAbortedError):
            return
        try:
            sock.setblocking(False)
            peer = peer_of(sock)
            if not self._make_room(peer.uid):
                self._disposal.part(sock)
                return
            connection = Connection(sock, peer, time.monotonic() + EXCHANGE_S)
            self._watch(connection, sock.fileno(), select.EPOLLIN | select.EPOLLRDHUP)
            connection.pidfd = peer_pidfd(sock, peer.pid)
            if connection.pidfd >= 0:
                self._watch(connection, connection.pidfd, select.EPOLLIN)
        except BaseException:
            self._disposal.part(sock)
            raise

    def _make_room(self, uid: int) -> bool:
        """Whether one more connection may wait for a slot; else the user with most connections loses one."""
        waiting = [c for c in set(self._connections.values()) if c.stage != HELD]
        of_user = Counter(c.peer.uid for c in waiting)
        if of_user[uid] >= MAX_PENDING_PER_USER and not is_exempt(uid):
            return False
        if len(waiting) < MAX_PENDING:
            return True
        most = max(of_user.values())
        if of_user[uid] + 1 >= most:
            return False
        self._drop(min((c for c in waiting if of_user[c.peer.uid] == most), key=lambda c: c.deadline))
        return True

    def _watch(self, connection: Connection, fd: int, events: int) -> None:
        self._epoll.register(fd, events)
        self._connections[fd] = connection
        connection.fds.append(fd)

    def _receive(self, connection: Connection) -> None:
        try:
            data = receive(connection.sock, 4 * _MESSAGE.size)
        except BlockingIOError:
            return
        if not data:
            self._drop(connection)
            return
        if len(data) != _MESSAGE.size:
            self._refuse(connection, ls.SLOT_BAD_MESSAGE)
            return
        magic, layout, step, epoch, _, _, _, claim, name = _MESSAGE.unpack(data)
        if magic != ls.SLOT_MAGIC or layout != _LAYOUT_HASH:
            self._refuse(connection, ls.SLOT_BAD_MESSAGE)
        elif step == ls.SLOT_ASK and connection.stage == -1:
            self._ask(connection, epoch, name)
        elif step == ls.SLOT_MAPPED and connection.stage == OFFERED and claim == connection.claim:
            self._grant(connection)
        else:
            self._refuse(connection, ls.SLOT_BAD_MESSAGE)

    def _ask(self, connection: Connection, epoch: int, name: bytes) -> None:
        if epoch != self._epoch:
            self._refuse(connection, ls.SLOT_OTHER_RUN)
            return
        text = name.split(b"\0", 1)[0].decode("utf-8", "replace")
        connection.name = "".join(c if c.isprintable() else "?" for c in text)
        connection.stage, connection.asked = ASKED, time.monotonic()
        self._offer(connection)

    def _offer(self, connection: Connection) -> None:
        result, detail = self.table.refusal(connection.peer.uid, connection.peer.pid)
        if result != ls.SLOT_OK:
            self._refuse(connection, result, detail)
            return
        slot = self.table.promise(ClientId(connection.peer.pid, connection.peer.uid, connection.name))
        if slot < 0:
            if not self.table.retiring and time.monotonic() - connection.asked > FULL_S:
                self._refuse(connection, ls.SLOT_ALL_TAKEN, self.table.room_for(connection.peer.uid))
            return
        connection.slot, connection.claim, connection.stage = slot, self.table.new_claim(), OFFERED
        message = self._message(connection, ls.SLOT_OFFER)
        fd = self.table.descriptor(slot)
        try:
            socket.send_fds(connection.sock, [message], [fd], socket.MSG_NOSIGNAL | socket.MSG_DONTWAIT)
        finally:
            os.close(fd)

    def _grant(self, connection: Connection) -> None:
        try:
            self.table.grant(connection.slot, connection.claim)
        except PermissionError:  # the client has sealed it against our seals
            self._refuse(connection, ls.SLOT_BAD_MESSAGE)
            return
        connection.stage = HELD
        connection.sock.send(
            self._message(connection, ls.SLOT_GRANT), socket.MSG_NOSIGNAL | socket.MSG_DONTWAIT
        )

    def _refuse(self, connection: Connection, result: int, detail: int = 0) -> None:
        with contextlib.suppress(OSError):
            message = self._message(connection, ls.SLOT_REFUSE, result, detail)
            connection.sock.send(message, socket.MSG_NOSIGNAL | socket.MSG_DONTWAIT)
        self._drop(connection)

    def _message(self, connection: Connection, step: int, result: int = ls.SLOT_OK, detail: int = 0) -> bytes:
        return _MESSAGE.pack(
            ls.SLOT_MAGIC,
            _LAYOUT_HASH,
            step,
            self._epoch,
            result,
            detail,
            connection.slot,
            connection.claim,
            connection.name.encode()[:31],
        )

    def _drop(self, connection: Connection) -> None:
        for fd in connection.fds:
            self._connections.pop(fd, None)
            with contextlib.suppress(OSError):
                self._epoll.unregister(fd)
        connection.fds.clear()
        self._disposal.part(connection.sock)
        if connection.pidfd >= 0:
            os.close(connection.pidfd)
            connection.pidfd = -1
        if connection.slot >= 0:
            slot, connection.slot = connection.slot, -1
            self.table.retire(slot)

    def _housekeeping(self) -> None:
        """Renew slots, offer them to clients that wait for one, end exchanges that take too long."""
        self.table.renew_retired()
        now = time.monotonic()
        for connection in sorted(set(self._connections.values()), key=lambda c: c.asked):
            if connection.stage == HELD:
                continue
            if now > connection.deadline:
                self._drop(connection)
            elif connection.stage == ASKED:
                try:
                    self._offer(connection)
                except ConnectionError:
                    self._drop(connection)
                except Exception:
                    self._drop(connection)
                    raise

    def close(self) -> None:
        """Let all clients go."""
        for connection in set(self._connections.values()):
            self._drop(connection)
        self._epoll.close()
        self._disposal.part_listener(self._listener)
