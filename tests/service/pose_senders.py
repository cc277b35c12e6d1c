"""Processes that send poses, and what is free of them."""

from __future__ import annotations

from running_service import (
    ATTACHED,
    SENDING,
    Service,
    until,
)

SENDER = f"""{ATTACHED}
print("sending", client.slot, flush=True)
{SENDING}"""


def free_of_poses(s: Service) -> None:
    with s.observe() as watcher:
        until(lambda: watcher.status()["main"]["pose_slot"] == -1, "a free pose")
