"""Wait for a descriptor of any number: `select` ends in an error from number 1024 on."""

from __future__ import annotations

import math
import select


def wait_readable(fd: int, timeout_s: float) -> bool:
    """Whether something can be read, or the other side has gone, within so many seconds."""
    return _poll(fd, select.POLLIN, timeout_s)


def wait_writable(fd: int, timeout_s: float) -> bool:
    """Whether something can be written, or nothing ever again, within so many seconds."""
    return _poll(fd, select.POLLOUT, timeout_s)


def _poll(fd: int, event: int, timeout_s: float) -> bool:
    look = select.poll()
    look.register(fd, event)
    return bool(look.poll(math.ceil(max(0.0, timeout_s) * 1e3)))
