"""A service as a process of its own: started, awaited, ended, its objects removed."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from surffollow.shm.ending_signals import ended_by_signals
from surffollow.shm.objects import unlink

COMMAND = (sys.executable, "-m", "surffollow")
OBJECTS = ("", ".sock", ".lock", ".map", ".stop", ".world", ".world.lock")  # suffixes of a service's name
END_S = 90.0  # a busy machine ends a service slowly


def await_ready(process: subprocess.Popen[str]) -> None:
    """Read the first line of a service that was just started; SystemExit when it is not READY."""
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line.startswith("READY"):
        raise SystemExit(f"the service did not become READY: {line!r}")


def remove_objects(name: str) -> None:
    """Remove what a service of this name left in shared memory and on disk."""
    for suffix in OBJECTS:
        unlink(name + suffix)


def pinned(folder: Path, text: str) -> Path:
    """A configuration file with CPU replaced by the first processor that this process may use.

    Parameters
    ----------
    folder : Path
        where the file is written
    text : str
        the configuration; other services take the last processor, and spin on it
    """
    path = folder / "bench.toml"
    path.write_text(text.replace("CPU", str(min(os.sched_getaffinity(0)))), encoding="utf-8")
    return path


@contextlib.contextmanager
def service_process(name: str, config: Path) -> Iterator[subprocess.Popen[str]]:
    """A READY service with this configuration while the block runs, or until a signal ends the program.

    Parameters
    ----------
    name : str
        of the service
    config : Path
        configuration file
    """
    words = [*COMMAND, "start", "--quiet", "--name", name, "--config", str(config)]
    with ended_by_signals():
        process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        try:
            await_ready(process)
            yield process
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(timeout=END_S)
            remove_objects(name)
