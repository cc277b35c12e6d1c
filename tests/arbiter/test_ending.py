"""The arbiter's end: a signal ends it whichever thread receives it and whatever the main thread does."""

from __future__ import annotations

import ctypes
import json
import os
import platform
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from click.testing import CliRunner

from arbiter.arbiter_process import CONFIG
from running_service import WAIT_S, until
from surffollow.arbiter.config import parse_config
from surffollow.arbiter.server import Server
from surffollow.cli.arbiter import arbiter_group
from surffollow.errors import NoPermissionError
from surffollow.shm.ending_signals import ending_signals, handle_ending

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

TGKILL = {"x86_64": 234, "aarch64": 131}


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
@pytest.mark.skipif(platform.machine() not in TGKILL, reason="the number of tgkill is not known here")
def test_a_signal_that_does_not_interrupt_the_wait_for_clients_ends_the_arbiter(make_arbiter, number):
    """GIVEN a main thread that sleeps WHEN another thread receives the signal THEN the arbiter ends.

    Python's handlers run in the main thread between bytecodes. A signal just before its wait has the
    same effect as this one.
    """
    # GIVEN an arbiter without clients, whose main thread waits without a time limit
    arbiter = make_arbiter().start()
    pid = arbiter.process.pid
    main = Path(f"/proc/{pid}/task/{pid}/wchan")
    until(lambda: "poll" in main.read_text(), "wait for clients")
    others = [int(p.name) for p in Path(f"/proc/{pid}/task").iterdir() if int(p.name) != pid]
    # WHEN the signal goes to a thread that is not the main one
    assert ctypes.CDLL(None).syscall(TGKILL[platform.machine()], pid, others[0], int(number)) == 0
    # THEN it ends, and leaves nothing
    assert arbiter.process.wait(timeout=WAIT_S) == 0
    assert not list(Path("/dev/shm").glob(f"{arbiter.name}*"))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_ends_a_compilation(make_arbiter, tmp_path, number):
    def compile_and_signal(attempt: int) -> str:
        # GIVEN an arbiter that compiles its kernels: its cache is empty
        arbiter = make_arbiter()
        words = [sys.executable, "-m", "surffollow", "arbiter", "start", "--name", arbiter.name]
        cache = tmp_path / f"cache{attempt}"
        env = os.environ | {"SURFFOLLOW_CACHE_DIR": str(cache)}
        pipe = subprocess.PIPE
        arbiter.process = subprocess.Popen([*words, str(arbiter.path)], stdout=pipe, text=True, env=env)
        # the handlers of the server stand before the first kernel
        until(lambda: list(cache.rglob("*.nbc")), "a kernel")
        # WHEN a signal comes, THEN it ends and leaves nothing
        arbiter.process.send_signal(number)
        out, _ = arbiter.process.communicate(timeout=WAIT_S)
        assert arbiter.process.returncode == 0
        assert not list(Path("/dev/shm").glob(f"{arbiter.name}*"))
        return out

    # on a busy machine a signal may come when the compilation is over; it does not each time
    assert any(compile_and_signal(attempt) == "" for attempt in range(5))


def test_a_signal_between_the_handlers_is_not_lost(monkeypatch):
    """GIVEN a signal right behind its handler THEN the arbiter does not start; it went on, and was READY."""
    config = parse_config(tomllib.loads(CONFIG.replace("MORE_CLIENTS", "")) | {"name": f"h{os.getpid()}"})
    before = {n: signal.getsignal(n) for n in ending_signals()}

    def handle_and_signal(handler):
        handle_ending(handler)
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr("surffollow.arbiter.server.handle_ending", handle_and_signal)
    server, announced = Server(config), []
    try:
        server.run(lambda: announced.append(server.stop()))
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert announced == []


def test_the_status_of_a_server_that_starts_says_so():
    """GIVEN a server that has made its board and is not ready WHEN its status is asked for THEN it starts."""
    name = f"s{os.getpid()}"
    server = Server(parse_config(tomllib.loads(CONFIG.replace("MORE_CLIENTS", "")) | {"name": name}))
    try:
        text, report = (
            CliRunner().invoke(arbiter_group, ["status", "--name", name, *more]) for more in ((), ("--json",))
        )
    finally:
        server._end(threading.Thread())
    assert f"arbiter {name} starts, pid {os.getpid()}" in text.output
    said = json.loads(report.output)
    assert (said["alive"], said["starting"]) == (False, True)
    assert (text.exit_code, report.exit_code) == (3, 3)


def test_a_server_that_cannot_start_gives_its_descriptors_back(monkeypatch):
    """GIVEN a start that fails WHEN it is tried again and again THEN no descriptor is kept."""
    config = parse_config(tomllib.loads(CONFIG.replace("MORE_CLIENTS", "")) | {"name": f"e{os.getpid()}"})

    def refuse(*_):
        raise NoPermissionError("no")

    monkeypatch.setattr("surffollow.arbiter.server.CommandBlock", refuse)
    counts = set()
    for _ in range(3):
        with pytest.raises(NoPermissionError):
            Server(config)
        counts.add(len(os.listdir("/proc/self/fd")))
    assert len(counts) == 1
