"""Tutorials of logs and recordings: their commands, run as printed, do what the page says."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from running_service import unique_name

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "tutorials"
BLOCK = re.compile(r"```sh\n(.*?)```", re.S)


def run_page(name: str, folder: Path, service: str = "") -> str:
    """Run all commands of a page in one shell in a fresh folder; what they printed."""
    script = "set -e\n" + "\n".join(BLOCK.findall((PAGES / name).read_text()))
    script = script.replace("--name tutorial", f"--name {service}")  # another run may be on this machine
    commands = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    home = folder / "home"
    home.mkdir()
    done = subprocess.run(
        ["bash", "-c", script],
        cwd=folder,
        env={**os.environ, "PATH": commands, "HOME": str(home)},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_own_csv_to_a_figure(tmp_path: Path) -> None:
    said = run_page("csv-to-figure.md", tmp_path)
    assert "394 readings in 400 rows" in said
    assert (tmp_path / "survey.pdf").read_bytes().startswith(b"%PDF")
    assert (tmp_path / "ground.png").read_bytes().startswith(b"\x89PNG")
    assert len((tmp_path / "rows.csv").read_text().splitlines()) == 401
    heights = [float(line.split()[2]) for line in (tmp_path / "ground.xyz").read_text().splitlines()]
    assert min(heights) == pytest.approx(-40.3 * 0.3048, abs=0.05)


def test_own_recording_to_a_table(tmp_path: Path) -> None:
    service = unique_name("tutorial")
    try:
        said = run_page("recording-to-table.md", tmp_path, service)
    finally:
        stop = [sys.executable, "-m", "surffollow", "stop", "--name", service, "--purge"]
        subprocess.run(stop, capture_output=True)
    assert "identical: every demand and status" in said
    n, mean = re.search(r"(\d+) distances, mean ([\d.]+) mm", said).groups()
    assert int(n) > 200
    assert 80.0 < float(mean) < 130.0
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")


def test_a_scan_is_mapped_planned_and_checked_as_the_tutorial_says(tmp_path: Path) -> None:
    """GIVEN the survey of the tutorial WHEN its steps before the run are typed THEN the plan is accepted."""
    text = (PAGES / "scan.md").read_text()
    steps = [textwrap.dedent(block) for block in re.findall(r"^   ```\n(.*?)^   ```", text, re.S | re.M)]
    assert "survey.py" in steps[0]
    assert "scan check" in steps[3]
    (program,) = re.findall(r"^```python\n(.*?)^```", text, re.S | re.M)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    commands = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    script = "set -e\n" + "".join(steps[:4]) + f"python - <<'END'\n{program}END\n"
    done = subprocess.run(
        ["bash", "-c", script],
        cwd=tmp_path,
        env={**os.environ, "PATH": commands},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 floating" in done.stdout
    assert done.stdout.rstrip().endswith("accepted")
