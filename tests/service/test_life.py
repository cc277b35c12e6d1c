"""A service's life: start, READY, stop, signals, names, what is kept and what is removed."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from running_service import READY_S, WAIT_S, Service, drive, objects_of, run_command, until
from surffollow.cli.service import running_pid
from surffollow.client import attach
from surffollow.errors import (
    AlreadyRunningError,
    ConfigError,
    InvalidNameError,
    NoSpaceError,
    NotRunningError,
)
from surffollow.hw.registry import make_driver
from surffollow.service import shared_objects
from surffollow.shm import objects
from surffollow.shm.bit_names import GRANT_NAMES

Make = Callable[..., Service]
REGION = (0.0, 0.0, 0.1, 0.1)


def test_start_prints_ready_with_the_pid_and_status_knows_it(service: Service) -> None:
    done = service.run("status", "--json")
    assert done.returncode == 0, done.stderr
    status = json.loads(done.stdout)
    assert (status["state"], status["pid"], status["name"]) == ("ready", service.pid, service.name)
    assert status["cycles"] > 0
    assert status["params"]["offset_m"] == 0.1
    text = service.run("status").stdout
    assert f"service {service.name}: ready, pid {service.pid}" in text
    assert "standoff 100 mm" in text


def test_the_status_of_a_drone_is_in_metres(make_service: Make) -> None:
    # GIVEN a service that keeps 5 m, with a pose and a map
    window = 'range_min_m = "20 cm"\nrange_max_m = "50 m"'
    service = make_service(kind="external", driver=window, follow='offset = "5 m"').start()
    with service.attach() as client:
        client.map_reset((0.0, 0.0, 100.0, 100.0))
        drive(client, lambda: client.status()["follower"].get("tau_s", 0.0) > 0.0, what="an estimate")
        text = service.run("status").stdout
    # THEN its lengths have the unit of the stand-off
    assert "standoff 5 m\n" in text
    assert re.search(r"grids of [0-9.]+ m;", text), text
    assert re.search(r"noise [0-9.e-]+ m, roughness [0-9.e-]+ m, height σ [0-9.e-]+ m\n", text), text
    assert " mm" not in text


def test_status_tells_that_there_is_no_map_and_a_command_lays_one(service: Service) -> None:
    # GIVEN a service that nobody told a region, and samples
    with service.attach() as client:
        drive(client, lambda: client.status()["map"]["applied"] > 0, what="a sample")
        assert client.status()["map"]["state"] == "no_map"
        text = service.run("status").stdout
        assert "map      none" in text
        assert f"surffollow map reset X_MIN Y_MIN X_MAX Y_MAX --name {service.name}" in text
    # WHEN the command lays the map
    words = ["0", "0", "100mm", "0.1", "--name", service.name]
    done = run_command([service.python, "-m", "surffollow", "map", "reset", *words])
    # THEN samples get into it, and the status counts them
    assert done.returncode == 0, done.stderr
    with service.attach() as client:
        facts = drive(client, lambda: (m := client.status()["map"])["taken"] > 0 and m, what="a sample in it")
    assert (facts["state"], facts["nx"] > 10) == ("ready", True)
    assert "map      ready, " in service.run("status").stdout


def test_the_status_at_ready_has_the_grants_of_the_cycles_thread(make_service: Make) -> None:
    # GIVEN a service that stands still from READY on
    s = make_service().start()
    s.freeze()
    # WHEN its status is read, THEN every grant is told or its refusal
    with s.observe() as watcher:
        main = watcher.status()["main"]
    for n, name in enumerate(GRANT_NAMES):
        assert main["granted"] >> n & 1 or f"{name}: " in main["text"] or name == "mlockall"
    assert "compiling" not in main["text"]


def test_a_follower_without_poses_is_not_told_as_ok(own_service: Service) -> None:
    assert "follower adaptive, DROPOUT (no pose within its time-out)\n" in own_service.run("status").stdout


def test_a_second_service_of_the_same_name_is_refused_with_the_pid_of_the_first(service: Service) -> None:
    done = service.run("start", "--quiet")
    assert done.returncode == 1
    assert f"pid {service.pid}" in done.stderr
    assert "--name" in done.stderr
    assert service.run("status").returncode == 0, "the first service goes on"


def test_stop_ends_the_service_keeps_the_map_and_purge_removes_everything(make_service: Make) -> None:
    # GIVEN a service with a map
    s = make_service().start()
    with s.attach() as client:
        client.map_reset(REGION)
    # WHEN it is stopped, THEN its map alone is left
    assert s.process is not None
    done = s.run("stop", "--json")
    assert json.loads(done.stdout) == {"name": s.name, "pid": s.pid, "purged": False, "stop_kept": False}
    assert done.returncode == 0
    assert s.process.wait(WAIT_S) == 0
    assert objects_of(s.name) == {f"{s.name}.map"}
    # WHEN it is stopped again, THEN there is no service
    again = s.run("stop")
    assert again.returncode == 1
    assert "no service" in again.stderr
    # WHEN it is purged, THEN nothing is left
    done = s.run("stop", "--purge", "--json")
    assert json.loads(done.stdout) == {"name": s.name, "pid": None, "purged": True, "stop_kept": False}
    assert objects_of(s.name) == set()
    assert s.run("stop", "--purge").returncode == 1, "nothing is left to remove"


def listen(ear: socket.socket, received: list[str]) -> None:
    """Keep what comes until an empty message."""
    while message := ear.recv(4096).decode():
        received.append(message)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_ends_it_in_good_order_and_tells_systemd(
    make_service: Make, tmp_path: Path, number: int
) -> None:
    path = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ear:
        ear.bind(path)
        received: list[str] = []
        # as systemd does: who listens now and then lets the queue fill, and the service wait
        listener = threading.Thread(target=listen, args=(ear, received))
        listener.start()
        try:
            # GIVEN a service that tells systemd of itself
            s = make_service().start(env={**os.environ, "NOTIFY_SOCKET": path})
            until(lambda: len(received) >= 2, "two notifications")
            assert received[0].startswith("READY=1")
            assert "WATCHDOG=1" in received[1]
            # WHEN a signal asks it to end
            assert s.terminate(number) == 0
        finally:
            ear.sendto(b"", path)
            listener.join()
    # THEN it says so, and its map alone is left
    assert received[-1] == "STOPPING=1"
    assert objects_of(s.name) == {f"{s.name}.map"}


def test_a_terminal_ctrl_c_before_ready_leaves_nothing_that_stops_the_next_start(make_service: Make) -> None:
    # GIVEN a service that is starting
    s = make_service()
    process = s.launch()
    until(lambda: objects_of(s.name) or process.poll() is not None, "the first object", READY_S)
    # WHEN it is interrupted
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=READY_S)
    # THEN the next one starts
    s.start()
    until(
        lambda: s.run("status").returncode == 0, "a status without a fault"
    )  # a late cycle is one for a while


@pytest.mark.parametrize("name", ["a/b", "../x", "", "-x", "x" * 49, "a b", ".x"])
def test_a_name_that_a_path_could_misread_is_refused(name: str) -> None:
    with pytest.raises(InvalidNameError, match="not allowed"):
        attach(name)
    done = subprocess.run(
        [sys.executable, "-m", "surffollow", "start", "--name", name],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 2
    assert "not allowed" in done.stderr


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("perod = 1", "perod"),
        ('period = "1 furlong"', "period"),
        ('period = "1 mm"', "period"),
        ("period = 2.0", "period"),
        ("[map]\ngrids = 0", "map.grids"),
        ("[follow]\nintervall_size = 1", "intervall_size"),
        ('[follow]\ninterval_size = "2 s"', "interval_size"),
        ('[realtime]\noverrun = "panic"', "realtime.overrun"),
        ('[access]\nboard_mode = "rw"', "access.board_mode"),
        ('[access]\ngroup = "no-such-group"', "access.group"),
        ('[driver]\nkind = "crystal ball"', "crystal ball"),
        ("= nonsense", "TOML"),
    ],
)
def test_a_configuration_that_is_wrong_is_refused_by_its_key(
    make_service: Make, text: str, said: str
) -> None:
    s = make_service()
    s.config.write_text(text)

    def begin() -> None:
        config = s.settings()
        make_driver(config.driver, s.name)
        shared_objects.open_shared_objects(config)

    with pytest.raises(ConfigError, match=said):
        begin()
    assert objects_of(s.name) == set()


def test_a_wrong_configuration_ends_start_with_exit_code_1_and_one_line(make_service: Make) -> None:
    s = make_service()
    s.config.write_text('[map]\nfinest_grid = "1 parsec"')
    done = s.run("start", "--config", str(s.config))
    assert done.returncode == 1
    assert "map.finest_grid" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    done = s.run("start", "--config", "/nonexistent/x.toml")
    assert (done.returncode, "cannot read" in done.stderr) == (1, True)


def test_too_little_room_in_dev_shm_is_said_with_both_sizes_and_leaves_nothing(
    make_service: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Room:
        f_bavail, f_frsize = 100, 4096

    monkeypatch.setattr(objects.os, "statvfs", lambda _: Room)
    s = make_service(grids=1_000_000)
    with pytest.raises(NoSpaceError, match=r"needs .* MiB and /dev/shm has 0\.4 MiB free.*fewer map\.grids"):
        shared_objects.open_shared_objects(s.settings())
    assert objects_of(s.name) == set()


def test_start_in_a_tiny_dev_shm_fails_before_ready_with_one_line(make_service: Make) -> None:
    if os.geteuid() != 0 or shutil.which("unshare") is None:
        pytest.skip("needs root and unshare for a /dev/shm of its own")
    s = make_service(grids=4_000_000)
    script = 'mount -t tmpfs -o size=2m tmpfs /dev/shm && "$@"; code=$?; ls /dev/shm; exit $code'
    words = ["unshare", "-m", "sh", "-c", script, "-", *s.command("start", "--config", str(s.config))]
    done = subprocess.run(words, capture_output=True, text=True, timeout=READY_S)
    if "mount:" in done.stderr:
        pytest.skip("this machine lets nobody mount")
    assert done.returncode == 1
    assert "/dev/shm has" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert done.stdout == "", "neither READY nor an object is left"


def test_purge_after_a_sigkill_removes_what_was_left(own_service: Service) -> None:
    """GIVEN a killed service WHEN `stop --purge` runs THEN nothing is left: no robot followed it."""
    own_service.kill()
    assert own_service.run("stop", "--purge").returncode == 0
    assert objects_of(own_service.name) == set()


KILL_AT_EVERY_LINE = """
import os, signal, sys
from surffollow.config.service import load_config
from surffollow.service import shared_objects
from surffollow.service.name_owner import purge_map
from surffollow.shm import layout_board as lb
import msgspec
config = msgspec.structs.replace(load_config(sys.argv[1]), name=sys.argv[2])
FILES = ("shared_objects.py", "/objects.py", "header.py")

def die_at(left):
    def hook(frame, event, arg):
        nonlocal left
        if event == "line" and frame.f_code.co_filename.endswith(FILES):
            left -= 1
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)
        return hook
    return hook

lines, whole = 0, False
while not whole:
    lines += 1
    pid = os.fork()
    if pid == 0:
        sys.settrace(die_at(lines))
        shared_objects.open_shared_objects(config)
        os._exit(0)
    whole = os.waitpid(pid, 0)[1] == 0
    healed = shared_objects.open_shared_objects(config)
    healed.leave()
    purge_map(config.name)
    assert not [p for p in os.listdir("/dev/shm") if p.startswith(config.name)]
print(lines)
"""


def test_a_start_killed_at_any_line_leaves_nothing_that_stops_the_next_one(make_service: Make) -> None:
    s = make_service(grids=1000)
    words = [sys.executable, "-c", KILL_AT_EVERY_LINE, str(s.config), s.name]
    done = subprocess.run(words, capture_output=True, text=True, timeout=READY_S)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 50, "the start was cut at every one of its lines"


def test_without_a_service_every_verb_says_so(make_service: Make) -> None:
    s = make_service()
    for verb in ("status", "stop"):
        done = s.run(verb)
        assert done.returncode == 1
        assert s.name in done.stderr
    with pytest.raises(NotRunningError, match=s.name):
        s.attach()
    assert running_pid(s.name) == 0


def test_two_starts_at_once_give_one_service(make_service: Make) -> None:
    """GIVEN no service WHEN three start at once THEN one becomes READY and two are refused."""
    s = make_service()
    rivals = [s.begin() for _ in range(3)]
    s.process = None
    try:
        until(lambda: sum(r.poll() is not None for r in rivals) == 2, "two refusals", READY_S)
        [winner] = [r for r in rivals if r.poll() is None]
        assert winner.stdout is not None
        assert winner.stdout.readline().startswith("READY")
        assert running_pid(s.name) == winner.pid
        for r in rivals:
            if r is not winner:
                assert r.returncode == AlreadyRunningError.exit_code
    finally:
        for r in rivals:
            r.kill()
            r.communicate()
