"""The header as an aarch64 program, run by qemu: latches between threads, and a client of the real service.

An emulator on x86-64 keeps the host's memory order: this shows that layouts, locks, system calls and
atomics are right there, not that no fence is missing. For that, test_latch looks at the instructions.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from cabi.latch_threads import AARCH64, THREADS
from cabi.running import ROOT, C, Probe, numbers
from running_service import STANDOFF_M, Service, until
from surffollow.client import attach
from surffollow.shm.cheader import header_text
from surffollow.shm.layout_follow import VALID

QEMU = "qemu-aarch64"
OK = 0
POSE = "ee 0.05 0.05 0.1 0 0 0 1"
pytestmark = pytest.mark.skipif(
    os.uname().machine != "aarch64" and not (shutil.which(AARCH64) and shutil.which(QEMU)),
    reason=f"needs {AARCH64} and {QEMU} (Debian: gcc-aarch64-linux-gnu, qemu-user)",
)


def build(source: Path, folder: Path) -> list[str]:
    """Compile for aarch64; the words that run it here."""
    (folder / "surffollow.h").write_text(header_text())
    native = os.uname().machine == "aarch64"
    compiler, static = ("gcc", []) if native else (AARCH64, ["-static"])
    program = folder / "program"
    command = [compiler, *C, *static, "-O2", "-pthread", f"-I{folder}", str(source), "-o", str(program)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return [str(program)] if native else [QEMU, str(program)]


def test_no_thread_sees_half_a_payload(tmp_path: Path) -> None:
    source = tmp_path / "threads.c"
    source.write_text(THREADS)
    done = subprocess.run(build(source, tmp_path), capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    found = numbers(done.stdout)
    assert found["torn"] == 0
    assert found["reads"] > 100


@pytest.fixture
def probe(tmp_path: Path) -> Iterator[Probe]:
    p = Probe(*build(ROOT / "tests/cabi/probe.c", tmp_path))
    yield p
    p.end()


def test_client_works_with_the_service_of_this_machine(probe: Probe, service: Service) -> None:
    probe("stale_ms 60000")
    assert probe(f"attach {service.name}").result == OK
    probe.until(POSE, lambda a: int(probe("dev").values[2]) & VALID != 0)
    assert probe("raw 0").values[0] == pytest.approx(STANDOFF_M, abs=1e-3)
    assert probe("set range_size 7").result == OK
    with attach(service.name) as python:
        assert python.params()["range_size"] == 7
        # the kernel's lock tells the service that both live
        until(lambda: python.status()["main"]["clients"] >= 2, "the service counts both")
    assert probe("set range_size 5").result == OK
    assert probe("map_reset 0 0 0.1 0.1").result == OK
    probe.until(POSE, lambda a: probe("height 0.05 0.05").result == OK)
    assert probe("height 0.05 0.05").values[0] == pytest.approx(0.0, abs=1e-3)
    assert probe("begin 1000").result == OK
    assert probe("end").result == OK
    assert probe("detach").result == OK
