"""The client in Rust, built from the layout's JSON alone, drives, observes, and outlives its service."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from running_service import Service, until
from surffollow.client import Observer

FOLDER = Path(__file__).parents[2] / "examples/rust"
LIMIT_MM, TRIES = 0.5, 4


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compiled as its user does, without a network."""
    if (
        shutil.which("cargo") is None
        or subprocess.run(["cargo", "--version"], capture_output=True).returncode
    ):
        pytest.skip("no cargo on this machine: examples/rust is not compiled")
    target = tmp_path_factory.mktemp("rust")
    done = subprocess.run(
        ["cargo", "build", "--release", "--offline", "--quiet", "--locked"],
        cwd=FOLDER,
        env=os.environ | {"CARGO_TARGET_DIR": str(target), "PYTHON": sys.executable},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == "", "no warnings"
    return target / "release/surffollow-controller"


def figures(line: str) -> dict[str, float]:
    words = line.split()
    return {words[k]: float(words[k + 1]) for k in range(0, len(words), 2)}


def test_it_keeps_its_distance_from_rolling_ground(program: Path, bare: Service) -> None:
    for _ in range(TRIES):
        done = subprocess.run([str(program), bare.name, "6"], capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr
        reported = figures(done.stdout.splitlines()[-1])
        if reported["standoff_rms_mm"] <= LIMIT_MM and reported["readings"] > 350:
            break
    assert reported["readings"] > 350
    assert reported["standoff_rms_mm"] <= LIMIT_MM
    assert reported["attachments"] == 1


def test_it_attaches_again_to_a_service_that_was_killed_and_started(program: Path, bare: Service) -> None:
    child = subprocess.Popen([str(program), bare.name, "300"], stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout is not None
        assert child.stdout.readline().startswith(f"attached to {bare.name}")
        driven = f"a valid demand to process {child.pid}"

        def drives(watcher: Observer) -> bool:
            return watcher.status()["main"]["pose_pid"] == child.pid and watcher.dev_vector().valid

        with bare.attach() as watcher:
            until(lambda: drives(watcher), driven)
        bare.kill()
        bare.start()
        with bare.attach() as watcher:
            until(lambda: drives(watcher), f"{driven} of the next service")
            assert watcher.params()["offset_m"] == 0.1
        child.send_signal(signal.SIGKILL)
        child.wait()
        with bare.attach() as watcher:
            until(lambda: watcher.status()["main"]["pose_slot"] == -1, "the pose's release")
    finally:
        child.kill()
        child.communicate()


def test_without_a_service_it_says_so(program: Path) -> None:
    done = subprocess.run([str(program), "no-such-service", "1"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert "no service no-such-service" in done.stderr


def test_a_layout_of_another_release_is_refused(program: Path, bare: Service, tmp_path: Path) -> None:
    """The program's numbers are those of the JSON it was built from: another hash there, another program."""
    command = [sys.executable, "-m", "surffollow", "print-header", "--json"]
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    layout = tmp_path / "layout.json"
    reported = json.loads(text)
    reported["hash"] = "0x0123456789abcdef"
    layout.write_text(json.dumps(reported))
    out = tmp_path / "layout.rs"
    subprocess.run(
        [sys.executable, "-I", str(FOLDER / "generate.py"), str(out)],
        env=os.environ | {"SURFFOLLOW_LAYOUT": str(layout)},
        check=True,
    )
    assert "pub const LAYOUT_HASH: u64 = 0x0123456789abcdef;" in out.read_text()
    source = tmp_path / "other"
    shutil.copytree(FOLDER, source, ignore=shutil.ignore_patterns("target"))
    words = ["rustc", "-O", "--edition", "2021", "-o", str(tmp_path / "other-program"), "src/main.rs"]
    subprocess.run(words, cwd=source, env=os.environ | {"OUT_DIR": str(tmp_path)}, check=True)
    done = subprocess.run(
        [str(tmp_path / "other-program"), bare.name, "1"], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 1
    assert "another release" in done.stderr
