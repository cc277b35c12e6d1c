"""Processes that send poses, and what is free of them."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator

from running_service import ATTACHED, SENDING, Service, program, said, until

SENDER = f"""{ATTACHED}
print("sending", client.slot, flush=True)
{SENDING}"""


@contextlib.contextmanager
def orphan_of(code: str, name: str) -> Iterator[None]:
    """The forked child, which lives on, of a killed client whose `code` prints "forked PID"."""
    with program(code, name) as parent:
        child = int(said(parent).split()[1])
        try:
            parent.kill()
            parent.wait()
            os.kill(child, 0)
            yield
        finally:
            os.kill(child, signal.SIGKILL)


def free_of_poses(s: Service) -> None:
    with s.observe() as watcher:
        until(lambda: watcher.status()["main"]["pose_slot"] == -1, "a free pose")
