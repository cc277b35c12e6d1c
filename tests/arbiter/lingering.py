"""A descriptor that takes a minute to close, for tests."""

from __future__ import annotations

import contextlib
import socket
import struct


def lingering():
    """A TCP connection whose last close waits for 60 s."""
    with socket.socket() as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        server.bind(("127.0.0.1", 0))
        server.listen(1)
        out = socket.socket()
        out.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        out.connect(server.getsockname())
        other, _ = server.accept()
    out.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while True:
            out.send(bytes(65536))
    out.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 60))
    return out, other
