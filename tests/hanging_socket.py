"""A socket in the place of a service's that takes clients and gives them nothing."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path

from surffollow.shm.unix_socket import listen, socket_path

MANNERS = ["accepts nobody", "takes connections and says nothing", "its queue is full"]


@contextlib.contextmanager
def hanging(name: str, manner: str) -> Iterator[None]:
    """Put a socket that hangs in the place of the service's."""
    path = socket_path(name)
    aside = Path(f"{path}.aside")
    path.rename(aside)
    listener = listen(path, 0o600, -1, 0 if manner == "its queue is full" else 64)
    others = []
    if manner == "its queue is full":
        for _ in range(2):
            other = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            other.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                other.connect(str(path))
            others.append(other)
    try:
        yield
    finally:
        if manner == "takes connections and says nothing":
            with contextlib.suppress(BlockingIOError):
                while True:
                    others.append(listener.accept()[0])
        for other in others:
            other.close()
        path.unlink()
        listener.close()
        aside.rename(path)
