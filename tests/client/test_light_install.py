"""`pip install .` alone: a client, small, and clear about what it cannot do."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from running_service import Service, config_text, objects_of

ROOT = Path(__file__).parents[2]
MOST_BYTES = 12_000_000

DRIVE = """
import json, sys, time
from surffollow.client import attach
from surffollow.blocks import Block  # the other light half
robot = attach(sys.argv[1])
robot.claim_pose()
robot.sf_reset(0.1)
end = time.monotonic() + 120.0
valid, range_m = False, float("nan")
while not (valid and range_m == range_m) and time.monotonic() < end:  # NaN: the service stood still for 20 ms
    robot.ee_pos((0.05, 0.05, 0.12, 0.0, 0.0, 0.0, 1.0), time.monotonic_ns())
    valid, range_m = robot.dev_vector().valid, robot.raw_distance()
    time.sleep(0.002)
heavy = [m for m in ("numpy", "numba", "msgspec", "click") if m in sys.modules]
print(json.dumps({"valid": valid, "range_m": range_m, "heavy": heavy}))
"""


@pytest.fixture(scope="module")
def light(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a fresh virtual environment with the package and what it requires."""
    folder = tmp_path_factory.mktemp("light")
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    shutil.copytree(ROOT / "src", source / "src", ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    wheel = [*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", str(folder), str(source)]
    subprocess.run(wheel, check=True, capture_output=True)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder / "venv")], check=True)
    python = folder / "venv/bin/python"
    install = [*pip, "--python", str(python), "install", "--no-cache-dir", *map(str, folder.glob("*.whl"))]
    got = subprocess.run(install, capture_output=True, text=True)
    if got.returncode:
        pytest.skip(f"no package registry: {got.stderr[-200:]}")
    return folder / "venv"


def run(*words: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    env = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL"))}
    return subprocess.run(
        [str(w) for w in words], capture_output=True, text=True, cwd=cwd, env=env, timeout=60
    )


def test_a_client_installation_is_small_and_has_no_numerical_libraries(light: Path) -> None:
    size = sum(p.stat().st_size for p in light.rglob("*") if p.is_file() and not p.is_symlink())
    assert size <= MOST_BYTES, f"{size / 1e6:.1f} MB"
    (packages,) = light.glob("lib/python*/site-packages")
    assert not [n for n in ("numpy", "numba", "scipy", "msgspec", "matplotlib") if (packages / n).exists()]


def test_a_client_installation_drives_a_service_and_has_the_header(light: Path, tmp_path: Path) -> None:
    service = Service(tmp_path, config_text(kind="simulated"))
    try:
        service.start()
        got = run(light / "bin/python", "-c", DRIVE, service.name, cwd=tmp_path)
        assert got.returncode == 0, got.stderr
        reported = json.loads(got.stdout)
        assert reported["valid"]
        assert reported["range_m"] == pytest.approx(0.12, abs=0.001)
        assert reported["heavy"] == []
        status = run(light / "bin/surffollow", "status", "--name", service.name, "--json", cwd=tmp_path)
        assert json.loads(status.stdout)["alive"], status.stderr
        audit = run(light / "bin/surffollow", "status", "--name", service.name, "--audit", cwd=tmp_path)
        assert "SF_RESET" in audit.stdout.upper().replace("SFRESET", "SF_RESET"), audit.stdout + audit.stderr
        stop = run(light / "bin/surffollow", "stop", "--name", service.name, "--json", cwd=tmp_path)
        assert stop.returncode == 0, stop.stderr
        assert json.loads(stop.stdout) == {
            "name": service.name,
            "pid": service.pid,
            "purged": False,
            "stop_kept": False,
        }
        assert objects_of(service.name) == {f"{service.name}.map"}
        purge = run(light / "bin/surffollow", "stop", "--name", service.name, "--purge", cwd=tmp_path)
        assert purge.returncode == 0, purge.stderr
        assert objects_of(service.name) == set()
        again = run(light / "bin/surffollow", "stop", "--name", service.name, cwd=tmp_path)
        assert again.stderr == f"surffollow: no service {service.name!r} is running\n"
    finally:
        service.purge()
    include = run(light / "bin/surffollow", "--includedir", cwd=tmp_path).stdout.strip()
    assert (Path(include) / "surffollow.h").exists()


@pytest.mark.parametrize("words", [("start",), ("replay", "run.mcap"), ("demo",), ("map", "info", "x.map")])
def test_what_needs_the_service_libraries_says_what_to_install(
    words: tuple[str, ...], light: Path, tmp_path: Path
) -> None:
    (tmp_path / "run.mcap").touch()
    (tmp_path / "x.map").touch()
    got = run(light / "bin/surffollow", *words, cwd=tmp_path)
    assert got.returncode == 1
    assert "pip install '.[service]'" in got.stderr
    assert "Traceback" not in got.stderr


@pytest.mark.parametrize("what", ["from surffollow import Follower", "from surffollow.map import HeightMap"])
def test_what_computes_says_what_to_install(what: str, light: Path, tmp_path: Path) -> None:
    got = run(light / "bin/python", "-c", what, cwd=tmp_path)
    assert got.returncode == 1
    assert "pip install '.[service]'" in got.stderr
