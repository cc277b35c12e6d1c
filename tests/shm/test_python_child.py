"""Child processes import nothing from the working directory, which may be another user's."""

from __future__ import annotations

import ast
import subprocess
from pathlib import Path

import pytest

import surffollow
from surffollow.shm.python_child import code_command, module_command

SOURCE = Path(surffollow.__file__).parent
ALONE = {"shm/python_child.py", "shm/received_descriptors.py"}  # the latter starts an isolated interpreter


@pytest.fixture
def planted(tmp_path: Path) -> Path:
    """A folder in which another user put modules."""
    for name in ("surffollow/__init__.py", "runpy.py", "json.py", "ctypes.py"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"raise SystemExit('planted {name}')\n")
    return tmp_path


@pytest.mark.parametrize(
    "command",
    [
        module_command("surffollow", "--version"),
        code_command("import ctypes, json, surffollow; print(surffollow.__file__, sys.argv[1:])", "a", "b"),
    ],
    ids=["module", "code"],
)
def test_a_planted_module_is_not_run(planted: Path, command: list[str]) -> None:
    done = subprocess.run(command, cwd=planted, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "planted" not in done.stdout + done.stderr
    assert "surffollow" in done.stdout


def test_a_child_gets_its_words() -> None:
    done = subprocess.run(
        code_command("print(sys.argv)", "a", "b"), capture_output=True, text=True, timeout=60
    )
    assert done.stdout == "['-c', 'a', 'b']\n"


def test_no_other_module_starts_python_by_itself() -> None:
    found = set()
    for path in SOURCE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute) and node.attr == "executable":
                found.add(str(path.relative_to(SOURCE)))
    assert found == ALONE
