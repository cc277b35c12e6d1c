"""Lines of the service's log: no reader, a stopped terminal, a closed standard error, floods."""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import pytest

from forked_start import fork_start
from running_service import WAIT_S, Service, until
from service.working_client import Make, goes_on
from surffollow.client import Client
from surffollow.errors import SurffollowError
from surffollow.service.messages import BURST, RESERVED, WAITING, Messages

F_SETPIPE_SZ = 1031


def start_with(s: Service, stderr: int, *before: str) -> Service:
    """Start with a standard error of the test's own; `before` runs the command, e.g. a shell."""
    words = [*before, *s.command("start", "--config", str(s.config))]
    s.process = fork_start(words, stderr) or subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=stderr, text=True
    )
    assert s.process.stdout is not None
    line = s.process.stdout.readline()
    assert line.startswith("READY"), line
    return s


def chatter(client: Client) -> None:
    """Make the service log as much as a client can cause, which is more than a small pipe holds."""
    for _ in range(40):
        client.set_params(max_demand="20 mm")
        client.stop("x" * 63)
    until(lambda: len(client.audit()) >= 60, "the entries that these lines are of")


@contextlib.contextmanager
def stopped_terminal() -> Iterator[int]:
    """A terminal whose other side reads nothing."""
    other, terminal = os.openpty()
    try:
        yield terminal
    finally:
        os.close(other)
        os.close(terminal)


@contextlib.contextmanager
def stopped_reader() -> Iterator[int]:
    """A full pipe into a process that is stopped, as a pager or a log shipper may be."""
    reader = subprocess.Popen(["cat"], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
    assert reader.stdin is not None
    fcntl.fcntl(reader.stdin.fileno(), F_SETPIPE_SZ, 4096)
    reader.send_signal(signal.SIGSTOP)
    try:
        yield reader.stdin.fileno()
    finally:
        reader.kill()
        reader.communicate()


@contextlib.contextmanager
def gone_reader() -> Iterator[int]:
    """A pipe whose reader is gone."""
    out, into = os.pipe()
    os.close(out)
    try:
        yield into
    finally:
        os.close(into)


@pytest.mark.parametrize("stderr", [stopped_terminal, stopped_reader, gone_reader])
def test_a_log_that_is_not_read_neither_ends_nor_stops_the_heartbeat(
    make_service: Make, stderr: Callable[[], contextlib.AbstractContextManager[int]]
) -> None:
    # GIVEN a service whose standard error has no reader
    with stderr() as fd:
        s = start_with(make_service(), fd)
        with s.attach() as client:
            # WHEN it has much to tell, THEN it goes on
            chatter(client)
            goes_on(client)
        # WHEN it is asked to end, THEN it does so in time
        began = time.monotonic()
        assert s.terminate() == 0
        assert time.monotonic() - began < WAIT_S, "the queue was not waited for"


IN_THE_BACKGROUND = """
import os, signal, sys, termios
os.setsid()
terminal = os.open(sys.argv[1], os.O_RDWR)  # it becomes this session's
how = termios.tcgetattr(terminal)
how[3] |= termios.TOSTOP
termios.tcsetattr(terminal, termios.TCSANOW, how)
for fd in (1, 2):
    os.dup2(terminal, fd)
child = os.fork()
if child == 0:
    os.setpgid(0, 0)  # not the terminal's foreground group: a line would stop it
    os.execvp(sys.argv[2], sys.argv[2:])
os.waitpid(child, os.WUNTRACED)
"""


def test_a_service_in_the_background_of_a_terminal_is_not_stopped_by_its_own_lines(
    make_service: Make,
) -> None:
    s = make_service()
    other, terminal = os.openpty()
    words = s.command("start", "--config", str(s.config))
    command = [sys.executable, "-c", IN_THE_BACKGROUND, os.ttyname(terminal), *words]
    with subprocess.Popen(command) as session:
        try:
            until(lambda: is_ready(s), "a service that runs")
            with s.attach() as client:
                chatter(client)
                goes_on(client)
            s.run("stop")
            session.wait(WAIT_S)
        finally:
            session.kill()
            os.close(other)
            os.close(terminal)


def is_ready(s: Service) -> bool:
    with contextlib.suppress(SurffollowError):
        s.attach().close()
        return True
    return False


def test_with_standard_error_closed_no_message_lands_in_a_shared_object(make_service: Make) -> None:
    # GIVEN a service without a standard error
    s = start_with(make_service(), subprocess.DEVNULL, "sh", "-c", 'exec "$@" 2>&-', "sh")
    assert os.readlink(f"/proc/{s.pid}/fd/2") == os.devnull
    with s.attach() as client:
        # WHEN it has much to tell, THEN it goes on, and its board is whole
        header = client.board.header()
        chatter(client)
        goes_on(client)
        assert client.board.header() == header


def test_the_rate_of_lines_is_limited_and_what_is_dropped_is_counted(
    capfd: pytest.CaptureFixture[str],
) -> None:
    # WHEN more lines are told than may be
    messages = Messages().start()
    for k in range(int(BURST) + 300):
        messages.report(f"line {k}")
    messages.end()
    lines = capfd.readouterr().err.splitlines()
    # THEN the first are written, and the rest is counted
    assert messages.lost >= 250
    assert lines[0] == "surffollow: line 0"
    assert sum(line.startswith("surffollow: line") for line in lines) + messages.lost == BURST + 300
    assert any("messages were lost" in line for line in lines)


def test_the_queue_is_bounded_when_nothing_is_written() -> None:
    messages = Messages()  # not started: a thread that never gets to write
    for _ in range(WAITING + RESERVED + 10):
        messages.write("x", limited=False)
    assert messages.lost == 10
    assert not messages.write("y"), "what may be dropped leaves the rest its room"
