"""Pause, resume and abort a running scan: an abstract Unix socket that the same user may talk to, and keys.

One request is one word, the answer one JSON object. The kernel removes the socket with the process.
Any user may connect to an abstract socket: what strangers hold open takes no room of others, and no
descriptor that they pass is closed in this process, whose loop leads the arm (`shm.received_descriptors`).
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import struct
import sys
from collections.abc import Iterator
from typing import Any

from surffollow.config.trusted_users import own_user
from surffollow.errors import BusyError, NotRunningError, RefusedError, ServiceError
from surffollow.shm.readable import wait_readable
from surffollow.shm.received_descriptors import Disposal, receive, refuse_rights

WORDS = ("pause", "resume", "abort", "status")
KEYS = {"p": "pause", "r": "resume", "a": "abort"}
LONGEST, ANSWER_S = 4096, 5.0
MOST_SILENT, ACCEPTED_AT_ONCE, BACKLOG = 8, 16, 64
_CREDENTIALS = struct.Struct("3i")


def _address(name: str) -> str:
    return f"\0surffollow.scan.{name}"


def _user(connection: socket.socket) -> int:
    return int(_CREDENTIALS.unpack(connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))[1])


def _holder_text(name: str) -> str:
    """Text on the holder of the address of a service's scan, with the remedy."""
    holder = "a process that takes no connection"
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        connection.settimeout(ANSWER_S)  # a full backlog would hold it for ever
        with contextlib.suppress(OSError):
            connection.connect(_address(name))
            if _user(connection) in (own_user(), 0):
                return f"another scan of service '{name}' runs; end it first: surffollow scan abort {name}"
            holder = f"user {_user(connection)}"
    return (
        f"{holder} holds the control socket of scans of service '{name}' (@surffollow.scan.{name}), so that "
        f"no scan can be controlled. It is free when that process ends; root finds it with: "
        f"ss -xap | grep -F @surffollow.scan.{name}"
    )


class ControlServer:
    """The run's end of the socket; `words` never waits.

    Parameters
    ----------
    name : str     of the service

    Raises
    ------
    BusyError
        another scan of this service runs, or another user's process holds its address
    """

    def __init__(self, name: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._socket.bind(_address(name))
        except OSError as e:
            self._socket.close()
            raise BusyError(_holder_text(name)) from e
        refuse_rights(self._socket)
        self._socket.listen(BACKLOG)
        self._socket.setblocking(False)
        self._open: dict[socket.socket, int] = {}  # and the user at the other end, the oldest first
        self._disposal = Disposal()

    def words(self, status: dict[str, Any]) -> list[str]:
        """Requests that came since the last call, answered with `status`; wrong ones are refused."""
        self._accept()
        received: list[str] = []
        for connection in list(self._open):
            try:
                word = receive(connection, 64).decode("ascii", "replace")
            except BlockingIOError:
                continue
            except OSError:
                word = ""
            if word:
                answer = self._answer(connection, word, status, received)
                with contextlib.suppress(OSError):
                    connection.send(json.dumps(answer).encode())
            self._end(connection)
        self._end_silent()
        with contextlib.suppress(OSError):  # no process to be had: tried again
            self._disposal.look()
        return received

    def _accept(self) -> None:
        """Take new connections, at most so many that a look takes a millisecond or two."""
        with contextlib.suppress(BlockingIOError):
            for _ in range(0 if self._disposal.full else ACCEPTED_AT_ONCE):
                connection, _ = self._socket.accept()
                connection.setblocking(False)
                self._open[connection] = _user(connection)

    def _end_silent(self) -> None:
        """End the oldest of more than `MOST_SILENT` silent connections: of strangers, and of others."""
        trusted = (own_user(), 0)
        own = [c for c, user in self._open.items() if user in trusted]
        strange = [c for c, user in self._open.items() if user not in trusted]
        for silent in (own, strange):
            for connection in silent[:-MOST_SILENT]:
                self._end(connection)

    def _end(self, connection: socket.socket) -> None:
        del self._open[connection]
        self._disposal.part(connection)

    def _answer(
        self, connection: socket.socket, word: str, status: dict[str, Any], received: list[str]
    ) -> dict[str, Any]:
        user = self._open[connection]
        if user not in (own_user(), 0):
            return {"error": f"user {user} may not control a scan of user {own_user()}"}
        if word not in WORDS:
            return {"error": f"unknown word '{word}'; expected one of {', '.join(WORDS)}"}
        if word != "status":
            received.append(word)
        return status

    def close(self) -> None:
        """Give the name back."""
        for connection in list(self._open):
            self._end(connection)
        self._disposal.part_listener(self._socket)


def ask(name: str, word: str) -> dict[str, Any]:
    """Send one word to the running scan of a service.

    Returns
    -------
    dict     the scan's status before the word had effect

    Raises
    ------
    NotRunningError
        no scan of that service runs
    RefusedError
        the scan belongs to another user
    ServiceError
        it does not answer
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        for option in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):  # settimeout does not wait for a full backlog
            connection.setsockopt(socket.SOL_SOCKET, option, struct.pack("ll", int(ANSWER_S), 0))
        try:
            connection.connect(_address(name))
        except BlockingIOError as e:
            raise ServiceError(
                f"the scan of service '{name}' took no connection within {ANSWER_S:g} s"
            ) from e
        except OSError as e:
            raise NotRunningError(
                f"no scan of service '{name}' runs; start one: surffollow scan run PATH --name {name}"
            ) from e
        if _user(connection) not in (own_user(), 0):
            raise RefusedError(f"the scan of service '{name}' belongs to user {_user(connection)}", 0)
        try:
            connection.send(word.encode("ascii"))
            answer: dict[str, Any] = json.loads(connection.recv(LONGEST))
        except (OSError, ValueError) as e:
            raise ServiceError(f"the scan of service '{name}' gave no answer within {ANSWER_S:g} s") from e
    if "error" in answer:
        raise RefusedError(str(answer["error"]), 0)
    return answer


@contextlib.contextmanager
def keys() -> Iterator[Any]:
    """Single keys of a terminal as words, without waiting; no terminal: never any."""
    if not sys.stdin.isatty():
        yield list
        return
    import termios
    import tty

    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)

    def pressed() -> list[str]:
        received = []
        while wait_readable(terminal, 0.0):
            data = os.read(terminal, 64)
            if not data:
                break
            received += [KEYS[k] for k in data.decode("ascii", "replace").lower() if k in KEYS]
        return received

    tty.setcbreak(terminal)
    try:
        yield pressed
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)
