"""The arbiter's tutorial, pasted as one block; clients that start before the server does."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from arbiter.arbiter_process import ROOT, ArbiterProcess, compile_waiting
from surffollow.arbiter import observe
from surffollow.errors import SurffollowError

PAGE = ROOT / "docs" / "tutorials" / "share-a-robot.md"


def is_running(name: str) -> bool:
    try:
        with observe(name) as seen:
            return bool(seen.status()["alive"])
    except SurffollowError:
        return False


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_tutorial_works_when_it_is_pasted_as_one_block(tmp_path: Path) -> None:
    if is_running("cell"):
        pytest.skip("an arbiter named cell runs on this machine; the page's commands use that name")
    block = re.search(r"## Steps.*?```sh\n(.*?)```", PAGE.read_text(), re.S)
    assert block is not None
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    commands = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        ["bash", "-c", block[1]],
        cwd=tmp_path,
        env={**os.environ, "PATH": commands},
        capture_output=True,
        text=True,
        timeout=300,
    )
    said = done.stdout + done.stderr
    assert "no arbiter" not in said, said
    assert "READY" in said, said
    assert "arbiter cell runs" in said, said
    turned = re.search(r"careful turned the cart round (\d+) times", said)
    granted = re.search(r"patrol was granted the cart (\d+) times and sent (\d+) commands", said)
    assert turned is not None, said
    assert granted is not None, said
    assert int(turned[1]) >= 2, said
    assert int(granted[1]) >= 2, said
    assert int(granted[2]) > 100, said
    assert not is_running("cell"), said


def test_a_client_in_c_waits_for_a_server_that_starts(tmp_path: Path) -> None:
    running = ArbiterProcess(tmp_path, more_clients="patrol = 10")
    patrol = compile_waiting(tmp_path, 120_000)
    with subprocess.Popen(
        [str(patrol), running.name, "0.5"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as client:
        try:
            running.start()
            said, errors = client.communicate(timeout=60)
            assert client.returncode == 0, errors
            assert "patrol was granted the cart 1 times" in said
        finally:
            client.kill()
            running.purge()
