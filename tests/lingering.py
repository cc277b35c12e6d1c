"""A socket whose end takes as long as its maker likes, and an old kernel's service to send it to."""

from __future__ import annotations

import contextlib
import socket
import struct
import sys
from collections.abc import Iterator

from running_service import Service
from surffollow.shm.unix_socket import new_socket, socket_path

LINGER_S = 300
# a Linux before 6.16 cannot refuse descriptors
OLD_KERNEL = """
import surffollow.shm.unix_socket as unix_socket
unix_socket.refuse_rights = lambda sock: False
from surffollow.cli.main import main
main()
"""


class OldKernelService(Service):
    """A service that takes descriptors from clients, as on a kernel that cannot refuse them."""

    def command(self, verb: str, *words: str) -> list[str]:
        return [sys.executable, "-c", OLD_KERNEL, verb, "--name", self.name, *words]


@contextlib.contextmanager
def lingering() -> Iterator[socket.socket]:
    """A TCP socket with unread data: closing its last descriptor takes `LINGER_S`."""
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    listener.bind(("127.0.0.1", 0))
    listener.listen(1)
    full = socket.socket()
    full.connect(listener.getsockname())
    reader, _ = listener.accept()
    full.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while True:
            full.send(b"x" * 65536)
    full.setblocking(True)
    full.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, LINGER_S))
    try:
        yield full
    finally:
        reader.close()  # unread data: a reset, and no process waits any more
        listener.close()
        full.close()


def hand_over(name: str, fd: int, first: list[bytes], message: bytes) -> socket.socket:
    """Connect, send `first`, then a message with the descriptor; the connection."""
    sock = new_socket()
    sock.setblocking(False)
    sock.connect(str(socket_path(name)))
    for data in first:
        sock.send(data)
    socket.send_fds(sock, [message], [fd])
    return sock
