"""Get a slot from the service: the client's side of the exchange on NAME.sock (docs/protocol.md)."""

from __future__ import annotations

import mmap
import os
import socket
import time

from surffollow.client.board import LAYOUT_HASH, Board
from surffollow.errors import BlockError, BusyError, NoPermissionError, NotReadyError
from surffollow.shm import layout_board as lb
from surffollow.shm.checked_open import foreign
from surffollow.shm.sealed import has_sealed_size
from surffollow.shm.unix_socket import new_socket, peer_of, socket_path

_MESSAGE = lb.SlotMessage.struct_of("magic", "name")
_AGAIN_S = 0.002


class SlotGrant:
    """A slot of a service: this process's until it closes the connection or ends.

    Attributes
    ----------
    memory : mmap.mmap        the slot; its size is sealed
    slot, claim : int         its number, and the number of this attachment
    """

    def __init__(self, sock: socket.socket, memory: mmap.mmap, slot: int, claim: int) -> None:
        self._sock, self.memory, self.slot, self.claim = sock, memory, slot, claim
        sock.setblocking(False)  # a look at it never waits

    def is_open(self) -> bool:
        """Whether the service holds its end: it closes it when it ends or takes the slot back."""
        try:
            return self._sock.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) != b""
        except BlockingIOError:
            return True
        except OSError:
            return False

    def close(self) -> None:
        """Give the slot back; another thread that writes into the mapping still keeps it."""
        self._sock.close()


def request_slot(board: Board, label: bytes, timeout_s: float) -> SlotGrant:
    """Ask a board's service for a slot.

    Raises
    ------
    NotReadyError       the service is being replaced, or did not answer in time
    NoPermissionError   not a member of the socket's group, or another user listens there
    BusyError           no slot is free, or this user or process has as many as it may
    BlockError          what listens there is no service of this release
    """
    deadline = time.monotonic() + timeout_s
    sock = new_socket()
    try:
        _connect(sock, board, deadline)
        uid = peer_of(sock).uid
        if uid != board.object.owner:
            raise NoPermissionError(
                f"the process that listens on {socket_path(board.name)} runs as user {uid}: "
                + foreign(board.name, uid, (board.object.owner,))
            )
        return _exchange(sock, board, label, deadline)
    except TimeoutError:
        sock.close()
        raise NotReadyError(
            f"service {board.name!r} did not hand out a slot within {timeout_s:g} s; it may be starting or "
            "standing still (surffollow status)"
        ) from None
    except (BrokenPipeError, ConnectionError):
        sock.close()
        raise NotReadyError(f"service {board.name!r} closed the connection; it is being replaced") from None
    except BaseException:
        sock.close()
        raise


def _connect(sock: socket.socket, board: Board, deadline: float) -> None:
    path = socket_path(board.name)
    while True:
        sock.settimeout(max(0.001, deadline - time.monotonic()))
        try:
            sock.connect(str(path))
            return
        except (FileNotFoundError, ConnectionRefusedError):
            raise NotReadyError(f"nobody listens on {path}; the service ended or is being replaced") from None
        except PermissionError:
            raise NoPermissionError(
                f"no permission to connect to {path}; join its group (ls -l {path}), or only watch: observe()"
            ) from None
        except BlockingIOError:  # many clients come at once
            if time.monotonic() > deadline:
                raise TimeoutError from None
            time.sleep(_AGAIN_S)
        except TimeoutError:
            raise
        except OSError as e:
            raise BlockError(f"cannot connect to {path}: {e}; look at it (ls -l {path})") from None


def _exchange(sock: socket.socket, board: Board, label: bytes, deadline: float) -> SlotGrant:
    _send(sock, board, lb.SLOT_ASK, 0, 0, label)
    offer, fds = _receive(sock, deadline)
    try:
        slot, claim = _check(board, offer, lb.SLOT_OFFER)
        if len(fds) != 1 or not has_sealed_size(fds[0], lb.SLOT_BYTES) or not 0 <= slot < lb.CLIENTS:
            raise BlockError(
                f"service {board.name!r} handed out no sealed memory of {lb.SLOT_BYTES} bytes; use "
                "client and service of one release"
            )
        memory = mmap.mmap(fds[0], lb.SLOT_BYTES)
    finally:
        for fd in fds:
            os.close(fd)
    _send(sock, board, lb.SLOT_MAPPED, slot, claim, label)
    grant, fds = _receive(sock, deadline)
    for fd in fds:
        os.close(fd)
    _check(board, grant, lb.SLOT_GRANT)
    return SlotGrant(sock, memory, slot, claim)


def _send(sock: socket.socket, board: Board, step: int, slot: int, claim: int, label: bytes) -> None:
    fields = (lb.SLOT_MAGIC, LAYOUT_HASH, step, board.epoch, 0, 0, slot, claim, label)
    sock.send(_MESSAGE.pack(*fields), socket.MSG_NOSIGNAL)


def _receive(sock: socket.socket, deadline: float) -> tuple[bytes, list[int]]:
    sock.settimeout(max(0.001, deadline - time.monotonic()))
    data, fds, flags, _ = socket.recv_fds(sock, _MESSAGE.size, 1, socket.MSG_CMSG_CLOEXEC)
    if not data or flags & (socket.MSG_TRUNC | socket.MSG_CTRUNC):
        for fd in fds:
            os.close(fd)
        if flags & socket.MSG_CTRUNC:
            raise BlockError("no descriptor is free for the slot's memory; raise the limit (ulimit -n)")
        raise ConnectionResetError
    return data, list(fds)


def _check(board: Board, data: bytes, step: int) -> tuple[int, int]:
    if len(data) != _MESSAGE.size:
        raise BlockError(f"service {board.name!r} sent {len(data)} bytes, expected {_MESSAGE.size}")
    magic, layout, said, _, result, detail, slot, claim, _ = _MESSAGE.unpack(data)
    if said == lb.SLOT_REFUSE and magic == lb.SLOT_MAGIC:
        text = lb.SLOT_TEXT[result] if 0 < result < len(lb.SLOT_TEXT) else f"result {result}"
        if result == lb.SLOT_OTHER_RUN:
            raise NotReadyError(f"service {board.name!r}: {text}")
        if result in (lb.SLOT_ALL_TAKEN, lb.SLOT_USER_LIMIT, lb.SLOT_PROCESS_LIMIT):
            raise BusyError(f"service {board.name!r}: {text} (limit {detail})")
        raise BlockError(f"service {board.name!r}: {text}")
    if (magic, layout, said) != (lb.SLOT_MAGIC, LAYOUT_HASH, step) or claim == 0:
        raise BlockError(f"service {board.name!r} answered with step {said}, expected {step}; attach again")
    return slot, claim
