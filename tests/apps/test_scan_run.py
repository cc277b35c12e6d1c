"""`surffollow scan run` against the real service: confirmed, paused, aborted, stopped, and reported."""

from __future__ import annotations

import json
import os
import pty
import shlex
import signal
import socket
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner

from running_service import (
    READY_S,
    WAIT_S,
    Service,
    begin_command,
    config_text,
    interrupt,
    run_command,
    until,
)
from surffollow.apps import scan_control
from surffollow.apps.scan_control import ControlServer, ask
from surffollow.apps.scan_report import inside_text, title_text
from surffollow.apps.scan_run import Executed
from surffollow.cli.main import cli
from surffollow.errors import BusyError, NotRunningError
from surffollow.map import HeightMap
from surffollow.scan.path import ScanPath

GAP_M = 0.08  # within the window of the simulated sensor


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Bumpy ground as a map, and a plan over it."""
    made = tmp_path_factory.mktemp("scan")
    y, x = np.mgrid[0:0.5:0.005, 0:0.6:0.005]
    z = 0.006 * np.sin(9.0 * x) + 0.005 * np.cos(8.0 * y)
    HeightMap.from_heights(z, origin_m=(0.0, 0.0), grid_m=0.005).save(made / "ground.npz")
    region = ["--region", "0.15,0.2,0.45,0.3", "--gap", f"{GAP_M}", "--body", "disc:0.05"]
    words = ["plan", str(made / "ground.npz"), *region, "--speed", "0.2", "--acceleration", "1"]
    done = CliRunner().invoke(cli, ["scan", *words, "-o", str(made / "path.csv")])
    assert done.exit_code == 0, done.output
    return made


@pytest.fixture(scope="module")
def service(folder):
    text = config_text(kind="simulated", grids=100_000, follow=f"offset = {GAP_M}")
    text = text.replace('surface = "flat"\nregion = [0.0, 0.0, 0.1, 0.1]', f'file = "{folder}/ground.npz"')
    made = Service(folder, text).start()
    yield made
    made.purge()


def words(service, folder, *more):
    command = [sys.executable, "-m", "surffollow", "scan", "run", str(folder / "path.csv")]
    return [*command, "--name", service.name, "--map", str(folder / "ground.npz"), "--json", *more]


def begin(service, folder, *more):
    child = begin_command(words(service, folder, "--yes", *more))
    reach(service, child, lambda s: s["state"] == "scan" and s["progress"] > 0.05)
    return child


def reach(service, child, what):
    def there():
        assert child.poll() is None, child.communicate()
        try:
            return what(ask(service.name, "status"))
        except NotRunningError:
            return False

    until(there, "the scan", READY_S)


def ended(child):
    out, error = child.communicate(timeout=WAIT_S)
    assert out.startswith("{"), error
    return child.returncode, json.loads(out)


def test_a_scan_is_run_to_its_end_and_reported(service, folder, tmp_path):
    pytest.importorskip("matplotlib", reason="extra `plot`")
    # GIVEN a plan over known ground, a report and a picture that are wanted
    more = ["--ground", str(folder / "ground.npz"), "--report", str(tmp_path / "run.html")]
    # WHEN the scan is run
    child = run_command(words(service, folder, "--yes", *more, "--picture", str(tmp_path / "run.png")))
    # THEN it came to its end without a contact, and both are written
    assert child.returncode == 0, child.stderr
    facts = json.loads(child.stdout)
    assert facts["finished"]
    assert facts["retracted"]
    assert facts["true_rms_m"] < 3e-3
    assert facts["true_contacts"] == 0.0
    assert facts["coverage"] == facts["coverage_with_before"] == 1.0
    assert facts["continue_from"] is facts["continue_with"] is None
    assert "to continue" not in child.stderr
    assert facts["sensed_part"] > 0.9
    # the plan was shown: figures, flags, check
    for shown in ("clearance_min_m", "flags", "ok   clearance", "picture of the plan"):
        assert shown in child.stderr
    assert (tmp_path / "run.png").read_bytes()[:4] == b"\x89PNG"
    page = (tmp_path / "run.html").read_text(encoding="utf-8")
    assert "finished: 100 %" in page
    assert page.count("data:image/png;base64,") == 1


def test_the_texts_of_a_report_count_times_and_short_times():
    summary = {"finished": True, "progress": 1.0, "planned_s": 54.4, "way": "follow"}
    summary |= {"inside_times": 1, "inside_s": 0.03, "inside_least_m": 0.02, "inside_later_part": 0.0}
    summary["from_s"] = 0.0
    path = ScanPath.planar(np.zeros((2, 2)), np.zeros(2, np.int32), facts={"gap_m": GAP_M})
    done = Executed(path, {}, np.zeros((0, 2)), np.zeros(0), np.zeros(0), summary)
    assert title_text(done) == "finished: 100 % of the plan's 54.4 s, way follow; once inside the gap"
    assert "noticed once, 0.03 s, at least" in inside_text(done)
    summary["inside_times"] = 2
    assert title_text(done).endswith("; 2 times inside the gap")
    summary["inside_times"] = 0
    assert title_text(done).endswith("way follow")
    assert inside_text(done).endswith("came more than 10 mm inside the gap")
    # a narrow gap has a smaller tolerance, a wide one metres
    for gap_m, most, least in ((0.01, "5 mm", "20.0 mm"), (2.0, "0.01 m", "0.020 m")):
        path.facts["gap_m"] = gap_m
        summary["inside_times"] = 0
        assert inside_text(done).endswith(f"came more than {most} inside the gap")
        summary["inside_times"] = 1
        assert f"came more than {most} inside the gap: " in inside_text(done)
        assert f"at least {least} away" in inside_text(done)


def test_nothing_moves_before_somebody_confirms(service, folder):
    # WHEN no terminal can ask, THEN nothing moves
    refused = begin_command(words(service, folder), subprocess.DEVNULL)
    _, error = refused.communicate(timeout=READY_S)
    assert refused.returncode == 2
    assert "--yes" in error
    with pytest.raises(NotRunningError):
        ask(service.name, "status")
    # WHEN the operator says no, THEN nothing moves
    ours, theirs = pty.openpty()
    child = begin_command(words(service, folder), theirs)
    os.write(ours, b"n\n")
    out, error = child.communicate(timeout=READY_S)
    os.close(ours)
    os.close(theirs)
    assert child.returncode == 1
    assert "nothing moved" in error
    assert out.strip() == ""  # click 8.1 asks with a space there


def test_an_interrupt_before_the_start_is_one(folder):
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "surffollow", "scan", "run", str(folder / "path.csv")]
    with subprocess.Popen(command, stdin=theirs, stderr=subprocess.PIPE) as child:
        said = b""
        while b"Start the scan?" not in said:
            said += os.read(child.stderr.fileno(), 1000)
        interrupt(child)
        rest = child.stderr.read()
    os.close(ours)
    os.close(theirs)
    assert child.returncode == 130
    assert b"Aborted" not in rest


def test_pause_resume_and_abort_by_commands(service, folder):
    # GIVEN a scan that runs
    child = begin(service, folder)
    # WHEN it is paused and resumed, THEN it does so
    for word, state in (("pause", "paused"), ("resume", "scan")):
        done = CliRunner().invoke(cli, ["scan", word, service.name, "--json"])
        assert done.exit_code == 0, done.output
        reach(service, child, lambda s, state=state: s["state"] == state)
    # WHEN it is aborted, THEN it retracts and reports what happened
    done = CliRunner().invoke(cli, ["scan", "abort", service.name])
    assert "abort asked for" in done.output
    code, facts = ended(child)
    assert code == 1
    assert facts["aborted"]
    assert facts["retracted"]
    assert facts["pauses"] == 1
    assert facts["paused_ticks"] > 0
    assert 0.0 < facts["progress"] < 1.0


def test_an_aborted_scan_prints_the_command_that_continues_it(service, folder, tmp_path):
    # GIVEN a scan that is interrupted
    child = begin(service, folder, "--picture", str(tmp_path / "first.png"))
    reach(service, child, lambda s: s["progress"] > 0.3)
    child.send_signal(signal.SIGINT)
    out, error = child.communicate(timeout=WAIT_S)
    first = json.loads(out)
    assert 0.0 < first["coverage"] < 1.0
    assert first["coverage_with_before"] == first["coverage"]
    # WHEN the command that it printed is run
    (line,) = [text for text in error.splitlines() if text.startswith("to continue: ")]
    command = shlex.split(line.removeprefix("to continue: "))
    assert command == shlex.split(first["continue_with"])
    assert "--picture" not in command
    done = run_command([sys.executable, "-m", *command])
    # THEN it scans the rest alone, from the place where the first one ended
    assert done.returncode == 0, done.stderr
    rest = json.loads(done.stdout)
    assert "begins at" in done.stderr
    assert rest["finished"]
    assert rest["from_s"] == pytest.approx(first["followed_to_s"], abs=1e-3)
    assert rest["path_id"] == first["path_id"]
    assert 0.0 < rest["coverage"] < 1.0
    assert rest["coverage_with_before"] == 1.0


def test_ctrl_c_retracts_before_it_ends(service, folder):
    # GIVEN a scan that runs
    child = begin(service, folder)
    # WHEN it is interrupted, THEN it retracts before it ends
    child.send_signal(signal.SIGINT)
    code, facts = ended(child)
    assert code == 130
    assert facts["aborted"]
    assert facts["retracted"]


def test_a_latched_stop_holds_the_scan_until_the_operator_resumes(service, folder):
    # GIVEN a scan that runs
    child = begin(service, folder)
    with service.attach(label="guard") as guard:
        # WHEN a guard stops the service
        guard.stop("somebody stepped in")
    # THEN the scan stays where it is
    reach(service, child, lambda s: s["state"] == "stopped")
    at = ask(service.name, "status")["progress"]
    service.cycles(300)
    later = ask(service.name, "status")
    assert later["state"] == "stopped"
    assert later["progress"] - at < 0.1
    # WHEN the operator resumes, THEN it goes on
    ask(service.name, "resume")
    reach(service, child, lambda s: s["state"] == "scan")
    ask(service.name, "abort")
    assert ended(child)[1]["held_ticks"] > 0


def test_keys_of_a_terminal_pause_and_abort(service, folder):
    # GIVEN a scan that runs at a terminal
    ours, theirs = pty.openpty()
    child = begin_command(words(service, folder, "--yes"), theirs)
    reach(service, child, lambda s: s["state"] == "scan")
    # WHEN keys are pressed, THEN it pauses and aborts
    os.write(ours, b"p")
    reach(service, child, lambda s: s["state"] == "paused")
    os.write(ours, b"a")
    code, facts = ended(child)
    os.close(ours)
    os.close(theirs)
    assert (code, facts["aborted"], facts["pauses"]) == (1, True, 1)


def test_a_path_that_the_checker_refuses_needs_the_operators_word(service, folder, tmp_path):
    # GIVEN ground that is higher than planned for
    rough = HeightMap.load(folder / "ground.npz")
    HeightMap.from_heights(rough.heights_m + 0.03, origin_m=(0.0, 0.0), grid_m=0.005).save(
        tmp_path / "higher.npz"
    )
    command = words(service, folder, "--yes")
    command[command.index(str(folder / "ground.npz"))] = str(tmp_path / "higher.npz")
    # WHEN the scan is run, THEN it asks for `--unchecked`; the command line was right
    done = run_command(command)
    assert done.returncode == 1
    assert "--unchecked" in done.stderr


def test_a_report_that_cannot_be_written_is_refused_before_anything_moves(folder, tmp_path):
    for more in (
        ["--report", str(tmp_path / "none" / "run.html")],
        ["--picture", str(tmp_path / "none/r.png")],
    ):
        command = [sys.executable, "-m", "surffollow", "scan", "run", str(folder / "path.csv"), "--yes"]
        done = run_command([*command, "--name", "nobody", "--wait", "0", *more])
        assert done.returncode == 1
        assert "cannot write beside" in done.stderr


def test_two_scans_of_one_service_exclude_each_other_and_words_are_checked():
    # GIVEN a scan of a service
    server = ControlServer("twice")
    try:
        # WHEN another one begins, THEN it is refused
        with pytest.raises(Exception, match="another scan"):
            ControlServer("twice")
    finally:
        server.close()
    # WHEN no scan runs, THEN a command to it is refused, and the next may begin
    with pytest.raises(NotRunningError, match="scan run"):
        ask("twice", "pause")
    ControlServer("twice").close()


@pytest.mark.parametrize(
    ("listens", "says"),
    [(True, "^user 1001 holds the control socket"), (False, "^a process that takes no connection holds")],
)
def test_an_address_that_is_held_by_another_user_is_no_scan_that_could_be_aborted(monkeypatch, listens, says):
    # GIVEN a process of another user on the address of a service's scans
    monkeypatch.setattr(scan_control, "_user", lambda connection: 1001)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as squatter:
        squatter.bind("\0surffollow.scan.squatted")
        if listens:
            squatter.listen(1)
        # WHEN a scan begins, THEN the refusal names the user and how root finds the process
        with pytest.raises(BusyError, match=says) as refused:
            ControlServer("squatted")
    assert "ss -xap | grep -F @surffollow.scan.squatted" in str(refused.value)
    assert "abort" not in str(refused.value)


@pytest.mark.parametrize(("number", "says"), [(-1, "on a turn, 4 passes, tip"), (1, "pass 2 of 4, tip")])
def test_the_status_names_the_pass_or_a_turn(monkeypatch, number, says):
    answer = {
        "state": "scan",
        "progress": 0.5,
        "pass": number,
        "passes": 4,
        "tip_m": [0, 0, 0],
        "trouble": "",
    }
    monkeypatch.setattr(scan_control, "ask", lambda _name, _word: answer)
    done = CliRunner().invoke(cli, ["scan", "status", "turning"])
    assert done.stdout.startswith(f"scan, 50 %, {says}")


def test_an_abort_retracts_after_the_service_has_died(folder):
    text = config_text(kind="simulated", grids=100_000, follow=f"offset = {GAP_M}")
    text = text.replace('surface = "flat"\nregion = [0.0, 0.0, 0.1, 0.1]', f'file = "{folder}/ground.npz"')
    with Service(folder, text).running() as own:
        # GIVEN a scan that runs
        child = begin(own, folder)
        # WHEN its service is killed, THEN it holds
        own.kill()
        reach(own, child, lambda s: s["state"] == "hold" and s["trouble"])
        # WHEN it is aborted, THEN it retracts
        ask(own.name, "abort")
        code, facts = ended(child)
    assert code == 1
    assert facts["aborted"]
    assert facts["retracted"]
