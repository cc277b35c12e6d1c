"""Commands of the package that start in 0.1 s: forked from a process that has loaded every kernel.

`surffollow start` costs 1.3 s of processor time, nearly all of it imports and the loading of kernels, and the
tests start some hundreds. `fork_start` runs the same command line, with the same standard files, environment
and folder, in a child of one template process for each test process. Tests of a start from nothing
(modules loaded, signals before READY, refused starts) use `Service.launch`, which executes the interpreter.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import json
import os
import random
import select
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

MESSAGE = 1 << 20
READY_S = 1200.0  # on a busy machine with a cold kernel cache
ADDED = ("PYTEST_", "GDAL_", "PROJ_")
_templates: dict[int, Template] = {}
_environment: dict[str, str] = {}  # of the tests, before any of them changes it


class Template:
    """The process that is forked, of one test process."""

    def __init__(self, environment: dict[str, str]) -> None:
        self.environment = environment
        self.socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, __file__, str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                env=environment,
            )
        self.socket.settimeout(READY_S)
        assert self.socket.recv(MESSAGE) == b"ready", "no process to fork from: see its message on stderr"
        atexit.register(self.socket.close)

    def fork(self, words: Sequence[str], files: Sequence[int]) -> int:
        """Start a child on those words with those standard files; its pid."""
        request = json.dumps({"words": list(words), "cwd": os.getcwd(), "environment": dict(os.environ)})
        socket.send_fds(self.socket, [request.encode()], list(files))
        return int(self.socket.recv(MESSAGE))


def _own_environment() -> dict[str, str]:
    """Environment variables that an import may read, without those that pytest and rasterio add."""
    return {name: value for name, value in os.environ.items() if not name.startswith(ADDED)}


class ForkedProcess(subprocess.Popen[str]):
    """A child of the template; its exit code comes through a pipe."""

    def __init__(
        self, template: Template, words: Sequence[str], stderr: int | None, stdin: int | None
    ) -> None:
        self._template = template
        super().__init__(words, stdin=stdin, stdout=subprocess.PIPE, stderr=stderr, text=True)

    def _execute_child(self, *arguments: Any) -> None:
        words, pipes = arguments[0], arguments[10:16]
        ended, end_fd = os.pipe()
        try:
            given = [max(pipes[0], 0), pipes[3], 2 if pipes[5] < 0 else pipes[5]]
            self.pid = self._template.fork(words, [*given, end_fd])
        finally:
            os.close(end_fd)
            self._close_pipe_fds(*pipes)  # type: ignore[attr-defined]
        self._ended = ended
        self._child_created = True

    def _internal_poll(self, *_: Any, **__: Any) -> int | None:
        if self.returncode is None:
            pid, status = self._try_wait(os.WNOHANG)
            if pid:
                self._handle_exitstatus(status)  # type: ignore[attr-defined]
        return self.returncode

    def _try_wait(self, wait_flags: int) -> tuple[int, int]:
        """As of `Popen`: the pid and the wait status, or zeros."""
        if not select.select([self._ended], [], [], 0.0 if wait_flags else None)[0]:
            return 0, 0
        said = os.read(self._ended, 16)
        os.close(self._ended)
        return self.pid, int(said) if said else signal.SIGKILL


def note_environment() -> None:
    """Remember the environment that a template is to have: called before the first test."""
    _environment.update(_own_environment())


def fork_start(
    words: Sequence[str], stderr: int | None = None, stdin: int | None = None
) -> subprocess.Popen[str] | None:
    """Run `python -m surffollow …` as a fork; its stdout is a pipe, `stderr` and `stdin` as of `Popen`.

    None when the words run another interpreter or program, or when this process changed its environment.
    """
    if list(words[:3]) != [sys.executable, "-m", "surffollow"]:
        return None
    if not _environment:  # no test, but a bench
        note_environment()
    if _environment != _own_environment():
        return None
    template = _templates.get(os.getpid())
    if template is None:
        template = _templates[os.getpid()] = Template(dict(_environment))
    return ForkedProcess(template, words[3:], stderr, stdin)


# -- the template process -------------------------------------------------------------------------


def load() -> None:
    """Run a service with a simulated sensor and an arbiter once, to their end."""
    from arbiter.arbiter_process import ArbiterProcess
    from running_service import Service, config_text
    from surffollow.arbiter.config import load_config
    from surffollow.arbiter.server import Server
    from surffollow.service.daemon import Daemon

    with tempfile.TemporaryDirectory() as folder:
        once = Service(Path(folder), config_text(kind="simulated"))
        try:
            daemon = Daemon(once.settings(), quiet=True)
            daemon.run(on_ready=daemon.stop)
        finally:
            once.purge()
        shared = ArbiterProcess(Path(folder))
        try:
            server = Server(msgspec.structs.replace(load_config(shared.path), name=shared.name))
            server.run(on_ready=server.stop)
        finally:
            shared.purge()


def serve(link: socket.socket) -> dict[str, Any] | None:
    """Fork at every request; in a child what was asked, in the template None at the end."""
    ends: dict[int, int] = {}  # pid: pipe
    wake, waker = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.set_wakeup_fd(waker)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    link.send(b"ready")
    while True:
        with contextlib.suppress(BlockingIOError):
            os.read(wake, 4096)
        _report(ends)
        if link.fileno() not in select.select([link.fileno(), wake], [], [])[0]:
            continue
        data, files, _, _ = socket.recv_fds(link, MESSAGE, 4)
        if not data:
            return None
        pid = os.fork()
        if pid == 0:
            signal.set_wakeup_fd(-1)
            for number, file in enumerate(files[:3]):
                os.dup2(file, number)
            os.closerange(3, max(*files, wake, waker, link.detach(), *ends.values()) + 1)
            return dict(json.loads(data))
        ends[pid] = files[3]
        for file in files[:3]:
            os.close(file)
        link.send(b"%d" % pid)


def _report(ends: dict[int, int]) -> None:
    """Tell how children ended."""
    while ends:
        pid, status = os.waitpid(-1, os.WNOHANG)
        if pid == 0:
            return
        pipe = ends.pop(pid)
        with contextlib.suppress(OSError):  # no process waits for it
            os.write(pipe, b"%d" % status)
        os.close(pipe)


def become(asked: dict[str, Any]) -> None:
    """Run `python -m surffollow WORDS` in a fresh child."""
    for number, action in (
        (signal.SIGINT, signal.default_int_handler),
        *((n, signal.SIG_DFL) for n in (signal.SIGHUP, signal.SIGTERM, signal.SIGCHLD, signal.SIGIO)),
    ):
        signal.signal(number, action)
    os.environ.clear()
    os.environ.update(asked["environment"])
    os.chdir(asked["cwd"])
    random.seed()
    sys.stdin = open(0, closefd=False)  # noqa: SIM115
    sys.stdout = open(1, "w", buffering=1, closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115
    from surffollow.cli.main import main

    sys.argv = ["surffollow", *asked["words"]]
    main()


if __name__ == "__main__":
    load()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # its end is the end of the test process
    gc.collect()
    gc.freeze()
    asked = serve(socket.socket(fileno=int(sys.argv[1])))
    if asked is not None:
        become(asked)
