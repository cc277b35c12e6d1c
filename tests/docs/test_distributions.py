"""The source distribution holds what the repository has; the wheel what a host needs beside the package."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ("docs", "examples", "include", "requirements", "src", "tests", "tools")
FILES = (
    "ARCHITECTURE.md",
    "CHANGELOG.md",
    "LICENSE",
    "Makefile",
    "MANIFEST.in",
    "README.md",
    "pyproject.toml",
)
MADE = shutil.ignore_patterns("__pycache__", "*.egg-info", "*.nbi", "*.nbc", "target", "*.mcap")
BUILD = "import sys; from setuptools import build_meta; print(getattr(build_meta, sys.argv[1])(sys.argv[2]))"


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the repository's files, without what work in it makes."""
    pytest.importorskip("setuptools")
    folder = tmp_path_factory.mktemp("source")
    for name in FOLDERS:
        shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=MADE)
    for name in FILES:
        shutil.copy(ROOT / name, folder)
    return folder


def built(source: Path, kind: str, out: Path) -> Path:
    """A distribution, as pip has it built."""
    done = subprocess.run(
        [sys.executable, "-c", BUILD, kind, str(out)], cwd=source, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return out / done.stdout.splitlines()[-1]


def test_the_source_distribution_holds_every_file_of_the_repository(source: Path, tmp_path: Path) -> None:
    expected = {p.relative_to(source).as_posix() for p in source.rglob("*") if p.is_file()}
    with tarfile.open(built(source, "build_sdist", tmp_path)) as archive:
        found = {m.name.partition("/")[2] for m in archive.getmembers() if not m.isdir()}
    assert expected - found == set()


def test_the_wheel_has_the_unit_and_the_udev_rule_that_doctor_names(source: Path, tmp_path: Path) -> None:
    from surffollow.service.doctor_unit import SYSTEMD

    with zipfile.ZipFile(built(source, "build_wheel", tmp_path)) as wheel:
        names = set(wheel.namelist())
        for path in SYSTEMD.iterdir():
            name = f"surffollow/systemd/{path.name}"
            assert name in names
            assert wheel.read(name) == (ROOT / "examples/systemd" / path.name).read_bytes()
    assert "surffollow/include/surffollow.h" in names
    assert "surffollow/shm/header/70_requests.h" not in names, "the header is made of it beforehand"
    assert not [n for n in names if n.startswith(("tests", "docs", "examples", "tools"))]
