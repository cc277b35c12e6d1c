"""Read an input file of a command without waiting for a pipe that has no writer."""

from __future__ import annotations

import contextlib
import os
import stat
from pathlib import Path


def read_input(path: str | Path, most: int = -1, *, device: bool = True) -> bytes:
    """Content of a file, or what comes out of a pipe.

    Parameters
    ----------
    path : path
        the file
    most : int
        bytes to be read at most; -1: all
    device : bool
        whether a character device may be read; its bytes may have no end

    Returns
    -------
    bytes
        the content

    Raises
    ------
    OSError
        it cannot be read, it is a device and may not be one, or it is a pipe without a writer
    """
    # a named pipe without a writer would be waited for: opened so it is empty
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        kind, begins = os.fstat(file.fileno()).st_mode, b""
        if stat.S_ISCHR(kind) and not device:
            raise OSError(None, "it is a device")
        if stat.S_ISFIFO(kind):
            with contextlib.suppress(BlockingIOError):  # its writer has written nothing yet
                begins = os.read(file.fileno(), 1)
                if not begins:
                    raise OSError(None, "it is a pipe out of which nothing comes")
        os.set_blocking(file.fileno(), True)
        return begins + file.read(most if most < 0 else most - len(begins))
