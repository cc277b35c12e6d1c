"""Clients come and go: a connection owns a mailbox and a slot from its welcome to its end."""

from __future__ import annotations

import contextlib
import mmap
import os
import pwd
import select
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from surffollow.arbiter import handshake as hs
from surffollow.arbiter import layout as al
from surffollow.arbiter import memory as m
from surffollow.arbiter.board import Board
from surffollow.arbiter.config import ArbiterConfig
from surffollow.config.trusted_users import own_user
from surffollow.errors import ConfigError
from surffollow.shm.python_atomics import load_acquire, store_release
from surffollow.shm.received_descriptors import Disposal, receive
from surffollow.shm.sealed import make_sealed, seal_for_good
from surffollow.shm.unix_socket import peer_of, peer_pidfd

CHECK_PERIOD_S = 0.2
LAST_ROUND_S = 2.0
MAX_UNIDENTIFIED = al.CLIENTS  # connections of one user that have not said who they are
ACCEPT_AT_ONCE = 64


class Connection:
    """A connection: it owns a slot from its welcome to its end."""

    def __init__(self, sock: socket.socket, pid: int, uid: int) -> None:
        self.sock, self.pid, self.uid = sock, pid, uid
        self.name, self.slot, self.number = "", -1, 0
        self.since = time.monotonic()
        self.pidfd = peer_pidfd(sock, pid)  # a child that inherited the connection does not keep it alive
        self.mailbox_fd, self.joined = -1, False
        self.mailbox: mmap.mmap | None = None

    def close(self, disposal: Disposal) -> None:
        """End the connection; what the client sent is not closed in this process."""
        disposal.part(self.sock)
        for fd in (self.pidfd, self.mailbox_fd):
            if fd >= 0:
                os.close(fd)
        self.pidfd = self.mailbox_fd = -1


def users_of(config: ArbiterConfig) -> set[int] | None:
    """Users that may attach; None: all."""
    if "*" in config.users:
        return None
    allowed = {0, own_user()}
    for name in config.users:
        try:
            allowed.add(pwd.getpwnam(name).pw_uid)
        except KeyError:
            raise ConfigError(f"configuration key users names {name!r}; there is no such user") from None
    return allowed


class ConnectionServer:
    """Connections of an arbiter's clients, served by the main thread; slot states inform the loop."""

    def __init__(
        self,
        config: ArbiterConfig,
        users: set[int] | None,
        board: Board,
        mem: Any,
        listener: socket.socket,
        wake_loop: Callable[[], None],
    ) -> None:
        self.config, self.board, self.mem = config, board, mem
        self._users, self._listener, self._wake_loop = users, listener, wake_loop
        self._connections: dict[int, Connection] = {}
        self._slots: list[Connection | None] = [None] * al.CLIENTS
        self._number = 0
        self._disposal = Disposal()

    def _slot_state(self, slot: int) -> int:
        return int(self.mem.ctx.ctypes.data) + 8 * (m.SLOT_STATE + slot)

    def serve_connections(self, wake: int) -> None:
        """Serve clients' connections until the descriptor `wake` can be read."""
        poll = select.epoll()
        poll.register(self._listener.fileno(), select.EPOLLIN)
        poll.register(wake, select.EPOLLIN)
        with poll:
            while True:
                waiting = any(c is not None and c.slot < 0 for c in self._slots)
                # connections that wait for their end take descriptors: no further ones until there is room
                poll.modify(self._listener.fileno(), 0 if self._disposal.full else select.EPOLLIN)
                check_soon = self._disposal.waiting or any(not c.joined for c in self._connections.values())
                for fd, _ in poll.poll(0.005 if waiting else CHECK_PERIOD_S if check_soon else -1):
                    if fd == wake:
                        return
                    if fd == self._listener.fileno():
                        self._accept(poll)
                    elif fd in self._connections:
                        self._receive(poll, self._connections[fd], fd)
                self._free_slots()
                with contextlib.suppress(OSError):  # no process to be had: tried again
                    self._disposal.look()
                for connection in self._unique_connections():
                    if not connection.joined and time.monotonic() - connection.since > hs.HELLO_TIMEOUT_S:
                        self._disconnect(poll, connection)

    def _accept(self, poll: select.epoll) -> None:
        for _ in range(ACCEPT_AT_ONCE):
            try:
                sock, _ = self._listener.accept()
            except OSError:
                return
            sock.setblocking(False)
            who = peer_of(sock)
            unidentified = sum(not c.joined and c.uid == who.uid for c in self._unique_connections())
            if not self._may_connect(who.uid):
                # its messages are not read, and it takes no slot
                with contextlib.suppress(OSError):
                    sock.send(hs.welcome(al.HELLO_USER), socket.MSG_NOSIGNAL)
                self._disposal.part(sock)
                continue
            if unidentified >= MAX_UNIDENTIFIED:  # connections without a name must not keep other users out
                self._disposal.part(sock)
                continue
            connection = Connection(sock, who.pid, who.uid)
            for fd in (sock.fileno(), connection.pidfd):
                if fd >= 0:
                    self._connections[fd] = connection
                    poll.register(fd, select.EPOLLIN)

    def _may_connect(self, uid: int) -> bool:
        return self._users is None or uid in self._users

    def _unique_connections(self) -> list[Connection]:
        return list({id(c): c for c in self._connections.values()}.values())

    def _disconnect(self, poll: select.epoll, connection: Connection) -> None:
        """The connection is over: its slot is, too."""
        for fd in (connection.sock.fileno(), connection.pidfd):
            if fd >= 0 and self._connections.pop(fd, None) is not None:
                poll.unregister(fd)
        connection.close(self._disposal)
        if connection.slot >= 0 and not connection.joined:
            self._slots[connection.slot] = None
        elif connection.slot >= 0:
            store_release(self._slot_state(connection.slot), m.LEAVING)
            connection.slot = -1  # `_slots` keeps it until the loop has let its mailbox go
            self._wake_loop()

    def _free_slots(self) -> None:
        for slot, connection in enumerate(self._slots):
            if connection is None or connection.slot >= 0:
                continue
            if load_acquire(self._slot_state(slot)) == m.LEFT:
                store_release(self._slot_state(slot), m.EMPTY)
                self.mem.client_runs[slot]["mailbox"] = 0
                connection.mailbox = self._slots[slot] = None

    def _receive(self, poll: select.epoll, connection: Connection, fd: int) -> None:
        if fd == connection.pidfd:
            self._disconnect(poll, connection)
            return
        try:
            data = receive(connection.sock, 256)
            if connection.slot < 0:
                self._offer(connection, hs.read_hello(data))
            elif not connection.joined and data == hs.MAPPED:
                self._admit(connection)
            elif not data or not connection.joined:
                self._disconnect(poll, connection)
        except BlockingIOError:
            return
        except OSError:
            self._disconnect(poll, connection)
            return
        if connection.slot < 0:
            self._disconnect(poll, connection)

    def _offer(self, connection: Connection, name: str | None) -> None:
        """Answer the first message: refuse, or hand out a mailbox."""
        self._free_slots()
        result, detail = self._check_admission(name)
        if result != al.HELLO_OK:
            connection.sock.send(hs.welcome(result, detail=detail), socket.MSG_NOSIGNAL)
            return
        assert name is not None
        connection.mailbox_fd = make_sealed("surffollow-mailbox", al.MAILBOX_BYTES)
        board = self.board.reading_end()
        try:
            connection.name, connection.slot = name, self._slots.index(None)
            self._slots[connection.slot] = connection
            self._number += 1
            connection.number = self._number
            answer = hs.welcome(al.HELLO_OK, connection.slot, connection.number, self.board.epoch)
            socket.send_fds(connection.sock, [answer], [connection.mailbox_fd, board], socket.MSG_NOSIGNAL)
        finally:
            os.close(board)

    def _admit(self, connection: Connection) -> None:
        """The client has its mapping: the mailbox cannot be changed in any other way from now on."""
        seal_for_good(connection.mailbox_fd)
        connection.mailbox = mmap.mmap(
            connection.mailbox_fd, al.MAILBOX_BYTES, mmap.MAP_SHARED, mmap.PROT_READ
        )
        os.close(connection.mailbox_fd)
        connection.mailbox_fd, connection.joined = -1, True
        self._register(connection)
        self._await_joined(connection.slot)
        connection.sock.send(hs.MAPPED, socket.MSG_NOSIGNAL)

    def _check_admission(self, name: str | None) -> tuple[int, int]:
        if name is None:
            return al.HELLO_BAD, 0
        if name not in self.config.clients:
            return al.HELLO_UNKNOWN_CLIENT, 0
        for other in self._slots:
            if other is not None and other.name == name:
                return al.HELLO_TAKEN, other.pid
        return (al.HELLO_OK, 0) if None in self._slots else (al.HELLO_FULL, 0)

    def _register(self, connection: Connection) -> None:
        """Fill in the slot's public entry and hand the mailbox to the loop."""
        mem, entry = self.mem, self.board.entry(connection.slot)
        priority = self.config.clients[connection.name]
        entry["name"], entry["pid"], entry["uid"] = connection.name.encode(), connection.pid, connection.uid
        entry["priority"], entry["attached_ns"] = priority, time.monotonic_ns()
        mem.clients[0]["priority"][connection.slot] = priority
        client_run = mem.client_runs[connection.slot]
        client_run["mailbox"] = np.frombuffer(connection.mailbox, np.uint8).ctypes.data  # type: ignore[arg-type]
        client_run["number"] = entry["number"] = connection.number
        store_release(self._slot_state(connection.slot), m.JOINING)
        self._wake_loop()

    def _await_joined(self, slot: int) -> None:
        """Until the loop has cleared what the slot's last client left: the next round, at once."""
        deadline = time.monotonic() + hs.HELLO_TIMEOUT_S
        while load_acquire(self._slot_state(slot)) == m.JOINING and time.monotonic() < deadline:
            time.sleep(20e-6)

    def release_clients(self, loop: threading.Thread) -> None:
        """Wait until the loop has released all clients; every resource gets its safe command."""
        for slot, connection in enumerate(self._slots):
            if connection is not None and connection.joined and connection.slot >= 0:
                store_release(self._slot_state(slot), m.LEAVING)
        self._wake_loop()
        deadline = time.monotonic() + LAST_ROUND_S
        while time.monotonic() < deadline and loop.is_alive():
            if all(load_acquire(self._slot_state(s)) in (m.EMPTY, m.LEFT) for s in range(al.CLIENTS)):
                break
            time.sleep(0.001)

    def close(self) -> None:
        """End all connections, and those not yet accepted."""
        for connection in self._unique_connections():
            connection.close(self._disposal)
        self._disposal.part_listener(self._listener)
        with contextlib.suppress(OSError):
            self._disposal.look()
