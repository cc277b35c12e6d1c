"""An arbiter as a process, clients in forked children that can be killed, and waiting for conditions."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from forked_start import fork_start
from running_service import WAIT_S, freeze, run_command, until
from startable import Startable

if TYPE_CHECKING:
    from typing_extensions import Self

CONFIG = """
[clients]
avoid = 40
wall = 30
wall-2 = 30
go = 10
MORE_CLIENTS

[resources.robot]
command = ["speed", "turn_rate"]
units = ["m/s", "rad/s"]
safe = [0.0, 0.0]
low = [-0.5, -1.0]
high = [0.5, 1.0]
status = "cell.base"

[resources.camera]
command = ["pan"]
safe = [0.0]
policy = "cooperative"
grace = "50 ms"

[resources.speaker]
command = ["tone"]
safe = [0.0]
equal = "newcomer"
"""


class ArbiterProcess(Startable):
    """A server process of a test's own."""

    program = ("-m", "surffollow")

    def __init__(self, folder: Path, text: str = CONFIG, name: str = "", more_clients: str = "") -> None:
        self.name = name or f"a{uuid.uuid4().hex[:10]}"
        self.path = folder / f"{self.name}.toml"
        self.path.write_text(text.replace("MORE_CLIENTS", more_clients))
        self.process: subprocess.Popen[str] | None = None

    def start(self) -> Self:
        words = [sys.executable, *self.program, "arbiter", "start", "--quiet", "--name", self.name]
        words.append(str(self.path))
        self.process = fork_start(words) or subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith("READY"), f"the arbiter did not start: {line!r}"
        return self

    def kill(self) -> None:
        assert self.process is not None
        self.process.kill()
        self.process.wait()

    def freeze(self) -> None:
        """SIGSTOP, and wait until every thread stands still."""
        assert self.process is not None
        freeze(self.process.pid)

    def go_on(self) -> None:
        assert self.process is not None
        self.process.send_signal(signal.SIGCONT)

    def stop(self) -> int:
        assert self.process is not None
        self.process.terminate()
        return self.process.wait(timeout=WAIT_S)

    def purge(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
        for left in Path("/dev/shm").glob(f"{self.name}*"):
            left.unlink()

    def command(self, *words: str) -> Any:
        command = [sys.executable, "-m", "surffollow", "arbiter", *words, "--name", self.name, "--json"]
        done = run_command(command)
        done.check_returncode()
        return json.loads(done.stdout)


WARNINGS = ["-Wall", "-Wextra", "-Werror", "-pedantic", "-Wshadow", "-Wconversion", "-Wundef"]
COMPILERS = {"C": ["gcc", "-std=c11"], "C++": ["g++", "-std=c++17", "-x", "c++"]}
ROOT = Path(__file__).parents[2]


PATROL = ROOT / "examples/arbiter/patrol.c"


def compile_client(folder: Path, language: str = "C", source: Path = PATROL) -> Path:
    """A client in C, the tutorial's when nothing else is said, with sanitizers."""
    compiler = COMPILERS[language]
    if shutil.which(compiler[0]) is None:
        pytest.skip(f"no {compiler[0]} on this machine")
    program = folder / source.stem
    flags = ["-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    words = [*compiler, *WARNINGS, *flags, f"-I{ROOT / 'include'}", "-o", str(program)]
    done = subprocess.run([*words, str(source)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return program


def compile_waiting(folder: Path, wait_ms: int, language: str = "C") -> Path:
    """The tutorial's client, which waits another time for an arbiter rather than ten seconds."""
    source, wait = folder / "waiting.c", '"patrol", 10000)'
    text = PATROL.read_text()
    assert wait in text
    source.write_text(text.replace(wait, f'"patrol", {wait_ms})'))
    return compile_client(folder, language, source)


class Child:
    """A forked client; `work` gets a pipe to speak through. It never returns into pytest."""

    def __init__(self, work: Callable[[Callable[[bytes], object]], None]) -> None:
        self._r, w = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            signal.alarm(120)
            try:
                os.close(self._r)
                work(lambda data: os.write(w, data))
            except BaseException:
                os._exit(1)
            os._exit(0)
        os.close(w)

    def receive(self) -> bytes:
        return os.read(self._r, 1)

    def signal(self, number: int) -> None:
        os.kill(self.pid, number)
        if number == signal.SIGSTOP:
            os.waitpid(self.pid, os.WUNTRACED)

    def kill(self) -> None:
        if self.pid > 0:
            os.kill(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)
            os.close(self._r)
            self.pid = -1


def send_raw(client: Any, what: int, token: int, value: float = 0.4) -> None:
    """Put an item into a client's own mailbox, without the library's checks."""
    from surffollow.arbiter import exchange as ex
    from surffollow.arbiter import layout as al

    post = client.exchange.mailbox_words
    head = post[ex.HEAD]
    at = ex.ITEMS + (head & ex.MASK) * ex.ITEM_BYTES
    numbers = (head + 1, what, token, time.monotonic_ns(), 0)
    ex.COMMAND.pack_into(client.exchange.mailbox, at, *numbers, *(value,) * al.VALUES)
    post[ex.HEAD] = head + 1


def holding(name: str, client: str, resource: str, speed: float = 0.1) -> Callable[[Any], None]:
    """Work of a child that takes a resource and commands it until it is killed."""

    def work(say: Callable[[bytes], object]) -> None:
        from surffollow.arbiter import attach

        mine = attach(name, client).resource(resource)
        assert mine.request(wait=True, timeout_s=WAIT_S)
        mine.command(*(speed,) * mine.n_values)
        say(b"h")
        until(lambda: mine.command(*(speed,) * mine.n_values) and None, seconds=float("inf"))

    return work
