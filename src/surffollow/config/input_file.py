"""Read input files; nothing is waited for, and nothing without an end is read.

Wrong contents are a fault (exit code 1); wrong usage (2) is of the command line alone.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path

from surffollow.errors import FaultError, InputFileError, UsageError

_KINDS = (
    (stat.S_ISDIR, "a folder", "give a file"),
    (stat.S_ISFIFO, "a pipe", "write what comes out of it to a file first"),
    (stat.S_ISSOCK, "a socket", "give a file"),
    (stat.S_ISCHR, "a device", "give a file"),
    (stat.S_ISBLK, "a device", "give a file"),
)


def check_plain_file(path: str | os.PathLike[str], error: type[FaultError] = InputFileError) -> None:
    """Refuse a folder, and pipes, sockets and devices, on which a reader may wait for ever.

    A name that is not there is left to who opens it.

    Parameters
    ----------
    path : path
        the file to be read
    error : subclass of FaultError
        what is raised

    Raises
    ------
    FaultError
        `error`; it names what stands there
    """
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return
    for test, kind, remedy in _KINDS:
        if test(mode):
            raise error(f"{path} is {kind}, no plain file; {remedy}")


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


@contextlib.contextmanager
def contents_are_read() -> Iterator[None]:
    """Errors of wrong usage within are about a file's content: a command ends with the code of a fault.

    Also a decorator of functions that read a file. The classes of errors stay, for programs.
    """
    try:
        yield
    except UsageError as error:
        error.exit_code = FaultError.exit_code
        raise
