"""Unix sockets with names in /dev/shm: who is at the other end, from the kernel."""

from __future__ import annotations

import os
import socket
import struct
from pathlib import Path
from typing import NamedTuple

from surffollow.shm.objects import SHM_ROOT
from surffollow.shm.received_descriptors import refuse_rights

_CREDENTIALS = struct.Struct("3i")
_SO_PEERPIDFD = 77  # Linux 6.5; without a name in Python


class Peer(NamedTuple):
    """The process that connected or listens."""

    pid: int
    uid: int
    gid: int


def socket_path(name: str) -> Path:
    """Where the service of that name hands out slots."""
    return SHM_ROOT / f"{name}.sock"


def new_socket() -> socket.socket:
    """A socket of the kind that both sides use: connected, with whole messages."""
    return socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)


def peer_of(sock: socket.socket) -> Peer:
    """Process at the other end, from the kernel (SO_PEERCRED), not from its messages.

    The pid is -1 where this pid namespace has no number for the process.
    """
    pid, uid, gid = _CREDENTIALS.unpack(
        sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    )
    return Peer(pid or -1, uid, gid)


def peer_pidfd(sock: socket.socket, pid: int) -> int:
    """A descriptor that becomes readable when the process at the other end ends; -1: none is to be had."""
    try:
        got = sock.getsockopt(socket.SOL_SOCKET, _SO_PEERPIDFD, 4)
        return int.from_bytes(got, "little")
    except OSError:
        pass
    try:
        return os.pidfd_open(pid) if pid > 0 else -1
    except OSError:
        return -1


def listen(path: Path, mode: int, group: int, backlog: int) -> socket.socket:
    """Listen under an unused name; no process can connect before the mode is set.

    Parameters
    ----------
    path : Path    of the socket
    mode : int     permission bits
    group : int    number of the group; -1: that of this process
    backlog : int  connections that may wait

    Raises
    ------
    OSError   the name is taken, the group is not ours, …
    """
    sock = new_socket()
    try:
        refuse_rights(sock)  # the sockets that it accepts inherit it
        before = os.umask(0o777)
        try:
            sock.bind(str(path))
        finally:
            os.umask(before)
        try:
            if group >= 0:
                os.chown(path, -1, group, follow_symlinks=False)
            os.chmod(path, mode)  # the name is ours: /dev/shm is sticky
            sock.listen(backlog)
        except BaseException:
            os.unlink(path)
            raise
        sock.setblocking(False)
    except BaseException:
        sock.close()
        raise
    return sock
