"""Get a slot from the service: the client's side of the exchange on NAME.sock.

The steps are those of docs/reference/protocol.md, "Getting a slot".
"""

from __future__ import annotations

import math
import mmap
import os
import socket
import time

from surffollow.client.board import Board
from surffollow.client.start_wait import LAYOUT_HASH
from surffollow.errors import BlockError, BusyError, NoPermissionError, NotReadyError
from surffollow.shm import layout_board as lb
from surffollow.shm import layout_slot as ls
from surffollow.shm.checked_open import foreign
from surffollow.shm.readable import wait_readable
from surffollow.shm.received_descriptors import accept_rights, refuse_rights
from surffollow.shm.sealed import has_sealed_size
from surffollow.shm.unix_socket import new_socket, peer_of, socket_path

_MESSAGE = ls.SlotMessage.struct_of("magic", "name")
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


class SlotRequest:
    """An exchange under way, in steps that never wait: a control loop goes through it in several calls.

    Parameters
    ----------
    board : Board
    label : bytes        how the service's status names the client
    timeout_s : float    for the whole of it
    """

    def __init__(self, board: Board, label: bytes, timeout_s: float) -> None:
        self.board, self._label, self._timeout_s = board, label, timeout_s
        self._deadline = time.monotonic() + timeout_s
        self._memory: mmap.mmap | None = None
        self._connected, self._slot, self._claim = False, -1, 0
        self.is_deserted = False  # no process listens on the socket
        self._sock = new_socket()
        self._sock.setblocking(False)
        refuse_rights(self._sock)  # until it is known who listens

    def step(self) -> SlotGrant | None:
        """Go as far as it goes without waiting; None: not there yet, call it again.

        Raises
        ------
        NotReadyError       the service is being replaced, or did not answer in time
        NoPermissionError   not a member of the socket's group, or another user listens there
        BusyError           no slot is free, or this user or process has as many as it may
        BlockError          what listens there is no service of this release
        """
        try:
            return self._step()
        except (BrokenPipeError, ConnectionError):
            self.close()
            raise NotReadyError(
                f"service {self.board.name!r} closed the connection; it is being replaced"
            ) from None
        except BaseException:
            self.close()
            raise

    def _step(self) -> SlotGrant | None:
        if not self._connected:
            try:
                self._connected = _connect(self._sock, self.board)
            except NotReadyError:
                self.is_deserted = True
                raise
            if self._connected:
                _send(self._sock, self.board, ls.SLOT_ASK, 0, 0, self._label)
        if self._connected and self._memory is None and (offer := _receive(self._sock)) is not None:
            self._map(*offer)
            _send(self._sock, self.board, ls.SLOT_MAPPED, self._slot, self._claim, self._label)
        if self._memory is not None and (grant := _receive(self._sock)) is not None:
            for fd in grant[1]:
                os.close(fd)
            _check(self.board, grant[0], ls.SLOT_GRANT)
            return SlotGrant(self._sock, self._memory, self._slot, self._claim)
        if time.monotonic() > self._deadline:
            raise NotReadyError(
                f"service {self.board.name!r} did not hand out a slot within {self._timeout_s:g} s; it may "
                "be starting or standing still (surffollow status)"
            )
        return None

    def _map(self, offer: bytes, fds: list[int]) -> None:
        try:
            self._slot, self._claim = _check(self.board, offer, ls.SLOT_OFFER)
            sealed = len(fds) == 1 and has_sealed_size(fds[0], ls.SLOT_BYTES)
            if not sealed or not 0 <= self._slot < lb.CLIENTS:
                raise BlockError(
                    f"service {self.board.name!r} handed out no sealed memory of {ls.SLOT_BYTES} bytes; use "
                    "client and service of one release"
                )
            self._memory = mmap.mmap(fds[0], ls.SLOT_BYTES)
        finally:
            for fd in fds:
                os.close(fd)

    def wait(self, until_s: float = math.inf) -> None:
        """Until there may be something for the next step; not in a control loop."""
        left = max(0.0, min(until_s, self._deadline) - time.monotonic())
        if self._connected:
            wait_readable(self._sock.fileno(), left)
        else:
            time.sleep(min(left, _AGAIN_S))

    def close(self) -> None:
        """Give it up."""
        self._sock.close()


def request_slot(board: Board, label: bytes, timeout_s: float) -> SlotGrant:
    """Ask a board's service for a slot and wait for it; raises as `SlotRequest.step` does."""
    request = SlotRequest(board, label, timeout_s)
    while (grant := request.step()) is None:
        request.wait()
    return grant


def _connect(sock: socket.socket, board: Board) -> bool:
    """Connect and see who listens; False: many clients come at once, try again."""
    path = socket_path(board.name)
    try:
        sock.connect(str(path))
    except (FileNotFoundError, ConnectionRefusedError):
        raise NotReadyError(f"no service listens on {path}; the service ended or is being replaced") from None
    except PermissionError:
        raise NoPermissionError(
            f"no permission to connect to {path}; join its group (ls -l {path}), or only watch: observe()"
        ) from None
    except BlockingIOError:
        return False
    except OSError as e:
        raise BlockError(f"cannot connect to {path}: {e}; look at it (ls -l {path})") from None
    uid = peer_of(sock).uid
    if uid != board.object.owner:
        raise NoPermissionError(
            f"the process that listens on {path} runs as user {uid}: "
            + foreign(board.name, uid, (board.object.owner,))
        )
    accept_rights(sock)
    return True


def _send(sock: socket.socket, board: Board, step: int, slot: int, claim: int, label: bytes) -> None:
    fields = (ls.SLOT_MAGIC, LAYOUT_HASH, step, board.epoch, 0, 0, slot, claim, label)
    sock.send(_MESSAGE.pack(*fields), socket.MSG_NOSIGNAL | socket.MSG_DONTWAIT)


def _receive(sock: socket.socket) -> tuple[bytes, list[int]] | None:
    try:
        data, fds, flags, _ = socket.recv_fds(
            sock, _MESSAGE.size, 1, socket.MSG_CMSG_CLOEXEC | socket.MSG_DONTWAIT
        )
    except BlockingIOError:
        return None
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
    if said == ls.SLOT_REFUSE and magic == ls.SLOT_MAGIC:
        text = ls.SLOT_TEXT[result] if 0 < result < len(ls.SLOT_TEXT) else f"result {result}"
        if result == ls.SLOT_OTHER_RUN:
            raise NotReadyError(f"service {board.name!r}: {text}")
        if result in (ls.SLOT_ALL_TAKEN, ls.SLOT_USER_LIMIT, ls.SLOT_PROCESS_LIMIT):
            raise BusyError(f"service {board.name!r}: {text} (limit {detail})")
        raise BlockError(f"service {board.name!r}: {text}")
    if (magic, layout, said) != (ls.SLOT_MAGIC, LAYOUT_HASH, step) or claim == 0:
        raise BlockError(f"service {board.name!r} answered with step {said}, expected {step}; attach again")
    return slot, claim
