"""The commands of the tutorials, run as printed in a fresh home; their output is what the page says."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from running_service import unique_name

PAGES = Path(__file__).parents[2] / "docs" / "tutorials"
BLOCK = re.compile(r"```(\w+)\n(.*?)```", re.S)
SERVICE = re.compile(r"surffollow start --name (\S+)")
FILE = re.compile(r"(?:#|/\*) (\S+\.\w+)")
NEEDS = {"pretend-laser": "serial"}


def distances_mm(text: str) -> list[float]:
    return [float(d) for d in re.findall(r"distance ([0-9.]+) mm", text)]


def near_100(text: str) -> bool:
    found = distances_mm(text)
    return len(found) >= 6 and max(abs(d - 100.0) for d in found[2:]) < 3.0


def near_120(text: str) -> bool:
    found = distances_mm(text)  # "nan": the service stood still for 20 ms, as on a busy machine it may
    return text.count("distance ") == 5 and len(found) >= 3 and max(abs(d - 120.0) for d in found[1:]) < 1.0


def exact_or_silent(text: str) -> bool:
    found = re.findall(r"^(\S+) mm$", text, re.M)  # "nan" as above
    return len(found) == 5 and {"123.456"} <= set(found) <= {"123.456", "nan"}


def followed(text: str) -> bool:
    found = re.search(r"standoff_rms +([0-9.]+) mm", text)
    return found is not None and float(found[1]) < 5.0 and re.search(r"service \S+: ready", text) is not None


SAYS = {
    "simulated-run": followed,
    "python-loop": near_100,
    "c-loop": near_100,
    "own-sensor": near_120,
    "pretend-laser": lambda text: text.count("ok:") == 4 and exact_or_silent(text),
}


@pytest.mark.parametrize("name", sorted(SAYS))
def test_a_tutorial_does_what_it_says(name: str, tmp_path: Path) -> None:
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    home = tmp_path / "home"
    home.mkdir()
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    env = os.environ | {"HOME": str(home), "PATH": path}
    shown, terminals = "", []
    try:
        page = (PAGES / f"{name}.md").read_text()
        (service,) = set(SERVICE.findall(page))  # another run of the tests may use the same page
        for kind, text in BLOCK.findall(page.replace(service, unique_name(service))):
            stored = FILE.match(text)
            if kind != "sh":
                assert stored is not None, f"a {kind} block without the name of its file"
                (tmp_path / stored[1]).write_text(text)
            elif text.startswith("# terminal"):
                process = subprocess.Popen(
                    ["bash", "-c", f"exec {text.split(chr(10), 1)[1]}"],
                    cwd=tmp_path,
                    env=env,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL,
                    text=True,
                )
                terminals.append(process)
                assert process.stdout is not None
                assert process.stdout.readline().startswith("READY")
            else:
                done = subprocess.run(
                    ["bash", "-e", "-c", text],
                    cwd=tmp_path,
                    env=env,
                    capture_output=True,
                    text=True,
                    timeout=120,
                )
                assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"
                shown += done.stdout
    finally:
        for process in terminals:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            process.communicate(timeout=60)
    assert SAYS[name](shown), shown
