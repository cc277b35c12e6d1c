"""The C header among names and memory of others: no hang, no signal, no trust in other users."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from cabi.running import ROOT, Probe
from running_service import Service
from second_user import NOBODY, OtherUser, as_other_user, needs_root, outcome
from service.forged_objects import forged_board, published, put, remove
from surffollow.client import STALE, attach, observe
from surffollow.shm import layout_board as lb
from surffollow.shm.layout_follow import VALID

OK, NOT_RUNNING, BLOCK, OWNER = 0, -20, -24, -36
POSE = "ee 0.05 0.05 0.1 0 0 0 1"


@pytest.mark.parametrize("kind", ["fifo", "directory", "link", "socket"])
def test_what_is_no_plain_file_is_refused_at_once(make_probe: Callable[..., Probe], kind: str) -> None:
    name = f"cabi-odd-{os.getpid()}"
    path = Path(f"/dev/shm/{name}")
    put(path, kind)
    try:
        probe = make_probe()
        probe("ready_ms 100")
        for how in ("attach", "observe"):
            assert probe(f"{how} {name}").result == BLOCK
    finally:
        remove(path)


@needs_root
def test_an_impostor_after_a_clean_stop_moves_no_client(
    killable: Service, make_probe: Callable[..., Probe]
) -> None:
    path = Path(f"/dev/shm/{killable.name}")
    robot, watcher, fixed, trusting = (make_probe(stale_ms=50) for _ in range(4))
    fixed("auto 0")
    for p, how in ((robot, "attach"), (watcher, "observe"), (fixed, "attach")):
        assert p(f"{how} {killable.name}").result == OK
    robot.until(POSE, lambda a: int(robot("dev").values[2]) & VALID != 0)
    with observe(killable.name) as python:
        forged = forged_board(path.read_bytes(), python.board.regions["output"][0])
    assert killable.terminate() == 0

    with OtherUser(published(path, forged)) as impostor:
        assert impostor.receive() == "there"
        for p in (robot, watcher, fixed):
            p.until("dev", lambda a: bool(int(a.values[2]) & STALE))
        for _ in range(10):
            for p in (robot, watcher):
                answer = p("reattach")
                assert (answer.result, answer.detail) == (OWNER, NOBODY)
                assert p("dev").values[0] == 0.0
                assert not int(p("dev").values[2]) & VALID
            assert robot(POSE).result == NOT_RUNNING
        answer = trusting(f"attach {killable.name}")
        assert (answer.result, answer.detail) == (OWNER, NOBODY)
        trusting(f"owner {NOBODY}")
        trusting("stale_ms 3600000")
        assert trusting(f"observe {killable.name}").result == OK
        assert trusting("dev").values[0] == -0.5
        assert fixed("detach").result == OK
    path.unlink()
    killable.start()
    robot.until(POSE, lambda a: a.result == OK)


@needs_root
@pytest.mark.parametrize("kind", ["fifo", "directory", "link"])
def test_a_robot_bears_what_takes_the_place_of_its_service(
    killable: Service, make_probe: Callable[..., Probe], kind: str
) -> None:
    path = Path(f"/dev/shm/{killable.name}")
    probe = make_probe(stale_ms=50)
    assert probe(f"attach {killable.name}").result == OK
    assert probe(POSE).result == OK
    assert killable.terminate() == 0
    assert as_other_user(lambda _: outcome(lambda: put(path, kind))) == "done"
    try:
        probe.until("dev", lambda a: bool(int(a.values[2]) & STALE))
        assert probe("reattach").result == BLOCK
        assert probe(POSE).result == NOT_RUNNING
        assert probe("height 0 0").result in (OK, 4, BLOCK, NOT_RUNNING)
        assert probe("detach").result == OK
    finally:
        remove(path)


def test_no_call_is_a_signal_when_the_service_died_and_its_names_are_gone(
    killable: Service, make_probe: Callable[..., Probe]
) -> None:
    probe = make_probe(stale_ms=50)
    assert probe(f"attach {killable.name}").result == OK
    assert probe(POSE).result == OK
    killable.kill()
    for part in ("", ".sock", ".lock"):
        Path(f"/dev/shm/{killable.name}{part}").unlink()
    probe.until("dev", lambda a: bool(int(a.values[2]) & STALE))
    for line in (POSE, "reset 0.1", "begin 10", "end", "reattach", "release", "status", "detach", POSE):
        probe(line)  # the probe is sanitised and says so when it dies
    assert probe("alive").result == 0


def test_more_clients_than_slots_and_one_that_comes_free(
    killable: Service, make_probe: Callable[..., Probe]
) -> None:
    probe = make_probe()
    with contextlib.ExitStack() as stack:
        held = [stack.enter_context(attach(killable.name, stale_min_s=1.0)) for _ in range(lb.CLIENTS)]
        answer = probe(f"attach {killable.name}")
        assert (answer.result, answer.detail) == (-25, lb.CLIENTS)
        held[3].close()
        probe.until(f"attach {killable.name}", lambda a: a.result == OK)


TOOLS = {
    "gcc": ["gcc", "-std=c11", "-fanalyzer", "-Werror", "-O1", "-c", "-o", "/dev/null"],
    "cppcheck": [
        *("cppcheck", "--error-exitcode=1", "--enable=warning,portability,performance", "--inline-suppr"),
        *("--std=c11", "--suppress=missingIncludeSystem", "--quiet"),
    ],
}


@pytest.mark.parametrize("tool", sorted(TOOLS))
def test_static_analysis_finds_nothing_in_the_header(tool: str, tmp_path: Path) -> None:
    if shutil.which(TOOLS[tool][0]) is None:
        pytest.skip(f"no {tool} on this machine")
    from surffollow.shm.cheader import header_text

    (tmp_path / "surffollow.h").write_text(header_text())
    command = [*TOOLS[tool], f"-I{tmp_path}", str(ROOT / "tests/cabi/probe.c")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
