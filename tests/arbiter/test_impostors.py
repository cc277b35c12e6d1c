"""Another user under an arbiter's names: no client obeys, asks or trusts it without naming it."""

from __future__ import annotations

import contextlib
import os
import pwd
import signal
import socket
import subprocess
import sys
import threading
import time
import uuid
from pathlib import Path

import msgspec
import pytest

from arbiter.arbiter_process import CONFIG, compile_client, compile_waiting
from running_service import until
from second_user import NOBODY, OtherUser, as_other_user, needs_root, outcome
from surffollow.arbiter import attach, command_reader, observe
from surffollow.arbiter import handshake as hs
from surffollow.arbiter.config import load_config, parse_config
from surffollow.arbiter.name_owner import read_old_board
from surffollow.arbiter.server import Server
from surffollow.errors import AlreadyRunningError, BlockError, NoPermissionError, NotRunningError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

pytestmark = needs_root
BOTH = f"user {NOBODY}, expected user 0"
OPEN = 'users = ["*"]\nmode = "0644"\n' + CONFIG.replace("MORE_CLIENTS", "patrol = 10")


class GenuineServer:
    """Root's arbiter, in a forked child that need not load the kernels."""

    def __init__(self, path: Path) -> None:
        self.name, self.config = path.stem, load_config(path)
        self._child: OtherUser | None = None

    def start(self) -> None:
        def work(child: OtherUser) -> str:
            Server(self.config).run(lambda: child.say("READY"))
            return "ended"

        self._child = OtherUser(work, uid=0)
        assert self._child.receive() == "READY"

    def stop(self) -> None:
        assert self._child is not None
        os.kill(self._child.pid, signal.SIGTERM)
        assert self._child.receive() == "ended"
        self._child.end()
        self._child = None

    def purge(self) -> None:
        if self._child is not None:
            self._child.end()
        for left in Path("/dev/shm").glob(f"{self.name}*"):
            left.unlink()


@pytest.fixture(scope="module")
def loaded():
    """The server's kernels, for all children."""
    warm = Server(parse_config(tomllib.loads(OPEN) | {"name": f"warm{os.getpid()}"}))
    thread = threading.Thread(target=lambda: warm.run(warm.stop))
    thread.start()
    thread.join()


@pytest.fixture
def genuine(tmp_path, loaded):
    """Root's arbiter, not started."""
    path = tmp_path / f"i{uuid.uuid4().hex[:10]}.toml"
    path.write_text(f'name = "{path.stem}"\n' + OPEN)
    one = GenuineServer(path)
    try:
        yield one
    finally:
        one.purge()


@contextlib.contextmanager
def impostor_of(genuine):
    """Another user's arbiter of the same name, whose client drives at full speed."""
    config = genuine.config

    def work(child):
        server = Server(config)
        serving = threading.Thread(target=lambda: server.run(lambda: None))
        serving.start()
        one = attach(config.name, "avoid")
        robot = one.resource("robot")
        assert robot.request()
        robot.command(0.5, 1.0)
        child.say("there")
        threading.Thread(target=lambda: (child.receive(), server.stop()), daemon=True).start()
        until(lambda: not (robot.command(0.5, 1.0) or one.connected), seconds=float("inf"))
        serving.join()
        return "ended"

    with OtherUser(work) as other:
        assert other.receive() == "there"
        yield other
    for left in Path("/dev/shm").glob(f"{genuine.name}*"):
        left.unlink()  # as root does: no server of another user would


def names_of(arbiter):
    return {e["name"] for e in arbiter.status()["clients"]}


def test_an_impostor_after_a_clean_stop_commands_no_controller_and_gets_no_client(genuine):
    # GIVEN a holder that commands, and a controller
    genuine.start()
    client = attach(genuine.name, "go")
    with command_reader(genuine.name, "robot") as reader:
        robot = client.resource("robot")
        assert robot.request()
        until(lambda: robot.command(0.2, 0.1) and not reader.latest().safe)
        # WHEN the arbiter ends and another user starts one of its name
        genuine.stop()
        until(lambda: reader.latest().safe)
        with impostor_of(genuine):
            # THEN the controller stays safe, and no client attaches to it
            until(lambda: BOTH in reader.refusal or not reader.latest().safe)
            assert reader.latest().values == (0.0, 0.0)
            for action in (
                lambda: attach(genuine.name, "go"),
                lambda: client.reattach(),
                lambda: observe(genuine.name),
                lambda: command_reader(genuine.name, "robot"),
                lambda: client.reattach(),
            ):
                with pytest.raises(NoPermissionError, match=BOTH):
                    action()
            assert reader.latest().safe
        # WHEN the first user starts it again, THEN both follow it
        genuine.start()
        with client.reattach() as again:
            robot = again.resource("robot")
            assert robot.request()
            until(lambda: robot.command(0.2, 0.1) and not reader.latest().safe)
            assert reader.refusal == ""
    genuine.stop()


def test_who_is_named_is_trusted_and_no_other_from_the_first_attachment_on(genuine, monkeypatch):
    # GIVEN another user's arbiter
    with impostor_of(genuine) as impostor:
        # WHEN a client names that user, THEN it attaches
        with attach(genuine.name, "go", owner=NOBODY) as one, observe(genuine.name, owner=NOBODY) as seen:
            assert one.owner == NOBODY
            assert not one.resource("robot").request()
            assert names_of(seen) == {"avoid", "go"}
            with command_reader(genuine.name, "robot", owner=NOBODY) as reader:
                until(lambda: reader.latest().values == (0.5, 1.0))
        # WHEN it names a third one, THEN it is refused
        with pytest.raises(NoPermissionError, match=f"user {NOBODY}, expected user 12345"):
            attach(genuine.name, "go", owner=12345)
        monkeypatch.setenv("SURFFOLLOW_OWNER", str(NOBODY))
        # GIVEN a client and a controller that trust the other user by the environment
        first = attach(genuine.name, "go")
        reader = command_reader(genuine.name, "robot")
        until(lambda: not reader.latest().safe)
        impostor.say("stop")
        assert impostor.receive() == "ended"
    monkeypatch.delenv("SURFFOLLOW_OWNER")
    # WHEN root starts an arbiter of the name
    genuine.start()  # root's: trusted by default, but not whom those two attached to
    # THEN these two do not follow it, and new ones do
    with pytest.raises(NoPermissionError, match=f"user 0, expected user {NOBODY}"):
        first.reattach()
    with attach(genuine.name, "go") as one, command_reader(genuine.name, "robot") as new:
        robot = one.resource("robot")
        assert robot.request()
        until(lambda: robot.command(0.2, 0.1) and not new.latest().safe)
        until(lambda: reader.latest().safe and f"user 0, expected user {NOBODY}" in reader.refusal)
    genuine.stop()
    reader.close()


def test_only_whom_users_names_may_attach(genuine):
    def try_it(_):
        return outcome(lambda: attach(genuine.name, "go", owner=0).close())

    # WHEN no other user is named, THEN another user is refused
    genuine.config = msgspec.structs.replace(genuine.config, users=())
    genuine.start()
    assert "RefusedError" in as_other_user(try_it)
    genuine.stop()
    # WHEN he is named, THEN he attaches
    name = pwd.getpwuid(NOBODY).pw_name
    genuine.config = msgspec.structs.replace(genuine.config, users=(name,))
    genuine.start()
    assert as_other_user(try_it) == "done"
    genuine.stop()


def fill_backlog(name):
    """Connect until the next to connect would wait."""
    while True:
        waiting = hs.new_socket()
        waiting.setblocking(False)
        try:
            waiting.connect(hs.address(name))
        except BlockingIOError:
            waiting.close()
            return
        kept.append(waiting)


kept: list[socket.socket] = []


def test_a_squatter_keeps_no_client_waiting_and_is_named(genuine):
    def occupy_name(child):
        sock = hs.new_socket()
        sock.bind(hs.address(genuine.name))
        sock.listen(8)
        child.say("there")
        child.receive()
        fill_backlog(genuine.name)
        child.say("full")
        signal.pause()

    with OtherUser(occupy_name) as squatter:
        # GIVEN another user's process that has the name and never answers
        assert squatter.receive() == "there"
        # WHEN an arbiter or a client wants it, THEN it is told whose it is
        with pytest.raises(AlreadyRunningError, match=rf"process {squatter.pid} of user {NOBODY}"):
            hs.listen(genuine.name)
        with pytest.raises(NoPermissionError, match=BOTH):
            attach(genuine.name, "go")
        # WHEN not even a connection is taken, THEN no client waits longer than it must
        squatter.say("fill")
        assert squatter.receive() == "full"
        with pytest.raises(NotRunningError):
            attach(genuine.name, "go", timeout_s=0.1)


def test_a_board_that_another_user_made_is_not_taken_over(genuine):
    path = f"/dev/shm/{genuine.name}.arbiter"

    def make(_):
        with open(path, "wb") as file:
            file.write(bytes(8192))
        os.chmod(path, 0o666)

    assert as_other_user(lambda child: outcome(lambda: make(child))) == "done"
    try:
        with pytest.raises(NoPermissionError, match=BOTH):
            read_old_board(f"{genuine.name}.arbiter")
    finally:
        os.unlink(path)


def test_a_server_that_may_not_write_a_command_block_leaves_nothing_behind(genuine):
    # GIVEN a file of another user in the place of a command block
    path = Path(f"/dev/shm/{genuine.name}.speaker")
    assert as_other_user(lambda _: outcome(lambda: path.write_bytes(bytes(8192)))) == "done"
    # WHEN the server starts, THEN it fails and leaves nothing
    with pytest.raises((BlockError, NoPermissionError)):
        Server(genuine.config)
    assert [p.name for p in Path("/dev/shm").glob(f"{genuine.name}*")] == [path.name]
    # WHEN the file is gone, THEN it starts
    path.unlink()
    genuine.start()  # and does not keep the name
    genuine.stop()


# -- the header in C ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def patrol(tmp_path_factory):
    return compile_client(tmp_path_factory.mktemp("patrol"))


def run_patrol(patrol, name, seconds, **environment):
    return subprocess.run(
        [str(patrol), name, seconds], capture_output=True, text=True, env=os.environ | environment, timeout=60
    )


def test_a_client_in_c_refuses_another_users_arbiter_unless_he_is_named(genuine, patrol):
    with impostor_of(genuine):
        # WHEN a C client names no user, THEN it refuses another user's arbiter
        done = run_patrol(patrol, genuine.name, "0.2")
        assert (done.returncode, done.stdout) == (1, "")
        assert "a user who is not trusted" in done.stderr
        # WHEN it names that user, THEN it attaches
        done = run_patrol(patrol, genuine.name, "0.2", SURFFOLLOW_OWNER=str(NOBODY))
        assert done.returncode == 0, done.stderr
        assert "granted the cart 0 times" in done.stdout


def test_a_client_in_c_attaches_again_to_the_same_user_only(genuine, patrol):
    # GIVEN a C client of root's arbiter, which trusts another user too
    genuine.start()
    words = [str(patrol), genuine.name, "60"]
    environment = os.environ | {"SURFFOLLOW_OWNER": str(NOBODY)}  # trusted at first, but the pin is root's
    with subprocess.Popen(words, env=environment) as running:
        try:
            with observe(genuine.name) as seen:
                until(lambda: seen.holder("robot") is not None)
            # WHEN that user starts an arbiter of the name, THEN the client does not attach
            genuine.stop()
            with impostor_of(genuine), observe(genuine.name, owner=NOBODY) as seen:
                history = seen.history(oldest=True)
                began = time.monotonic()
                until(lambda: time.monotonic() - began > 0.5)  # it tries every 20 ms
                assert {e.client for e in history if e.event == "ATTACH"} == {1}
            # WHEN root starts it again, THEN it does
            genuine.start()
            with observe(genuine.name) as seen:
                until(lambda: (h := seen.holder("robot")) is not None and h.name == "patrol")
        finally:
            running.kill()
    genuine.stop()


def test_a_client_in_c_waits_no_longer_than_configured_for_a_squatter(genuine, tmp_path):
    impatient = compile_waiting(tmp_path, 500)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sock:
        sock.bind(hs.address(genuine.name))
        sock.listen(0)
        fill_backlog(genuine.name)
        done = run_patrol(impatient, genuine.name, "1")
        assert done.returncode == 1
        assert "did not answer in time" in done.stderr
        kept.clear()
