"""Objects of other users under a service's names."""

from __future__ import annotations

import os
import socket
import stat
from collections.abc import Callable
from pathlib import Path

from second_user import OtherUser
from surffollow.shm.dtypes import zeros
from surffollow.shm.latch_shape import HEAD_BYTES, SLOTS, stride
from surffollow.shm.layout_follow import VALID, Output


def put(path: Path, kind: str) -> None:
    """Make something that is no plain file."""
    if kind == "fifo":
        os.mkfifo(path, 0o666)
    elif kind == "directory":
        path.mkdir()
    elif kind == "link":
        path.symlink_to("/dev/zero")
    elif kind == "socket":
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        sock.bind(str(path))
        sock.close()
    else:
        os.mknod(path, 0o666 | stat.S_IFCHR, os.makedev(1, 5))


def remove(path: Path) -> None:
    """Remove it, of any kind."""
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    else:
        path.unlink(missing_ok=True)


def published(path: Path, content: bytes) -> Callable[[OtherUser], str]:
    """Work of another user, who puts this under a name for all to read and says "there"."""

    def impersonate(child: OtherUser) -> str:
        path.write_bytes(content)
        path.chmod(0o666)
        child.say("there")
        return str(child.receive())

    return impersonate


def forged_board(content: bytes, offset: int) -> bytes:
    """A service's board with a fresh and valid demand that drives the tool half a metre down."""
    import time

    output = zeros(Output)
    o = output[0]
    o["t_ns"], o["status"], o["epoch"] = time.monotonic_ns(), VALID, 1
    o["demand"] = (0.0, 0.0, -0.5, 0.0, 0.0, 0.0)
    data, step = bytearray(content), stride(Output.SIZE)
    for k in range(SLOTS):
        at = offset + HEAD_BYTES + k * step
        data[at : at + Output.SIZE] = output.tobytes()
    return bytes(data)
