"""End the process that holds a name, and wait for its end."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable


def end_process(pid: int, running_pid: Callable[[], int], what: str, timeout_s: float) -> None:
    """Send SIGTERM to the process that holds a name, and wait until it holds it no more.

    Parameters
    ----------
    pid : int
        of the process
    running_pid : callable
        the pid of the process that holds the name now; 0: none
    what : str
        what it is, for errors: "service 'surf'"
    timeout_s : float
        longest wait [s]

    Raises
    ------
    ServiceError
        it belongs to another user, or did not end in time
    """
    from surffollow.errors import ServiceError

    try:
        ask_to_end(pid, running_pid)
    except PermissionError:
        raise ServiceError(f"{what} (pid {pid}) belongs to another user; ask them or root") from None
    deadline = time.monotonic() + timeout_s
    while running_pid() == pid:
        if time.monotonic() > deadline:
            raise ServiceError(f"{what} (pid {pid}) did not end in {timeout_s:g} s; kill -9 {pid} is safe")
        time.sleep(0.01)


def ask_to_end(pid: int, running_pid: Callable[[], int]) -> None:
    """Send SIGTERM to the process that holds the name, never to one that got its number meanwhile."""
    with contextlib.suppress(ProcessLookupError):
        process = os.pidfd_open(pid)
        try:
            if running_pid() == pid:
                signal.pidfd_send_signal(process, signal.SIGTERM)
        finally:
            os.close(process)


def check_holder_is_here(lock: str, what: str) -> None:
    """Refuse to end what no process of this pid namespace holds, or what another user holds.

    A process that was killed a moment ago still holds its name, and lets go soon.

    Parameters
    ----------
    lock : str
        name of the lock
    what : str
        what it is, for errors: "service 'surf'"

    Raises
    ------
    ServiceError
        it runs elsewhere, or belongs to root or the user of SURFFOLLOW_OWNER
    NoPermissionError
        this user may not look for it
    NotRunningError
        the name's lock file is a stranger's
    """
    from surffollow.config.trusted_users import trusted_owners
    from surffollow.errors import NoPermissionError, NotRunningError, ServiceError
    from surffollow.shm.name_lock import holder, lock_owner, settled_holder
    from surffollow.shm.objects import SHM_ROOT

    if holder(lock) >= 0:
        return
    owner, me = lock_owner(lock), os.geteuid()
    if owner < 0 and holder(lock) < 0:  # it did not end meanwhile
        raise NoPermissionError(
            f"cannot see whether {what} runs: user {me} may not look into {SHM_ROOT}; let root open it to "
            f"all users (chmod 1777 {SHM_ROOT}), or run as its owner"
        )
    if me not in (owner, 0):
        whose = f"belongs to another user ({owner})"
        if owner in trusted_owners():
            raise ServiceError(f"{what} {whose}; ask them or root")
        raise NotRunningError(f"no {what} of this user is running; the lock file of that name {whose}")
    if owner in trusted_owners() and settled_holder(lock) < 0:
        raise ServiceError(
            f"{what} runs as a process that has no number here: in another pid namespace (a container); stop "
            "it there"
        )
