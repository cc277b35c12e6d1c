"""The C header: current, free of warnings, and a client in C that shares the robot with one in Python."""

from __future__ import annotations

import errno
import shutil
import subprocess
from pathlib import Path

import pytest

from arbiter.arbiter_process import COMPILERS, CONFIG, PATROL, ROOT, WARNINGS, compile_client, compile_waiting
from running_service import until
from surffollow.arbiter import attach, command_reader, observe
from surffollow.arbiter.cheader import HEADER, header_text


def test_the_committed_header_is_current():
    assert header_text() == HEADER.read_text(), "run python -m surffollow.arbiter.cheader"


@pytest.mark.parametrize("level", ["-O0", "-O1", "-O2", "-O3"])
@pytest.mark.parametrize("language", ["C", "C++"])
def test_the_header_compiles_without_a_warning(language, level, tmp_path):
    # compilers see more of a copied name where they inline
    compiler = COMPILERS[language]
    if shutil.which(compiler[0]) is None:
        pytest.skip(f"no {compiler[0]} on this machine")
    command = [*compiler, *WARNINGS, level, f"-I{ROOT / 'include'}", "-c", str(PATROL)]
    done = subprocess.run([*command, "-o", str(tmp_path / "a.o")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module", params=["C", "C++"])
def patrol(request, tmp_path_factory):
    return compile_client(tmp_path_factory.mktemp("c"), request.param)


def test_a_client_in_c_is_preempted_waits_and_goes_on(make_arbiter, patrol):
    server = make_arbiter(text=CONFIG.replace("go = 10", "go = 10\npatrol = 10")).start()
    process = subprocess.Popen(
        [str(patrol), server.name, "4"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    with attach(server.name, "wall") as one, command_reader(server.name, "robot") as reader:
        mine = one.resource("robot")

        def c_leads():
            command, holder = reader.latest(), mine.holder()
            return not command.safe and holder and holder.name == "patrol" and command.values[0] == 0.4

        until(c_leads)
        assert mine.request()
        until(lambda: mine.command(-0.1, 0.0) and reader.latest().values[0] == -0.1)
        mine.relinquish()
        until(c_leads)
    out, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    words = out.split()
    assert int(words[5]) >= 2, out


@pytest.mark.parametrize("language", ["C", "C++"])
def test_a_client_in_c_says_why_it_cannot_attach(arbiter, tmp_path, language):
    impatient = compile_waiting(tmp_path, 500, language)
    done = subprocess.run([str(impatient), arbiter.name, "1"], capture_output=True, text=True)
    assert done.returncode == 1
    assert "declares no client" in done.stderr
    done = subprocess.run([str(impatient), "nobody-here", "1"], capture_output=True, text=True)
    assert "no arbiter of that name" in done.stderr


@pytest.mark.parametrize("language", ["C", "C++"])
def test_the_header_answers_what_a_client_does_wrong(make_arbiter, tmp_path, language):
    program = compile_client(tmp_path, language, Path(__file__).with_name("probe.c"))
    server = make_arbiter().start()
    with subprocess.Popen([str(program), server.name], stdout=subprocess.PIPE, text=True) as process:
        try:
            answers = {}
            while "ready" not in answers:
                word, *numbers = process.stdout.readline().split()
                answers[word] = [int(n) for n in numbers]
            assert answers == {
                "request": [1],
                "two": [1],
                "one": [-errno.EINVAL],
                "three": [-errno.EINVAL],
                "nowhere": [-errno.EINVAL, 0, 0, 0, -errno.EINVAL],
                "undated": [-errno.EINVAL],
                "left": [0],
                "ready": [],
            }
            server.kill()
            assert process.stdout.readline().split() == ["ended", str(-errno.ENOENT), "1"]
        finally:
            process.kill()


@pytest.mark.parametrize("language", ["C", "C++"])
def test_a_client_in_c_loses_what_it_holds_by_fork_and_by_the_servers_end(make_arbiter, tmp_path, language):
    program = compile_client(tmp_path, language, Path(__file__).with_name("probe_ends.c"))
    server = make_arbiter().start()
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([str(program), server.name], text=True, **pipes) as process:

        def received():
            return process.stdout.readline().split()

        def go_on():
            process.stdin.write("\n")
            process.stdin.flush()

        try:
            assert received() == ["ready"]
            server.freeze()
            go_on()
            assert received() == ["request", str(-errno.ETIMEDOUT)]
            server.go_on()
            with observe(server.name) as watcher:
                released = until(
                    lambda: watcher.status()["resources"]["robot"]["grants"] == 1 and watcher.status()
                )
                until(lambda: watcher.status()["resources"]["robot"]["state"] == "FREE")
            assert released
            go_on()
            assert received() == ["withdrawn", "1"]
            assert received() == ["again", "1"]
            assert received() == ["child", "0", "0", str(-errno.ENOENT)]
            assert received() == ["parent", "0", "1", "1"]
            server.kill()
            assert received() == ["ended", "0", str(-errno.ENOENT)]
        finally:
            process.kill()
