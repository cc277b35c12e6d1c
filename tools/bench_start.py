"""Time what a user waits for: `surffollow --help`, `import surffollow.client`, READY warm and cold.

Each is a fresh process, timed from its start to its end (READY: to the line). Warm: the kernel cache
of an earlier start; cold: an empty SURFFOLLOW_CACHE_DIR, the whole wait while kernels compile.
"""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from report import criterion, finish, result
from service_process import COMMAND, END_S, remove_objects

REPEATS = 7
HELP_S, IMPORT_S, WARM_S, COLD_S = 0.3, 0.15, 3.0, 20.0


def run_s(command: list[str]) -> float:
    """Median seconds of a short process."""
    took = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        took.append(time.perf_counter() - start)
    return float(np.median(took[1:]))


def ready_s(name: str, cache: str | None = None) -> tuple[float, int]:
    """Seconds from the start of a service to its READY, and the lines of progress it showed."""
    environment = os.environ | ({"SURFFOLLOW_CACHE_DIR": cache} if cache else {})
    start = time.perf_counter()
    with tempfile.TemporaryFile("w+") as progress:
        process = subprocess.Popen(
            [*COMMAND, "start", "--name", name],
            stdout=subprocess.PIPE,
            stderr=progress,
            text=True,
            env=environment,
        )
        assert process.stdout is not None
        try:
            line = process.stdout.readline()
            took = time.perf_counter() - start
            if not line.startswith("READY"):
                progress.seek(0)
                raise SystemExit(f"the service did not become READY: {line!r}\n{progress.read()}")
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(timeout=END_S)
            remove_objects(name)
        progress.seek(0)
        shown = progress.read()
    return took, len(shown.replace("\r", "\n").splitlines())


def main() -> dict[str, Any]:
    """Measure and hold against the criteria."""
    name = f"bench-start-{os.getpid()}"
    help_s = run_s([*COMMAND, "--help"])
    import_s = run_s([sys.executable, "-c", "import surffollow.client"])
    bare_s = run_s([sys.executable, "-c", "pass"])
    with tempfile.TemporaryDirectory() as cache:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        cold_s, lines = ready_s(name, cache)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        cold_processor_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        warm_s = min(ready_s(name, cache)[0] for _ in range(3))
        size = sum(f.stat().st_size for f in Path(cache).rglob("*") if f.is_file())
    return result(
        "start-up times, each of a fresh process",
        [
            criterion("surffollow --help", help_s, HELP_S, "s"),
            criterion(
                "import surffollow.client", import_s, IMPORT_S, "s", f"of which Python itself {bare_s:.3f} s"
            ),
            criterion("READY, warm kernel cache", warm_s, WARM_S, "s", "best of 3"),
            criterion(
                "READY, empty kernel cache",
                cold_s,
                COLD_S,
                "s",
                f"{cold_processor_s:.0f} s of processor time",
            ),
        ],
        [
            f"kernel cache {size / 2**20:.1f} MiB; {lines} lines of progress shown while it was empty",
        ],
    )


if __name__ == "__main__":
    sys.exit(finish(main()))
