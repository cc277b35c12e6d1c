"""Nothing on the main thread ends or freezes following: a full /dev/shm, a bad driver."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from running_service import READY_S, Service, objects_of, program, said, until
from service.working_client import Make, goes_on
from surffollow.service.driver_watch import DriverWatch
from surffollow.service.housekeeping import Guard
from surffollow.shm.objects import unlink

# a small /dev/shm of its own, which is filled up while the service runs
FULL = """
import os, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from running_service import Service, config_text, until, POSE
s = Service(Path(sys.argv[2]), config_text())
filler = os.open("/dev/shm/filler", os.O_WRONLY | os.O_CREAT)
def fill():
    try:
        while True:
            os.write(filler, bytes(4096))
    except OSError:
        pass
try:
    s.start()
    with s.attach() as client:
        client.ee_pos(POSE)
        fill()
        before = client.status()
        for _ in range(5):  # slots come and go
            with s.attach() as other:
                other.stop()
            client.reset_stop()
        client.map_reset((0.0, 0.0, 0.1, 0.1))
        until(lambda: client.status()["cycles"] > before["cycles"] + 200, "200 cycles")
        until(lambda: client.status()["main"]["t_ns"] > before["main"]["t_ns"], "a heartbeat")
        print("goes on", client.status()["main"]["text"], flush=True)
    print("end", s.terminate(), flush=True)
finally:
    s.purge()
"""


def may_mount() -> bool:
    done = shutil.which("unshare") and subprocess.run(
        ["unshare", "-m", "mount", "-t", "tmpfs", "tmpfs", "/dev/shm"], capture_output=True
    )
    return bool(done) and done.returncode == 0  # type: ignore[union-attr]


def test_a_full_dev_shm_takes_nothing_from_a_running_service(tmp_path: Path) -> None:
    if not may_mount():
        pytest.skip("needs a mount name space of its own: root, and unshare")
    tests = str(Path(__file__).parents[1])
    mount = 'mount -t tmpfs -o size=16m tmpfs /dev/shm && exec "$@"'
    with program(FULL, tests, str(tmp_path), before=("unshare", "-m", "sh", "-c", mount, "sh")) as child:
        assert said(child).startswith("goes on")
        assert said(child) == "end 0"


# a real service whose driver raises, or blocks, whenever it is asked, or a part of whose main thread raises
BAD_DRIVER = """
import sys, threading
from surffollow.config.service import load_config
from surffollow.service import daemon
import msgspec
class Bad:
    def __init__(self, inner): self.inner = inner
    @property
    def info(self): return self.inner.info
    def start(self, queue): self.inner.start(queue)
    def stop(self):
        if how == "blocks": threading.Event().wait()
        raise RuntimeError("broken stop")
    def faults(self):
        if how == "blocks": threading.Event().wait()
        raise RuntimeError("broken driver")
def fail(*words):
    raise OSError(28, "broken part")
how = sys.argv[3]
if how == "audit":
    daemon.Heartbeat.__init__.__globals__["AuditTrail"].publish = fail
elif how == "slots":
    serve, turns = daemon.SlotServer.serve, iter(range(10**9))
    daemon.SlotServer.serve = lambda *words: fail() if next(turns) % 5 == 4 else serve(*words)
else:
    make = daemon.make_driver
    daemon.make_driver = lambda *words: Bad(make(*words))
daemon.DRIVER_END_S = 0.2
daemon.serve(msgspec.structs.replace(load_config(sys.argv[1]), name=sys.argv[2]), quiet=True)
"""


@pytest.mark.parametrize(
    ("how", "text", "fault"),
    [
        ("raises", "broken driver", "DRIVER"),
        ("blocks", "has not answered", "DRIVER"),
        ("audit", "the audit trail failed", "HOUSEKEEPING"),
        ("slots", "serving the clients failed", "HOUSEKEEPING"),
    ],
)
def test_a_driver_or_a_part_of_the_main_thread_that_fails_is_a_fault_and_no_more(
    make_service: Make, how: str, text: str, fault: str
) -> None:
    # GIVEN a service with a driver, or a part, that fails
    s = make_service()
    with program(BAD_DRIVER, str(s.config), s.name, how) as service:
        assert said(service).startswith("READY")
        with s.attach() as client:
            # THEN the fault is told, and the service goes on
            until(lambda: text in client.status()["main"]["text"], text)
            assert fault in [f["name"] for f in client.status()["faults"]]
            goes_on(client)
        # WHEN it is asked to end, THEN it ends
        service.send_signal(signal.SIGTERM)
        assert service.wait(timeout=60) == 0, "it ends although the driver does not"


def test_a_service_whose_names_were_removed_says_so_and_takes_nothing_from_the_next(
    make_service: Make,
) -> None:
    # GIVEN a service that a client uses
    first, second = make_service().start(), make_service()
    second.name = first.name
    with first.attach() as client:
        # WHEN somebody removes its names, THEN it names them and the remedy, and goes on
        removed = objects_of(first.name)
        for name in removed:
            unlink(name)
        told = until(
            lambda: (text := client.status()["main"]["text"]) and "/dev/shm has lost" in text and text,
            "the fault",
        )
        assert all(name in told for name in removed)
        assert f"end it (kill {first.pid}) and start it again" in told
        goes_on(client)
    # AND WHEN it ends while another service of the name runs
    second.start()
    names = objects_of(second.name)
    assert first.terminate() == 0
    # THEN the other one keeps its names, and clients attach to it
    assert objects_of(second.name) == names
    with second.attach() as client:
        goes_on(client)
        assert "has lost" not in client.status()["main"]["text"]


def test_a_part_that_fails_is_reported_once_and_latched_until_the_end() -> None:
    reported: list[str] = []
    guard = Guard(reported.append)

    def fail() -> int:
        raise OSError(28, "No space left on device")

    # WHEN a part fails three times, THEN it is reported once
    assert [guard.run("mending", fail, 7) for _ in range(3)] == [7, 7, 7]
    assert len(reported) == 1
    assert "No space" in guard.texts()[0]
    assert "3 times" in guard.texts()[0]
    # WHEN it works again, THEN that is reported, and the fault stays latched
    assert guard.run("mending", lambda: 8, 7) == 8
    assert guard.failed
    assert guard.texts() == ["mending failed 3 times, works again"]
    assert reported[1] == "mending works again"


def test_a_driver_that_is_not_started_has_nothing_to_say() -> None:
    class Driver:
        def faults(self) -> list[str]:
            raise AssertionError("nobody asked it")

    assert DriverWatch(Driver()).faults() == []  # type: ignore[arg-type]


def test_one_text_of_a_driver_is_one_fault_and_one_note() -> None:
    class Driver:
        def faults(self) -> str:
            return "no light"

        def notes(self) -> str:
            return "dusty"

        def stop(self) -> None:
            pass

    # GIVEN a driver that answers a text, not a list of texts
    watch = DriverWatch(Driver())  # type: ignore[arg-type]
    watch.start()
    # THEN its letters are not taken for faults
    until(lambda: watch.faults() == ["no light"], "the fault")
    assert watch.notes() == ["dusty"]
    watch.stop(10.0)


def test_a_driver_is_stopped_where_no_thread_can_be_had(monkeypatch: pytest.MonkeyPatch) -> None:
    class Driver:
        stopped = 0

        def faults(self) -> list[str]:
            return []

        def stop(self) -> None:
            self.stopped += 1

    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    # GIVEN a process that can start no thread
    driver = Driver()
    watch = DriverWatch(driver)  # type: ignore[arg-type]
    watch.start()
    monkeypatch.setattr(threading.Thread, "start", refuse)
    # WHEN its driver is to be stopped, THEN it is
    watch.stop(10.0)
    assert driver.stopped == 1
    DriverWatch(driver).stop(1.0)  # type: ignore[arg-type]


FLOOD = """
import os, socket, sys
path, end = sys.argv[1], 300
for _ in range(end):
    s = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    s.setblocking(False)
    try:
        s.connect(path)
    except OSError:
        pass
    s.close()
"""


def test_a_flood_ends_no_service_whose_descriptors_have_high_numbers(
    make_service: Callable[..., Service],
) -> None:
    s = make_service()
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)
    if limit[1] < 4096:
        pytest.skip("this process may not have so many files")
    resource.setrlimit(resource.RLIMIT_NOFILE, (4096, limit[1]))
    # GIVEN a service whose descriptors have high numbers
    files = [os.open(os.devnull, os.O_RDONLY) for _ in range(1100)]
    try:
        s.start(close_fds=False, preexec_fn=lambda: [os.set_inheritable(fd, True) for fd in files])
        with s.attach() as client:  # this process has as many
            # WHEN connections flood its socket
            for _ in range(5):
                subprocess.run([sys.executable, "-c", FLOOD, f"/dev/shm/{s.name}.sock"], check=True)
            # THEN it goes on and serves clients
            s.cycles(50)
            assert client.alive()
        with s.attach() as another:
            assert another.alive()
    finally:
        for fd in files:
            os.close(fd)
        resource.setrlimit(resource.RLIMIT_NOFILE, limit)


# asked to end after the handlers were installed and before the first kernel, whose compilation takes a minute
EARLY = """
import sys, msgspec
from surffollow.config.service import load_config
from surffollow.service import daemon
def compile_all(*words): print("compiled", flush=True)
daemon.run_cycles = compile_all
one = daemon.Daemon(msgspec.structs.replace(load_config(sys.argv[1]), name=sys.argv[2]), quiet=True)
one.stop()
one.run(lambda: print("READY", flush=True))
print("ended", flush=True)
"""


def test_a_service_asked_to_end_before_it_compiles_compiles_nothing(make_service: Make) -> None:
    s = make_service()
    with program(EARLY, str(s.config), s.name) as child:
        assert said(child) == "ended"
    assert objects_of(s.name) <= {f"{s.name}.map"}


def test_a_compilation_is_left_when_the_service_is_asked_to_end(
    make_service: Callable[..., Service], tmp_path: Path
) -> None:
    s = make_service()
    # GIVEN a service that compiles its kernels
    process = s.launch(env=os.environ | {"SURFFOLLOW_CACHE_DIR": str(tmp_path / "cold")})
    until(lambda: list((tmp_path / "cold").rglob("*.nbc")) or process.poll() is not None, "a kernel", READY_S)
    status = Path(f"/proc/{process.pid}/status")
    until(
        lambda: int(status.read_text().split("SigIgn:")[1].split()[0], 16) >> (signal.SIGIO - 1) & 1,
        "the daemon's handlers, behind which it ignores SIGIO",
        READY_S,
    )
    # WHEN it is asked to end
    process.send_signal(signal.SIGTERM)
    # THEN it ends without having finished
    reported, _ = process.communicate(timeout=READY_S)
    assert "READY" not in reported
    assert process.returncode == 0
    assert not list((tmp_path / "cold").rglob("complete")), "the compilation went on to its end"
    assert not list((tmp_path / "cold").rglob("cycle.run_cycles.*")), "the cycle was compiled to its end"
    s.process = None
    assert objects_of(s.name) <= {f"{s.name}.map"}
