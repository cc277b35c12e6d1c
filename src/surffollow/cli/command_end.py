"""How a command ends early: the text, the JSON object and the exit code of an error or a signal."""

from __future__ import annotations

import errno
import os
import signal
import sys
from typing import NoReturn

import click

from surffollow.errors import FaultError, SurffollowError, UsageError
from surffollow.extras import missing_library
from surffollow.shm.ending_signals import Terminated

# a disk, or a share of it, that is full or gone
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)

NO_MEMORY = (
    "the limits of this process leave no memory or no thread: see 'ulimit -v' and 'ulimit -u'; a service "
    "needs 1 GB of address space"
)

OUR_FAULT = "this is a fault of surffollow, please report it"


def lacks_memory(error: Exception) -> bool:
    """Whether the limits of this process are the cause: no memory, no thread, no room for numba's library."""
    text = str(error)
    if isinstance(error, OSError):
        return error.errno is None and "libllvmlite" in text
    return (
        isinstance(error, MemoryError) or "start new thread" in text or "thread before it is started" in text
    )


def ending(end: KeyboardInterrupt | click.Abort | Terminated) -> tuple[str, int]:
    """Why a command ended early, and its exit code: 128 and the number of the signal."""
    if isinstance(end, Terminated):
        return f"ended by {signal.Signals(int(end.code or 0) - 128).name}", int(end.code or 0)
    # at a question click turns both Ctrl-C and the end of the input into Abort
    if isinstance(end, KeyboardInterrupt) or not isinstance(end.__context__, EOFError):
        return "interrupted", 128 + signal.SIGINT
    click.echo("surffollow: the input ended before the answer", err=True)
    return "the input ended before the answer", 1


def json_error(text: str, kind: str, code: int) -> str:
    """An error as one JSON object."""
    import json

    return json.dumps({"error": text, "kind": kind, "exit_code": code})


def print_error(error: SurffollowError | click.ClickException | ModuleNotFoundError) -> None:
    """Print an error as one JSON object on stdout: text, class of `surffollow.errors`, exit code."""
    kind, text, code = type(error).__name__, str(error), 1
    if isinstance(error, ModuleNotFoundError):
        text = missing_library(error)
        if not text:
            print_unexpected(error)
            return
    elif isinstance(error, click.ClickException):  # of options; the names of click's classes change
        kind, text, code = UsageError.__name__, error.format_message(), error.exit_code
    else:
        code = error.exit_code
    click.echo(json_error(text, kind, code))


def print_unexpected(error: Exception) -> None:
    """Print an error that no command expects as one JSON object; not where stdout takes nothing any more."""
    if lacks_memory(error):
        click.echo(json_error(NO_MEMORY, FaultError.__name__, 1))
    elif not (isinstance(error, OSError) and error.errno in NO_ROOM):
        text = f"{OUR_FAULT}: {type(error).__name__}: {error}"
        click.echo(json_error(text, FaultError.__name__, 1))


def end_with_traceback() -> NoReturn:
    """End at an error that no command expects: its traceback, and that it is a fault of ours."""
    import traceback

    traceback.print_exc()
    print(f"surffollow: {OUR_FAULT}, with the traceback above", file=sys.stderr)
    sys.exit(1)


def pipe_closed() -> click.exceptions.Exit:
    """The end of a command whose output goes into a pipe that is closed, as by `head`: as if by SIGPIPE."""
    throw_output_away()
    return click.exceptions.Exit(128 + signal.SIGPIPE)


def throw_output_away() -> None:
    """Let what waits for a standard output that takes nothing go: the interpreter flushes once more."""
    try:
        sys.stdout.flush()
    except OSError:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
