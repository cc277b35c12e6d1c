"""Calls that a controller makes in its error paths: never attached, detached, without an end of waiting."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from cabi.running import CPP, ROOT, SANITIZED, C, run
from running_service import Service


@pytest.mark.parametrize(("compiler", "flags"), [("gcc", C), ("g++", [*CPP, "-x", "c++"])], ids=["C", "C++"])
def test_clients_that_are_not_attached_and_endless_waits_harm_nothing(
    compiler: str, flags: list[str], service: Service, tmp_path: Path
) -> None:
    if shutil.which(compiler) is None:
        pytest.skip(f"no {compiler} on this machine")
    program = tmp_path / "wrong_calls"
    source = ROOT / "tests/cabi/wrong_calls.c"
    command = [compiler, *flags, *SANITIZED, f"-I{ROOT / 'include'}", str(source), "-o", str(program)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert run(program, service.name) == "25\n"
