"""The processes of a demonstration: they end when it does, however it ends, and nothing of them stays."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from surffollow.errors import AlreadyRunningError, ServiceError, SurffollowError
from surffollow.service.terminate_child import end_child
from surffollow.shm.python_child import bound_command, code_command

_CLEANUP_CODE = (
    "import sys; sys.stdin.read(); from surffollow.apps.child_processes import purge; "
    "purge(sys.argv[1], 30.0)"
)


class Child:
    """A child of the demonstration; its standard error is kept for when it fails."""

    def __init__(self, what: str, words: list[str], folder: Path) -> None:
        self.what = what
        self._errors = (folder / f"{what}.err").open("w+")
        # a session of its own: Ctrl-C reaches the demonstration alone, which ends its children in order
        self.child = subprocess.Popen(
            bound_command(*words),
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            start_new_session=True,
        )

    def errors(self) -> str:
        """Its standard error so far."""
        self._errors.seek(0)
        return self._errors.read().strip()

    def fail(self, why: str) -> ServiceError:
        """An error that says what went wrong with it."""
        lines = self.errors().splitlines()
        return ServiceError(f"the {self.what} {why}" + (f": {lines[-1]}" if lines else ""))

    def end(self, timeout_s: float = 15.0) -> str:
        """Interrupt it and take what it printed."""
        out = end_child(self.child, signal.SIGINT, timeout_s)
        self._errors.close()
        return out

    def result(self, timeout_s: float) -> dict[str, Any]:
        """Wait for its end and parse the JSON object that it printed; the caller interprets code 1."""
        try:
            out, _ = self.child.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            raise self.fail(f"did not end in {timeout_s:.0f} s") from None
        code = self.child.returncode
        if code not in (0, 1) or not out.startswith("{"):
            raise self.fail(f"ended with code {code}")
        return dict(json.loads(out))


@contextlib.contextmanager
def running(what: str, words: list[str], folder: Path) -> Iterator[Child]:
    """A child from its start to its end."""
    process = Child(what, words, folder)
    try:
        yield process
    finally:
        process.end()


def purge(name: str, wait_s: float = 0.0) -> None:
    """Remove every object of a service that has ended, or ends within `wait_s`."""
    from surffollow.service.name_owner import remove_all
    from surffollow.shm.objects import unlink

    deadline = time.monotonic() + wait_s
    while True:
        try:
            remove_all(name)
        except AlreadyRunningError:
            if time.monotonic() < deadline:
                time.sleep(0.05)
                continue
        except SurffollowError:
            pass
        with contextlib.suppress(SurffollowError):
            unlink(f"{name}.world")
        return


@contextlib.contextmanager
def no_leftovers(name: str) -> Iterator[None]:
    """Purge a service's objects at the end, even when this process is killed: a child waits for that."""
    janitor = subprocess.Popen(
        code_command(_CLEANUP_CODE, name),
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        yield
    finally:
        purge(name)
        janitor.kill()
        janitor.communicate()
