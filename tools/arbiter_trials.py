"""Kill and stop holders, requesters and the server of an arbiter at random moments (for bench_arbiter)."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from surffollow.arbiter import attach, command_reader, observe
from surffollow.errors import SurffollowError

LEASE_S, PERIOD_S = 0.3, 0.001
CONFIG = """
history = 65536
mode = "0644"
[clients]
avoid = 40
wall = 30
go = 10
attacker = 20
other = 10
[resources.robot]
command = ["speed", "turn_rate"]
safe = [0.0, 0.0]
low = [-0.5, -1.0]
high = [0.5, 1.0]
"""
# servers are forked from a process that has loaded the kernels: a restart takes milliseconds
NURSERY = """
import os, signal, sys
from surffollow.arbiter.config import load_config
from surffollow.arbiter.server import Server
import msgspec
config = msgspec.structs.replace(load_config(sys.argv[1]), name=sys.argv[2])
warm = Server(msgspec.structs.replace(config, name=sys.argv[2] + "-warm"))
warm.run(warm.stop)
print("warm", flush=True)
for line in sys.stdin:
    pid = os.fork()
    if pid == 0:
        signal.alarm(600)
        server = Server(config)
        server.run(lambda: print("READY", os.getpid(), flush=True))
        os._exit(0)
    os.waitpid(pid, 0)
"""


class Nursery:
    """Starts servers, one after the other."""

    def __init__(self, name: str, config: str = CONFIG) -> None:
        self.name = name
        self._folder = tempfile.TemporaryDirectory()
        path = Path(self._folder.name) / "arbiter.toml"
        path.write_text(config)
        self.process = subprocess.Popen(
            [sys.executable, "-c", NURSERY, str(path), name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        self.pid = 0
        assert self._line() == ["warm"]

    def _line(self) -> list[str]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline().split()
        if not line:
            raise SystemExit("the arbiter did not start")
        return line

    def start(self) -> int:
        assert self.process.stdin is not None
        self.process.stdin.write("start\n")
        self.pid = int(self._line()[1])
        return self.pid

    def kill(self) -> None:
        os.kill(self.pid, signal.SIGKILL)

    def restart(self) -> None:
        self.kill()
        self.start()

    def close(self) -> None:
        with contextlib.suppress(OSError):
            os.kill(self.pid, signal.SIGTERM)
        assert self.process.stdin is not None
        self.process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(10)
        self.process.kill()
        self._folder.cleanup()
        for left in Path("/dev/shm").glob(f"{self.name}*"):
            left.unlink()


def fork(work: Callable[[int], None]) -> tuple[int, int]:
    """A child that works until it is killed; its pid and the pipe that it writes to."""
    r, w = os.pipe()
    pid = os.fork()
    if pid == 0:
        signal.alarm(120)
        with contextlib.suppress(BaseException):
            os.close(r)
            work(w)
        os._exit(0)
    os.close(w)
    return pid, r


def end(pid: int, r: int, number: int = signal.SIGKILL) -> None:
    """End a child."""
    with contextlib.suppress(OSError):
        os.kill(pid, number)
    os.waitpid(pid, 0)
    os.close(r)


def hold(name: str, client: str) -> Callable[[int], None]:
    """Take the robot, tell, then command it once a millisecond."""

    def work(w: int) -> None:
        robot = attach(name, client).resource("robot")
        robot.request(wait=True, timeout_s=60.0)
        robot.command(0.2, 0.1)
        os.write(w, b"h")
        while True:
            robot.command(0.2, 0.1)
            time.sleep(0.001)

    return work


def ask(name: str, client: str) -> Callable[[int], None]:
    """Ask for the robot over and over, in the queue and out of it."""

    def work(w: int) -> None:
        robot = attach(name, client).resource("robot")
        os.write(w, b"a")
        while True:
            robot.request()
            robot.request(wait=True, timeout_s=0.003)

    return work


def wait_for(condition: Callable[[], Any], timeout_s: float = 10.0) -> float:
    """Time until a condition holds [s]; infinite when it does not in time."""
    start = time.monotonic()
    while not condition():
        if time.monotonic() - start > timeout_s:
            return float("inf")
        time.sleep(0.0002)
    return time.monotonic() - start


@contextlib.contextmanager
def audited(name: str) -> Iterator[dict[str, Any]]:
    """The independent audit of all that happens inside; its findings at the end."""
    found: dict[str, Any] = {}
    program = Path(__file__).with_name("arbiter_audit.py")
    process = subprocess.Popen(
        [sys.executable, str(program), name, "--json"], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    process.stdout.readline()  # it follows
    try:
        yield found
    finally:
        time.sleep(0.1)
        process.terminate()
        out, _ = process.communicate(timeout=30)
        found.update(json.loads(out))


class Trials:
    """Trials on one arbiter."""

    def __init__(self, nursery: Nursery, seed: int) -> None:
        self.nursery, self.name, self.rng = nursery, nursery.name, random.Random(seed)
        self.reader = command_reader(self.name, "robot")
        self.times_s: dict[str, list[float]] = {n: [] for n in ("holder", "stopped", "requester", "server")}
        self.hangs: list[str] = []
        self.observer = observe(self.name)

    def _is_safe_and_free(self) -> bool:
        return self.reader.latest().safe and self.observer.holder("robot") is None

    def _note(self, kind: str, seconds: float) -> None:
        self.times_s[kind].append(seconds)
        if seconds == float("inf"):
            self.hangs.append(kind)

    def usable(self) -> bool:
        """Whether the next one gets the robot and is obeyed."""
        try:
            with attach(self.name, "avoid") as one:
                robot = one.resource("robot")
                if not robot.request(timeout_s=5.0):
                    return False
                return wait_for(lambda: robot.command(0.3, 0.0) and not self.reader.latest().safe) < 5.0
        except SurffollowError:
            return False

    def holder(self, kind: str = "holder") -> None:
        """Kill, or stop, who holds the robot."""
        pid, r = fork(hold(self.name, "go"))
        os.read(r, 1)
        time.sleep(self.rng.random() * 0.01)
        os.kill(pid, signal.SIGKILL if kind == "holder" else signal.SIGSTOP)
        self._note(kind, wait_for(self._is_safe_and_free))
        end(pid, r)

    def requester(self) -> None:
        """Kill who asks for the robot while another one holds it: the holder is not disturbed."""
        with attach(self.name, "wall") as one:
            robot = one.resource("robot")
            robot.request()
            pid, r = fork(ask(self.name, "go"))
            os.read(r, 1)
            until = time.monotonic() + self.rng.random() * 0.01
            while time.monotonic() < until:
                robot.command(0.1, 0.1)
                time.sleep(0.0005)
            os.kill(pid, signal.SIGKILL)

            def only_we() -> bool:
                status = self.observer.status()
                robot.command(0.1, 0.1)
                return len(status["clients"]) == 1 and status["resources"]["robot"]["queue"] == 0

            self._note("requester", wait_for(only_we))
            if not robot.held:
                self.hangs.append("the holder lost the robot to a dead requester")
            end(pid, r)

    def server(self) -> None:
        """Kill the server while one holds the robot and another asks; a new one serves at once."""
        children = [fork(hold(self.name, "wall")), fork(ask(self.name, "go"))]
        for _, r in children:
            os.read(r, 1)
        time.sleep(self.rng.random() * 0.01)
        self.nursery.kill()
        seconds = wait_for(lambda: self.reader.latest().safe)
        self.nursery.start()
        self.observer.close()
        self.observer = observe(self.name)
        self._note("server", seconds)
        for pid, r in children:
            end(pid, r)

    def run(self, count: int, progress: Callable[[str], None]) -> None:
        """Do so many trials, of all kinds in turn."""
        kinds = ("holder", "requester", "holder", "server", "holder", "requester", "stopped", "holder")
        for k in range(count):
            kind = kinds[k % len(kinds)]
            if kind in ("holder", "stopped"):
                self.holder(kind)
            else:
                getattr(self, kind)()
            if not self.usable():
                self.hangs.append(f"unusable after trial {k} ({kind})")
            if k % 50 == 49:
                progress(f"{k + 1} kills")
