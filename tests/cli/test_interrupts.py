"""Ctrl-C and other signals: exit codes as documented, with --json one object, and no traceback."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from running_service import interrupt
from surffollow.map import HeightMap

# a command whose work is interrupted by the signal of the first word
INTERRUPTED = """
import os, sys, time
import surffollow.benchmark.evaluation as evaluation
number = int(sys.argv.pop(1))

def run(*_):
    os.kill(os.getpid(), number)
    time.sleep(60)

evaluation.run = run
from surffollow.cli.main import main
main()
"""


def run(number: signal.Signals, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", INTERRUPTED, str(int(number)), "benchmark", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize(
    ("number", "kind", "says"),
    [
        (signal.SIGINT, "KeyboardInterrupt", "interrupted"),
        (signal.SIGTERM, "Terminated", "ended by SIGTERM"),
        (signal.SIGHUP, "Terminated", "ended by SIGHUP"),
    ],
)
def test_an_early_end_is_one_object_and_the_number_of_the_signal(
    number: signal.Signals, kind: str, says: str
) -> None:
    plain, as_json = run(number), run(number, "--json")
    code = 128 + number
    assert (plain.returncode, plain.stdout, plain.stderr) == (code, "", "")
    assert (as_json.returncode, as_json.stderr) == (code, "")
    assert json.loads(as_json.stdout) == {"error": says, "kind": kind, "exit_code": code}


ASKING = """
import click
from surffollow.cli.main import VERBS, cli, main
import surffollow.cli.print_header as module

@click.command()
@click.option("--json", is_flag=True)
def asks(json):
    click.confirm("Go on?", err=True)

module.print_header_command = asks
main()
"""


@pytest.mark.parametrize("interrupted", [True, False])
def test_an_interrupt_and_the_end_of_the_input_at_a_question_are_told_apart(interrupted: bool) -> None:
    command = [sys.executable, "-c", ASKING, "print-header", "--json"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True) as child:
        assert child.stdin is not None
        assert child.stderr is not None
        assert os.read(child.stderr.fileno(), 100).startswith(b"Go on?")
        if interrupted:
            interrupt(child)
        else:
            child.stdin.close()
        code = child.wait(60)
        assert child.stdout is not None
        found = json.loads(child.stdout.read())
        error = child.stderr.read()
    assert code == found["exit_code"] == (130 if interrupted else 1)
    assert found["error"] == ("interrupted" if interrupted else "the input ended before the answer")
    assert "Aborted" not in error
    assert ("the input ended" in error) != interrupted


WRITES = """
import os, signal, sys, time
import surffollow.map.files as files
from surffollow.map.formats.atomic_file import replacing
number = int(sys.argv.pop(1))

def export(path, *_, **__):
    with replacing(path):
        os.kill(os.getpid(), number)
        time.sleep(60)

files.export = export
from surffollow.cli.main import main
main()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_a_file_is_written_leaves_nothing_of_it(
    number: signal.Signals, tmp_path: Path
) -> None:
    source = tmp_path / "a.npz"
    HeightMap.from_heights(np.zeros((4, 4)), origin_m=(0.0, 0.0), grid_m=0.1).save(source)
    command = [sys.executable, "-c", WRITES, str(int(number)), "map", "export", str(source)]
    done = subprocess.run([*command, str(tmp_path / "b.npz")], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (128 + number, "")
    assert list(tmp_path.iterdir()) == [source]


# NumPy prints the interrupt that its C code met while it was imported, and raises an error of its own
LOST = """
import ctypes
import surffollow.benchmark.evaluation as evaluation

def run(*_):
    ctypes.pythonapi.PyRun_SimpleString(b"import signal; signal.raise_signal(signal.SIGINT)")
    raise ImportError("numpy._core.umath failed to import")

evaluation.run = run
from surffollow.cli.main import main
main()
"""


@pytest.mark.parametrize("words", [(), ("--json",)])
def test_an_error_behind_a_lost_interrupt_is_no_fault(words: tuple[str, ...]) -> None:
    command = [sys.executable, "-c", LOST, "benchmark", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (128 + signal.SIGINT, "")
    assert (json.loads(done.stdout)["error"] if words else done.stdout) == ("interrupted" if words else "")
