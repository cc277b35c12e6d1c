"""Meet over a Unix socket: a client gets its mailbox, and its connection is what shows that it lives.

The socket's name is abstract: the kernel takes it back with the server's process, and it is what makes the
server the only one of its name. SO_PEERCRED says who the other side is. A mailbox is a memory file whose
size is sealed, and once the client has its mapping nothing but that mapping can change it.

Any user may take an abstract name that is free. A client therefore asks the kernel who listens, and says
nothing to a user whom it does not trust (`config.trusted_users`).
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Collection

from surffollow.arbiter import layout as al
from surffollow.client.latch_reader import unpack_schema
from surffollow.errors import (
    AlreadyRunningError,
    BlockError,
    NoPermissionError,
    NotRunningError,
    RefusedError,
    RequestTimeoutError,
)
from surffollow.shm.received_descriptors import accept_rights, refuse_rights
from surffollow.shm.sealed import has_sealed_size
from surffollow.shm.unix_socket import new_socket, peer_of

HELLO_TIMEOUT_S = 1.0
BACKLOG = 1024
MAPPED = b"mapped"
_HELLO, _WELCOME = al.Hello.struct_of("magic", "name"), al.Welcome.struct_of("magic", "detail")


def address(name: str) -> str:
    """Abstract address of an arbiter's socket."""
    return f"\0surffollow.{name}.arbiter"


def listen(name: str) -> socket.socket:
    """Become the arbiter of this name.

    Raises
    ------
    AlreadyRunningError
        a live process is
    """
    sock = new_socket()
    refuse_rights(sock)  # inherited by connections
    try:
        sock.bind(address(name))
    except OSError:
        sock.close()
        raise AlreadyRunningError(
            f"an arbiter {name!r} runs already{_who_listens(name)}; end it, or start this one under another "
            "name (--name)"
        ) from None
    sock.listen(BACKLOG)
    sock.setblocking(False)
    return sock


def _who_listens(name: str) -> str:
    """The process that bears the name, for an error; empty when it does not let itself be asked."""
    sock = new_socket()
    try:
        sock.setblocking(False)
        sock.connect(address(name))
        peer = peer_of(sock)
    except OSError:
        return ""
    finally:
        sock.close()
    return f" (process {peer.pid} of user {peer.uid}, this one is of user {os.geteuid()})"


def _owner_of(sock: socket.socket, name: str, owners: Collection[int]) -> int:
    """The user of the server at the other end; raises NoPermissionError when it is none of `owners`."""
    peer = peer_of(sock)
    if owners and peer.uid not in owners:
        expected = " or ".join(str(u) for u in sorted(owners))
        raise NoPermissionError(
            f"arbiter {name!r} is process {peer.pid} of user {peer.uid}, expected user {expected}: another "
            f"process may have taken its name; look at it (ps -p {peer.pid}), or name the arbiter's user "
            "(owner=, SURFFOLLOW_OWNER)"
        )
    return peer.uid


def read_hello(data: bytes) -> str | None:
    """The name in a client's first message; None when it is no such message."""
    if len(data) != al.Hello.SIZE:
        return None
    magic, layout, raw = _HELLO.unpack(data)
    if magic != al.HELLO_MAGIC or layout != al.layout_hash():
        return None
    return str(raw.split(b"\0", 1)[0].decode("utf-8", "replace"))


def welcome(result: int, slot: int = -1, number: int = 0, epoch: int = 0, detail: int = 0) -> bytes:
    """The server's answer.

    Parameters
    ----------
    result : int               one of layout.HELLO_…
    slot, number, epoch : int  of the client's slot, its number, and the server's epoch
    detail : int               explains a refusal
    """
    return _WELCOME.pack(al.HELLO_MAGIC, result, slot, number, epoch, detail)


def confirm_mapping(sock: socket.socket, name: str) -> None:
    """Report to the server that the mailbox is mapped, and wait until it looks into it.

    Raises
    ------
    NotRunningError
        it ended meanwhile
    RequestTimeoutError
        it says nothing
    """
    try:
        sock.send(MAPPED)
        received = sock.recv(len(MAPPED)) == MAPPED
    except TimeoutError:
        raise RequestTimeoutError(f"arbiter {name!r} did not finish the attachment; attach again") from None
    except OSError:
        received = False
    if not received:
        raise NotRunningError(f"arbiter {name!r} ended while this client attached; attach again")


class MailboxGrant:
    """Slot of a client, from a server of user `owner`; the connection stays open while it lives."""

    def __init__(self, sock: socket.socket, answer: dict[str, int], fds: list[int], owner: int) -> None:
        self.sock, self.fds, self.owner = sock, fds, owner
        self.slot, self.number, self.epoch = answer["slot"], answer["number"], answer["epoch"]


def request_slot(name: str, client: str, timeout_s: float, owners: Collection[int] = ()) -> MailboxGrant:
    """Connect to an arbiter of one of the users `owners` (empty: any user) and ask for a slot.

    Parameters
    ----------
    name : str                  of the arbiter
    client : str                name of the client, of which 47 bytes are sent
    timeout_s : float [s]       for each step of the exchange
    owners : collection of int  numbers of users

    Raises
    ------
    NotRunningError
        no server listens
    NoPermissionError
        another user listens
    BlockError
        what it hands out is no mailbox
    RefusedError
        the server says no; `code` is one of layout.HELLO_…
    RequestTimeoutError
        it says nothing
    """
    sock = new_socket()
    fds: list[int] = []
    owner = -1
    try:
        sock.settimeout(max(timeout_s, 0.001))
        try:
            refuse_rights(sock)  # until it is known who listens
            sock.connect(address(name))
            owner = _owner_of(sock, name, owners)
            accept_rights(sock)
            with contextlib.suppress(ConnectionError):  # it may have refused already
                sock.send(_HELLO.pack(al.HELLO_MAGIC, al.layout_hash(), client.encode()[:47]))
            data, fds = _receive_answer(sock)
        except NoPermissionError:  # an OSError, too
            raise
        except TimeoutError:
            raise RequestTimeoutError(f"arbiter {name!r} did not answer in {timeout_s:g} s") from None
        except OSError:
            data = b""
        if len(data) != al.Welcome.SIZE:
            raise NotRunningError(
                f"no arbiter {name!r} runs here; start it: surffollow arbiter start CONFIG.toml"
            )
        answer = unpack_schema(al.Welcome, data)
        if answer["magic"] != al.HELLO_MAGIC or answer["result"] != al.HELLO_OK or len(fds) != 2:
            _refuse(name, client, answer)
        for fd in fds:
            os.set_inheritable(fd, False)
        if not has_sealed_size(fds[0], al.MAILBOX_BYTES):
            raise BlockError(f"arbiter {name!r} handed out no sealed mailbox of {al.MAILBOX_BYTES} bytes")
        return MailboxGrant(sock, answer, fds, owner)
    except BaseException:
        for fd in fds:
            os.close(fd)
        sock.close()
        raise


def _receive_answer(sock: socket.socket) -> tuple[bytes, list[int]]:
    """The server's answer, and what came with it."""
    try:
        data, fds, _, _ = socket.recv_fds(sock, al.Welcome.SIZE, 2)
    except ConnectionResetError:  # reported once; data sent before the other end closed come next
        data, fds, _, _ = socket.recv_fds(sock, al.Welcome.SIZE, 2)
    return data, list(fds)


def _refuse(name: str, client: str, answer: dict[str, int]) -> None:
    code = answer["result"]
    text = al.HELLO_TEXT[code] if 0 < code < len(al.HELLO_TEXT) else "the answer makes no sense"
    by = f" (process {answer['detail']})" if code == al.HELLO_TAKEN and answer["detail"] else ""
    raise RefusedError(f"arbiter {name!r} refused client {client!r}: {text}{by}", code)
