"""A real service for tests, started, killed and purged as its own process; the ground under its sensor."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from forked_start import fork_start
from startable import Startable
from surffollow.client import Client, Observer, attach, observe
from surffollow.config.service import ServiceConfig, load_config
from surffollow.errors import BusyError, NotRunningError
from surffollow.shm.dtypes import zeros
from surffollow.shm.objects import unlink
from surffollow.sim.hardware_priority import FIFO_PRIORITY
from surffollow.sim.world import WorldPose, WorldWriter

if TYPE_CHECKING:
    from typing_extensions import Self

READY_S = 1200.0  # a start on a busy machine with a cold kernel cache
WAIT_S = 60.0  # only there to fail
PATIENT_S = 1.0  # silence that a busy machine may cause and that is not what a test is about
PRIORITY = FIFO_PRIORITY + 1  # of a service: a simulated robot beside it is below it, as by default
STANDOFF_M = 0.1
POSE = (0.05, 0.05, STANDOFF_M, 0.0, 0.0, 0.0, 1.0)
# a service takes the last processor unless told otherwise: tests keep off those that run beside
QUIET_CPU = min(os.sched_getaffinity(0))
OWN_OBJECTS = ("", ".sock", ".lock", ".map", ".stop")
OBJECTS = (*OWN_OBJECTS, ".world", ".world.lock")
# parts of programs beside a test: attach to the service named by the first word, send poses for ever
ATTACHED = f"""
import os, sys, time
from surffollow.client import attach
client = attach(sys.argv[1], stale_min_s={PATIENT_S})
client.ee_pos({POSE})
"""
SENDING = f"""
while True:
    client.ee_pos({POSE})
    time.sleep(0.005)
"""
_numbers = itertools.count()


def until(condition: Callable[[], Any], what: str = "it", seconds: float = WAIT_S) -> Any:
    """Wait for something that another process or thread does; what the condition gave."""
    end, pause = time.monotonic() + seconds, threading.Event()
    while not (value := condition()):
        assert time.monotonic() < end, f"{what} did not happen within {seconds:g} s"
        pause.wait(0.002)
    return value


def freeze(pid: int) -> None:
    """SIGSTOP to a process, and wait until every thread of it stands still."""
    os.kill(pid, signal.SIGSTOP)
    tasks = Path(f"/proc/{pid}/task")
    until(
        lambda: {p.read_text().rsplit(")", 1)[1].split()[0] for p in tasks.glob("*/stat")} == {"T"},
        "standstill",
    )


def interrupt(child: subprocess.Popen[Any]) -> None:
    """Ctrl-C at a question, until it ends the process: `input` may lose one while it flushes stderr.

    A second one comes late: Python dies of one that meets it on its way out.
    """

    def ended() -> bool:
        child.send_signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(5.0)
        return child.poll() is not None

    until(ended, "its end")


def quickest(action: Callable[[], Any], tries: int = 5) -> float:
    """Seconds that the quickest of several tries took: what else runs on the machine delays some, not all."""
    taken = []
    for _ in range(tries):
        began = time.monotonic()
        action()
        taken.append(time.monotonic() - began)
    return min(taken)


def unique_name(prefix: str = "t") -> str:
    """A service name that no other test process uses."""
    return f"{prefix}-{os.getpid()}-{next(_numbers)}"


def objects_of(name: str) -> set[str]:
    """Names in /dev/shm that belong to a service."""
    return {p for p in os.listdir("/dev/shm") if p == name or p.startswith(f"{name}.")}


def config_text(
    *, kind: str = "none", period: str = "1 ms", grids: int = 20_000, top: str = "", **tables: str
) -> str:
    """A small configuration; `tables` adds lines to [realtime], [map], [access], [driver] or [follow]."""
    lines = {
        "realtime": f'lock_memory = false\npriority = {PRIORITY}\nspin = "20 us"\ncpu = {QUIET_CPU}\n',
        "map": f"grids = {grids}\n",
        "access": "",
        "driver": f'kind = "{kind}"\n',
        "follow": "",
    }
    for table, more in tables.items():
        lines[table] += more + "\n"
    if kind == "simulated":
        lines["driver.world"] = 'surface = "flat"\nregion = [0.0, 0.0, 0.1, 0.1]\n'
    head = f'period = "{period}"\nlog_words = 65536\n{top}\n'
    return head + "".join(f"[{table}]\n{text}" for table, text in lines.items() if text)


def begin_command(words: Sequence[str], stdin: int | None = None) -> subprocess.Popen[str]:
    """Run a command line of the package with pipes, forked where that is possible (`forked_start`).

    `stdin` as of `Popen`.
    """
    pipe = subprocess.PIPE
    forked = fork_start(words, pipe, stdin)
    return forked or subprocess.Popen(words, stdin=stdin, stdout=pipe, stderr=pipe, text=True)


def run_command(words: Sequence[str], timeout_s: float = READY_S) -> subprocess.CompletedProcess[str]:
    """Run a command line of the package to its end, forked where that is possible (`forked_start`)."""
    with begin_command(words) as process:
        try:
            out, errors = process.communicate(timeout=timeout_s)
        finally:
            process.kill()
    return subprocess.CompletedProcess(list(words), process.returncode, out, errors)


def _patient(options: dict[str, Any]) -> dict[str, Any]:
    """Options of an attachment; the time of silence is the caller's where he says one."""
    given = options.keys() & {"stale_periods", "stale_min_s"}
    return options if given else {"stale_min_s": PATIENT_S, **options}


class Service(Startable):
    """A `surffollow start` of a test's own."""

    def __init__(self, folder: Path, config: str | None = None, name: str = "") -> None:
        self.name = name or unique_name()
        self.config = folder / f"{self.name}.toml"
        self.config.write_text(config_text() if config is None else config)
        self.python = sys.executable  # that runs the service and its commands
        self.process: subprocess.Popen[str] | None = None
        self.world: World | None = None  # the ground truth of a simulated sensor, when there is one

    def settings(self) -> ServiceConfig:
        """Its configuration, under its own name."""
        return msgspec.structs.replace(load_config(self.config), name=self.name)

    def command(self, verb: str, *words: str) -> list[str]:
        return [self.python, "-m", "surffollow", verb, "--name", self.name, *words]

    def start_command(self) -> list[str]:
        return self.command("start", "--quiet", "--config", str(self.config))

    def run(self, verb: str, *words: str) -> subprocess.CompletedProcess[str]:
        """Run one verb of the command line to its end."""
        return run_command(self.command(verb, *words))

    def launch(self, **options: Any) -> subprocess.Popen[str]:
        """Start without waiting, from nothing: the interpreter is executed."""
        words = self.start_command()
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        self.process = subprocess.Popen(words, text=True, **pipes | options)
        return self.process

    def begin(self) -> subprocess.Popen[str]:
        """Start without waiting, forked (`forked_start`)."""
        self.process = fork_start(self.start_command(), subprocess.PIPE) or self.launch()
        return self.process

    def start(self, **options: Any) -> Self:
        """Start and wait for READY; with options from nothing, else forked (`forked_start`)."""
        return self._await_ready(self.launch(**options) if options else self.begin())

    def start_logged(self, log: Path) -> Self:
        """Start with the standard error in a file, and wait for READY."""
        with log.open("w") as err:
            self.process = fork_start(self.start_command(), err.fileno()) or self.launch(stderr=err)
        return self._await_ready(self.process)

    def _await_ready(self, process: subprocess.Popen[str]) -> Self:
        assert process.stdout is not None
        line = process.stdout.readline()
        if not line.startswith("READY"):
            _, error = process.communicate(timeout=READY_S)
            raise AssertionError(f"the service did not start: {line!r} {error}")
        return self

    @contextlib.contextmanager
    def recorder(self, out: Path) -> Iterator[subprocess.Popen[str]]:
        """Its recorder, which prints its counts as JSON at its end; killed at the end of this."""
        words = self.command("record", "--out", str(out), "--json")
        child = fork_start(words) or subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        try:
            yield child
        finally:
            child.kill()
            child.communicate()

    @property
    def pid(self) -> int:
        assert self.process is not None
        return self.process.pid

    def send(self, number: int) -> None:
        """Send it a signal."""
        os.kill(self.pid, number)

    def freeze(self) -> None:
        """SIGSTOP, and wait until every thread of it stands still."""
        freeze(self.pid)

    def kill(self) -> None:
        """SIGKILL: nothing is tidied up."""
        assert self.process is not None
        self.process.kill()
        self._reap()

    def terminate(self, number: int = signal.SIGTERM) -> int:
        """Ask it to end; its exit code."""
        assert self.process is not None
        self.process.send_signal(number)
        code = self.process.wait(timeout=WAIT_S)
        self._reap()
        return code

    def stop(self) -> None:
        """End it in good order and remove all that it left, the map too, but not the world."""
        if self.process is not None:
            assert self.terminate() == 0
        for part in OWN_OBJECTS:
            unlink(self.name + part)

    def _reap(self) -> None:
        process, self.process = self.process, None
        if process is not None:
            process.communicate(timeout=WAIT_S)

    def purge(self) -> None:
        """End it in any state and remove all that it left."""
        if self.process is not None:
            self.process.kill()
            self._reap()
        for part in OBJECTS:
            unlink(self.name + part)

    def attach(self, **options: Any) -> Client:
        """A client; it bears `PATIENT_S` of silence unless an option names another time."""
        return attach(self.name, **_patient(options))

    def observe(self, **options: Any) -> Observer:
        """An observer; it bears `PATIENT_S` of silence unless an option names another time."""
        return observe(self.name, **_patient(options))

    def cycles(self, n: int) -> None:
        """Wait until the service has run `n` more cycles."""
        with self.observe() as watcher:
            start = watcher.status()["cycles"]
            until(lambda: watcher.status()["cycles"] >= start + n, f"{n} cycles")


@contextlib.contextmanager
def over_ground(folder: Path, text: str, started: bool = True) -> Iterator[Service]:
    """A service with a simulated sensor 0.1 m over flat ground, purged at the end."""
    s = Service(folder, text)
    s.world = world = World(s.name)
    try:
        yield s.start() if started else s
    finally:
        s.purge()
        world.close()


@contextlib.contextmanager
def program(code: str, *words: str, before: Sequence[str] = ()) -> Iterator[subprocess.Popen[str]]:
    """A Python program beside the test, killed at the end; `before` runs it, e.g. as another user."""
    pipe = subprocess.PIPE
    child = subprocess.Popen(
        [*before, sys.executable, "-c", code, *words], stdin=pipe, stdout=pipe, stderr=pipe, text=True
    )
    try:
        yield child
    finally:
        child.kill()
        child.communicate()


def said(child: subprocess.Popen[str]) -> str:
    """The next line that a program printed."""
    assert child.stdout is not None
    line = child.stdout.readline().strip()
    if not line:
        _, error = child.communicate(timeout=WAIT_S)
        raise AssertionError(f"the program ended: {error}")
    return line


class World:
    """Publishes where the simulated tool truly is, 200 times a second, over flat ground at height 0."""

    def __init__(self, name: str, pose: Sequence[float] = POSE) -> None:
        self.pose = tuple(pose)
        self._writer, self._over = WorldWriter(name), threading.Event()
        self._thread = threading.Thread(target=self._publish, daemon=True)
        self._thread.start()

    def _publish(self) -> None:
        record = zeros(WorldPose)
        while not self._over.wait(0.005):
            record[0]["pose"], record[0]["t_ns"] = self.pose, time.monotonic_ns()
            self._writer.write(record)

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self._writer.close()


def take_pose(client: Client) -> None:
    """Send a pose though its last holder has only just died; the service sees that within 50 ms."""

    def taken() -> bool:
        with contextlib.suppress(BusyError):
            client.ee_pos(POSE)
            return True
        return False

    until(taken, "a free pose", 20.0)


def drive(
    client: Client, condition: Callable[[], Any], pose: Sequence[float] = POSE, what: str = "it"
) -> Any:
    """Send a pose again and again until the condition holds; what it gave."""

    def step() -> Any:
        with contextlib.suppress(NotRunningError):  # of a service that was started again it is claimed anew
            client.ee_pos(pose)
        return condition()

    return until(step, what)
