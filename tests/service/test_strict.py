"""A strict start refuses a machine that does not grant the configured settings."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable

import pytest

from running_service import READY_S, Service, objects_of
from surffollow.config.service import Realtime
from surffollow.service.realtime import AFFINITY, DMA_LATENCY, FIFO, MLOCKALL, Grants, missing

Make = Callable[..., Service]
# root without the rights that root has over the scheduler and over memory
POOR = (
    "setpriv",
    "--bounding-set",
    "-sys_nice,-ipc_lock,-sys_resource",
    "prlimit",
    "--rtprio=0",
    "--memlock=65536",
)
NEEDS = pytest.mark.skipif(
    os.geteuid() != 0 or not all(map(shutil.which, ("setpriv", "prlimit"))),
    reason="needs root, setpriv and prlimit",
)


def start(s: Service, *words: str) -> subprocess.CompletedProcess[str]:
    command = [*POOR, *s.command("start", "--config", str(s.config), *words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=READY_S)


@NEEDS
def test_a_strict_start_without_real_time_priority_is_refused(make_service: Make) -> None:
    s = make_service()
    done = start(s, "--strict")
    assert done.returncode == 1
    assert "READY" not in done.stdout
    assert "strict start: the kernel does not grant fifo" in done.stderr
    assert "rtprio" in done.stderr, "and the remedy"
    assert objects_of(s.name) <= {f"{s.name}.map", f"{s.name}.lock"}


@NEEDS
def test_the_configuration_may_ask_for_it_and_locked_memory_counts(make_service: Make) -> None:
    s = make_service()
    s.config.write_text(
        s.config.read_text().replace("lock_memory = false", "lock_memory = true\nstrict = true")
    )
    done = start(s)
    assert done.returncode == 1
    assert "does not grant mlockall" in done.stderr


def test_what_is_required_and_refused_is_missing_and_nothing_else() -> None:
    grants = Grants()
    grants.note(FIFO, None, "")
    grants.note(MLOCKALL, OSError(1, "Operation not permitted"), "raise the limit")
    every = FIFO | AFFINITY | MLOCKALL | DMA_LATENCY
    assert missing(grants, Realtime(), FIFO) == []
    assert missing(grants, Realtime(), MLOCKALL) == ["mlockall: Operation not permitted (raise the limit)"]
    assert missing(grants, Realtime(lock_memory=False), MLOCKALL) == []
    assert missing(grants, Realtime(cpu=1), AFFINITY) == ["affinity"]
    assert missing(grants, Realtime(cpu=-1), AFFINITY) == [], "any processor will do"
    assert len(missing(grants, Realtime(cpu=1), every)) == 3
