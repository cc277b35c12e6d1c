"""A third party's driver: a package of its own, installed into a fresh environment, that follows."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

from running_service import Service

ROOT = Path(__file__).parents[2]
LIMIT_MM = 0.5
TRIES = 4  # another process may hold both processors of a busy machine for a while
PROJECT = """
[build-system]
requires = ["setuptools"]
build-backend = "setuptools.build_meta"
[project]
name = "fine-laser"
version = "1.0"
[project.entry-points."surffollow.drivers"]
fine-laser = "fine_laser:make"
[tool.setuptools]
py-modules = ["fine_laser"]
"""
DRIVER = '''
"""The driver of a laser that sends (time, distance) in datagrams; it knows surffollow.hw alone."""
import select, socket, struct
from surffollow.hw import PolledDriver, metre_info, pack_range

class Laser:
    rejected = 0
    def __init__(self, info, port):
        self.info, self.port, self.name = info, port, f"fine laser on port {port}"
    def open(self):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", self.port))
    def close(self):
        self.socket.close()
    def read(self, timeout_s):
        if not select.select([self.socket], [], [], timeout_s)[0]:
            return []
        t_ns, range_m = struct.unpack("<qd", self.socket.recv(16))
        return [(t_ns, pack_range(self.info, 0, range_m))]

def make(settings, name):
    info = metre_info("fine laser", 0.05, 0.15)
    return PolledDriver(info, Laser(info, settings["port"]))
'''
# the controller of examples/python, over the rolling part of the default ground, which the laser measures
ROBOT = """
import importlib.util, socket, struct, sys
from surffollow.sim.world_surface import WorldConfig
spec = importlib.util.spec_from_file_location("example", sys.argv[1])
example = importlib.util.module_from_spec(spec)
spec.loader.exec_module(example)
FIELD, LENGTH_M = WorldConfig().make(), 0.19
WIRE = ("127.0.0.1", int(sys.argv[3]))

def ground_m(x_m):
    x_m %= 2 * LENGTH_M  # to and fro: there are boxes at both ends
    return FIELD.height_m(0.842 + min(x_m, 2 * LENGTH_M - x_m), 0.42) - FIELD.height_m(0.842, 0.42)

class Wire:
    def __init__(self):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    def claim_range(self, channel): pass
    def push_range(self, channel, t_ns, range_m):
        self.socket.sendto(struct.pack("<qd", t_ns, float("nan") if range_m is None else range_m), WIRE)
    close = lambda self: self.socket.close()

attach = example.attach
example.ground_m = ground_m
example.attach = lambda name, label: Wire() if label == "laser" else attach(name, label=label)
sys.argv = ["robot", sys.argv[2], sys.argv[4]]
sys.exit(example.main())
"""


@pytest.fixture
def fresh_python(tmp_path: Path) -> Path:
    """An environment that has the third party's package, and ours with what it needs by reference."""
    pytest.importorskip("setuptools")
    package = tmp_path / "package"
    package.mkdir()
    (package / "pyproject.toml").write_text(PROJECT)
    (package / "fine_laser.py").write_text(DRIVER)
    venv.create(tmp_path / "fresh", with_pip=False)
    python = tmp_path / "fresh/bin/python"
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    ours = sysconfig.get_path("purelib")
    (tmp_path / f"fresh/lib/{version}/site-packages/ours.pth").write_text(
        f"import site; site.addsitedir({ours!r})\n"
    )
    words = ["--python", str(python), "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    done = subprocess.run(
        [sys.executable, "-m", "pip", *words, str(package)], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    return python


def test_an_installed_driver_is_found_by_its_name_and_follows_rolling_ground(
    fresh_python: Path, tmp_path: Path
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    seen_here = subprocess.run([sys.executable, "-c", "import fine_laser"], capture_output=True, check=False)
    assert seen_here.returncode != 0, "the package must be in the fresh environment alone"
    service = Service(tmp_path, f'[driver]\nkind = "fine-laser"\nport = {port}\n')
    service.python = str(fresh_python)
    robot = tmp_path / "robot.py"
    robot.write_text(ROBOT)
    example = str(ROOT / "examples/python/push_range.py")
    try:
        service.start()
        for _ in range(TRIES):
            words = [str(fresh_python), str(robot), example, service.name, str(port), "8"]
            done = subprocess.run(words, capture_output=True, text=True, timeout=120.0, env=os.environ)
            assert done.returncode == 0, done.stderr
            said = done.stdout.split()
            rms_mm, ticks = float(said[said.index("standoff_rms_mm") + 1]), int(said[said.index("ticks") + 1])
            if rms_mm <= LIMIT_MM and ticks > 400:
                break
        assert ticks > 400
        assert rms_mm <= LIMIT_MM
        print(f"stand-off RMS {rms_mm} mm in {ticks} ticks")
    finally:
        service.purge()
