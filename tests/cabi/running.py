"""Run a service, the programs that talk to it, and a probe that does one call of the header per line."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from forked_start import fork_start
from surffollow.shm.dtypes import zeros
from surffollow.sim.world import WorldPose, WorldWriter

ROOT = Path(__file__).parents[2]
WARNINGS = ["-Wall", "-Wextra", "-Werror", "-pedantic", "-Wshadow", "-Wconversion", "-Wundef"]
C = ["-std=c11", *WARNINGS]
CPP = ["-std=c++17", *WARNINGS, "-Wold-style-cast"]
# silence that a busy machine may cause; what holds a client's patience to 20 periods says so
PATIENT_MS = 500
SANITIZED = ["-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
STANDOFF_M = 0.1
CONFIG = """
period = "1 ms"
log_words = 65536
[realtime]
cpu = CPU
lock_memory = false
priority = 10
spin = "20 us"
[map]
grids = 20000
access_lease = "LEASE"
[driver]
kind = "simulated"
[driver.world]
surface = "flat"
region = [0.0, 0.0, 0.1, 0.1]
"""


class Service:
    """A running `surffollow start`, told by its name."""

    def __init__(self, name: str, folder: Path, lease: str = "60 s") -> None:
        self.name, self.config = name, folder / f"{name}.toml"
        # not the last processor, which other services take, and spin on
        cpu = str(min(os.sched_getaffinity(0)))
        self.config.write_text(CONFIG.replace("CPU", cpu).replace("LEASE", lease))
        self.process: subprocess.Popen[str] | None = None

    def command(self, *words: str) -> list[str]:
        return [sys.executable, "-m", "surffollow", *words, "--name", self.name]

    def start(self) -> None:
        """Start it and wait for READY."""
        words = self.command("start", "--quiet", "--config", str(self.config))
        self.process = fork_start(words) or subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith("READY"), f"the service did not start: {line!r}"

    def kill(self) -> None:
        """SIGKILL: nothing is tidied up."""
        assert self.process is not None
        self.process.kill()
        self.process.wait()

    def stop(self) -> None:
        """End it and remove all that it left."""
        subprocess.run(self.command("stop", "--purge"), timeout=120, check=False, capture_output=True)
        if self.process is not None:
            self.process.wait(timeout=60)


class StillWorld:
    """Publishes a tool that stands `STANDOFF_M` above flat ground, for the sensor to see."""

    def __init__(self, name: str) -> None:
        self._writer, self._over = WorldWriter(name), threading.Event()
        self._thread = threading.Thread(target=self._publish, daemon=True)
        self._thread.start()

    def _publish(self) -> None:
        record = zeros(WorldPose)
        record[0]["pose"] = (0.05, 0.05, STANDOFF_M, 0.0, 0.0, 0.0, 1.0)
        while not self._over.wait(0.01):
            record[0]["t_ns"] = time.monotonic_ns()
            self._writer.write(record)

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self._writer.close()


def run(program: Path, *words: str, timeout_s: float = 120.0, code: int = 0) -> str:
    """Run a program to its end; what it printed."""
    done = subprocess.run([str(program), *words], capture_output=True, text=True, timeout=timeout_s)
    assert done.returncode == code, f"{words}: {done.returncode}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def numbers(line: str) -> dict[str, float]:
    """`a 1 b 2.5` as a dictionary."""
    words = line.split()
    return {words[i]: float(words[i + 1]) for i in range(0, len(words) - 1, 2)}


class Answer(NamedTuple):
    """What one call gave: its result, the client's detail and slot, and the values it wrote."""

    result: int
    detail: int
    slot: int
    values: list[float]


class Probe:
    """A running `probe.c`: call it with one line, get the answer."""

    def __init__(self, *program: Path | str, **options: Any) -> None:
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(
            [str(word) for word in program],
            stdin=pipe,
            stdout=pipe,
            stderr=pipe,
            text=True,
            bufsize=1,
            **options,
        )
        self.pid = self.process.pid

    def __call__(self, line: str) -> Answer:
        self.ask(line)
        return self.answer(line)

    def ask(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")

    def answer(self, line: str) -> Answer:
        assert self.process.stdout is not None
        words = self.process.stdout.readline().split()
        if not words:
            raise AssertionError(f"the probe died of {line!r}: {self.process.communicate()[1]}")
        return Answer(int(words[-3]), int(words[-2]), int(words[-1]), [float(w) for w in words[:-3]])

    def until(self, line: str, condition: Callable[[Answer], bool], timeout_s: float = 60.0) -> Answer:
        """Repeat a call until its answer is as wanted."""
        deadline = time.monotonic() + timeout_s
        while not condition(answer := self(line)):
            assert time.monotonic() < deadline, f"{line!r} still answers {answer}"
        return answer

    def end(self) -> None:
        """Let it detach and end; sanitizers complain by the exit code."""
        if self.process.poll() is None:
            _, errors = self.process.communicate(timeout=60)
            assert self.process.returncode == 0, errors
