"""Drivers of other packages: by module and factory, and by entry point of an installed package."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from running_service import Service, drive
from surffollow.errors import ConfigError
from surffollow.hw.registry import make_driver

ROOT = Path(__file__).parents[2]
PACKAGE = """
import threading, time
from surffollow.errors import DriverError
from surffollow.hw import PolledDriver, metre_info, pack_range

class Laser:
    "Tells one distance for ever, 500 times a second."
    name, rejected = "other laser", 0
    def __init__(self, info, range_m):
        self.info, self.range_m = info, range_m
    def open(self): pass
    def close(self): pass
    def read(self, timeout_s):
        time.sleep(0.002)
        return [(time.monotonic_ns(), pack_range(self.info, 0, self.range_m))]

def make(settings, name):
    info = metre_info("other laser", 0.05, 0.2)
    return PolledDriver(info, Laser(info, settings["range_m"]))

def nonsense(settings, name):
    return object()

def fails(settings, name):
    raise OSError("no laser on this bus")

def exits(settings, name):
    raise SystemExit(3)
"""


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A folder with an installed package: its code and what pip writes beside it."""
    site = tmp_path / "site"
    (site / "otherlaser").mkdir(parents=True)
    (site / "otherlaser/__init__.py").write_text(PACKAGE)
    about = site / "otherlaser-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: otherlaser\nVersion: 1.0\n")
    entries = "[surffollow.drivers]\nother-laser = otherlaser:make\nbroken = otherlaser:missing\n"
    (about / "entry_points.txt").write_text(entries)
    return site


def test_a_service_follows_with_a_driver_of_an_installed_package(installed: Path, tmp_path: Path) -> None:
    config = "log_words = 65536\n[map]\ngrids = 20000\n[driver]\nkind = 'other-laser'\nrange_m = 0.123\n"
    service = Service(tmp_path, config)
    import os

    try:
        service.start(env=os.environ | {"PYTHONPATH": str(installed)})
        with service.attach() as client:
            drive(client, lambda: abs(client.raw_distance() - 0.123) < 1e-5)
    finally:
        service.purge()


def test_an_entry_point_that_is_broken_or_unknown_is_reported(
    installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(installed))
    with pytest.raises(ConfigError, match=r"'broken' \(otherlaser:missing\) cannot be loaded"):
        make_driver({"kind": "broken"}, "x")
    with pytest.raises(ConfigError, match=r"unknown; one of: simulated, .*other-laser"):
        make_driver({"kind": "lidar"}, "x")
    assert make_driver({"kind": "other-laser", "range_m": 0.1}, "x").info.name == "other laser"


def test_a_factory_by_name_that_is_none_is_reported(installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(installed))
    (installed / "brokenlaser.py").write_text("raise RuntimeError('no licence')\n")
    made = make_driver({"kind": "otherlaser:make", "range_m": 0.1, "faults": [{"kind": "stuck"}]}, "x")
    assert made.info.range_max_m == 0.2
    for kind, says in {
        "no_such_module:make": "cannot be loaded: No module",
        "otherlaser:nothing": "cannot be loaded",
        "otherlaser:__doc__": "must be callable",
        "otherlaser:fails": "'otherlaser:fails' could not be made: OSError: no laser on this bus",
        "otherlaser:exits": "could not be made: SystemExit: 3",
        "brokenlaser:make": "'brokenlaser:make' cannot be loaded: no licence",
        "otherlaser:nonsense": "made a object, which lacks one of info, start, stop, faults",
    }.items():
        with pytest.raises(ConfigError, match=says):
            make_driver({"kind": kind}, "x")


def test_the_public_names_load_nothing_before_they_are_used() -> None:
    code = textwrap.dedent(
        """
        import sys, surffollow.hw as hw
        assert "numba" not in sys.modules, "import surffollow.hw is heavy"
        for name in hw.__all__:
            assert getattr(hw, name).__doc__, name
        assert "serial" not in sys.modules and "can" not in sys.modules
        """
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_example_of_40_lines_has_no_more() -> None:
    assert len((ROOT / "examples/driver/own_driver.py").read_text().splitlines()) <= 50
