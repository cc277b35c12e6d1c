"""Sockets of clients that may carry unrequested descriptors, which are never closed in this process.

Every connected process can pass descriptors (SCM_RIGHTS), and the thread that drops the last reference to one
waits for its end: for as long as the sender likes if it is a TCP socket that lingers, without limit if it
is a file of a server that does not answer. `recv` of such a message and `close` of a socket that holds one
both drop it.

From Linux 6.16 on the kernel refuses such messages to their sender (`refuse_rights`). Before that, `receive`
looks at a message without taking it and raises when it carries descriptors, and `Disposal` lets a child
process of its own hold the connection when it is closed: an exiting process does not linger.
"""

from __future__ import annotations

import contextlib
import os
import socket
import sys
import time

_SO_PASSRIGHTS = 83  # Linux 6.16; without a name in Python
_CREDENTIALS = socket.CMSG_SPACE(12)
MESSAGES = 1024  # that a queue may hold (net.unix.max_dgram_qlen); a longer one goes to a child
EVERY_S, CHILDREN = 1.0, 4
KEPT = 64  # connections that wait for a child; further ones are not accepted
_HOLD = "import sys; sys.stdin.buffer.read()"  # until our own copies are closed


class RightsSentError(ConnectionError):
    """A client sent descriptors: the connection must go to `Disposal.part`, and nothing is read from it."""


def refuse_rights(sock: socket.socket) -> bool:
    """Let the kernel refuse descriptors to this socket and to those that it accepts; False: it cannot."""
    return _pass_rights(sock, 0)


def accept_rights(sock: socket.socket) -> None:
    """Take descriptors from the other end from now on: it is trusted."""
    _pass_rights(sock, 1)


def _pass_rights(sock: socket.socket, value: int) -> bool:
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_PASSRIGHTS, value)
    except OSError:
        return False
    return True


def receive(sock: socket.socket, size: int) -> bytes:
    """One message of a client, cut at `size` bytes; empty when the other end is closed. Never waits.

    Raises
    ------
    BlockingIOError   there is none yet
    RightsSentError   it carries descriptors; it stays where it is
    """
    _, _, flags, _ = sock.recvmsg(size, 0, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    if flags & socket.MSG_CTRUNC:  # without room for any, none was installed
        raise RightsSentError("a client sent descriptors with its message; none were requested")
    return sock.recv(size, socket.MSG_DONTWAIT)


def _is_empty(sock: socket.socket) -> bool:
    """Take out what carries no descriptors; whether nothing is left. Both directions are shut down."""
    # credentials come with every message, so that an empty one is not taken for the end
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
    for _ in range(MESSAGES):
        _, found, flags, _ = sock.recvmsg(1, _CREDENTIALS, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        if flags & socket.MSG_CTRUNC:
            return False
        if not found:
            return True
        sock.recvmsg(1, _CREDENTIALS, socket.MSG_DONTWAIT)
    return False


class Disposal:
    """Ends clients' connections in a time that no client has a say in."""

    def __init__(self) -> None:
        self._kept: list[int] = []
        self._children: list[int] = []
        self._next_s = 0.0

    @property
    def waiting(self) -> bool:
        """Whether `look` has something to do soon."""
        return bool(self._kept or self._children)

    @property
    def full(self) -> bool:
        """Whether no further connection should be accepted now."""
        return len(self._kept) >= KEPT

    def part(self, sock: socket.socket) -> None:
        """End a connection: the other end sees it at once, nothing that it sent is closed in this process."""
        empty = False
        with contextlib.suppress(OSError):
            sock.shutdown(socket.SHUT_RDWR)  # ENOTCONN: the other end is closed, and sends no more either
        with contextlib.suppress(OSError):
            empty = _is_empty(sock)
        if empty:
            sock.close()
        elif sock.fileno() >= 0:
            self._kept.append(sock.detach())

    def part_listener(self, listener: socket.socket) -> None:
        """End a listening socket with the connections in its queue."""
        with contextlib.suppress(OSError):
            listener.shutdown(socket.SHUT_RDWR)  # from here on no connection is made
            listener.setblocking(False)
            while True:
                self.part(listener.accept()[0])
        listener.close()

    def look(self) -> None:
        """Let a child end what is kept, at most once a second; call it again and again.

        Raises
        ------
        OSError   no process or no descriptors; what is kept stays kept, and a later call tries again
        """
        self._children = [pid for pid in self._children if not _has_ended(pid)]
        now = time.monotonic()
        if not self._kept or now < self._next_s or len(self._children) >= CHILDREN:
            return
        self._next_s = now + EVERY_S
        reading, writing = os.pipe2(os.O_CLOEXEC)
        try:
            for fd in self._kept:
                os.set_inheritable(fd, True)
            self._children.append(_spawn_holder(reading))
            kept, self._kept = self._kept, []
            for fd in kept:
                os.close(fd)  # the child has it still
        finally:
            os.close(reading)
            os.close(writing)  # the child ends now


def _spawn_holder(stdin: int) -> int:
    null = [(os.POSIX_SPAWN_OPEN, fd, os.devnull, os.O_WRONLY, 0) for fd in (1, 2)]
    return os.posix_spawn(
        sys.executable,
        [sys.executable, "-I", "-S", "-c", _HOLD],
        {},
        file_actions=[(os.POSIX_SPAWN_DUP2, stdin, 0), *null],
    )


def _has_ended(pid: int) -> bool:
    try:
        return os.waitpid(pid, os.WNOHANG)[0] == pid
    except ChildProcessError:
        return True
