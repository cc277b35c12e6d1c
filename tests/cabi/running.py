"""The programs that talk to a service, and a probe that does one call of the header per line."""

from __future__ import annotations

import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from running_service import config_text

ROOT = Path(__file__).parents[2]
WARNINGS = ["-Wall", "-Wextra", "-Werror", "-pedantic", "-Wshadow", "-Wconversion", "-Wundef"]
C = ["-std=c11", *WARNINGS]
CPP = ["-std=c++17", *WARNINGS, "-Wold-style-cast"]
# silence that a busy machine may cause; what holds a client's patience to 20 periods says so
PATIENT_MS = 500
SANITIZED = ["-g1", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]


def flat_ground(lease: str = "60 s") -> str:
    """The configuration of one sensor over flat ground."""
    return config_text(kind="simulated", map=f'access_lease = "{lease}"')


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
    """Outcome of one call: its result, the client's detail and slot, and the values it wrote."""

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
        """Repeat a call until its answer is as expected."""
        deadline, pause = time.monotonic() + timeout_s, threading.Event()
        while not condition(answer := self(line)):
            assert time.monotonic() < deadline, f"{line!r} still answers {answer}"
            pause.wait(0.001)
        return answer

    def end(self) -> None:
        """Let it detach and end; sanitizers complain by the exit code."""
        if self.process.poll() is None:
            _, errors = self.process.communicate(timeout=60)
            assert self.process.returncode == 0, errors
