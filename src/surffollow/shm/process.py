"""Whether a process that was started then still runs: by pid and start time from /proc."""

from __future__ import annotations

import os
from pathlib import Path


def _words(pid: int) -> list[str]:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except (OSError, IndexError):
        return []


def own_pid() -> int:
    """This process's number in /proc, by which others look it up.

    It is not `os.getpid` in a pid namespace whose /proc is still that of another one: there number 1, say, is
    another process.
    """
    try:
        return int(os.readlink("/proc/self"))
    except (OSError, ValueError):
        return os.getpid()


def start_ticks(pid: int) -> int:
    """Start time of a process in clock ticks since boot; 0 when there is no such process."""
    words = _words(pid)
    return int(words[19]) if words else 0


def is_running(pid: int, ticks: int) -> bool:
    """Whether the process that was started then still has memory: one that dies gives that up first."""
    words = _words(pid) if pid > 0 else []
    return bool(words) and int(words[19]) == ticks and int(words[20]) > 0


def belongs_to(pid: int, user: int) -> bool:
    """Whether a process runs as this user: only such a one can be what a file of that user says it is."""
    try:
        return os.stat(f"/proc/{pid}").st_uid == user
    except OSError:
        return False


def boot_id() -> str:
    """The kernel's identity of this boot."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
