"""Outputs of `surffollow scan` that cannot be: refused before any work, and nothing is overwritten."""

from __future__ import annotations

import numpy as np
import pytest
from click.testing import CliRunner

import surffollow.apps.field_demo
from surffollow.cli.scan import scan_group
from surffollow.errors import SurffollowError
from surffollow.map import HeightMap

SPOTS = "x_m,y_m,correction_m\n0,0,0.005\n1,0,0.006\n0,1,0.01\n1,1,0.002\n"


def run(*arguments):
    return CliRunner().invoke(scan_group, [str(a) for a in arguments])


def test_touched_spots_are_not_overwritten(tmp_path):
    spots = tmp_path / "spots.csv"
    spots.write_text(SPOTS)
    (tmp_path / "link.json").symlink_to(spots)
    for output in (spots, tmp_path / "link.json"):
        got = run("calibrate", spots, "-o", output)
        assert got.exit_code == 2
        assert "is read by this command" in got.output
    assert spots.read_text() == SPOTS


@pytest.mark.parametrize("output", ["a.npz", "stations.toml"])
def test_stations_are_not_overwritten(output, tmp_path):
    ground, stations = tmp_path / "a.npz", tmp_path / "stations.toml"
    HeightMap.from_heights(np.zeros((20, 20)), origin_m=(0, 0), grid_m=0.01).save(ground)
    stations.write_text('[stations."a.npz"]\nx_m = 0.5\ny_m = 0.0\n')
    before = ground.read_bytes(), stations.read_bytes()
    got = run("compose", stations, "-o", tmp_path / output)
    assert got.exit_code == 2
    assert "is read by this command" in got.output
    assert (ground.read_bytes(), stations.read_bytes()) == before


@pytest.mark.parametrize("option", ["--picture", "--report", "--signal"])
def test_a_demonstration_that_cannot_be_written_does_not_begin(option, tmp_path, monkeypatch):
    monkeypatch.setattr(surffollow.apps.field_demo, "demonstrate", lambda *_: pytest.fail("it began"))
    got = run("demo", option, tmp_path / "none" / "x.png")
    assert isinstance(got.exception, SurffollowError)
    assert "cannot write" in str(got.exception)


def test_two_outputs_of_one_name_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(surffollow.apps.field_demo, "demonstrate", lambda *_: pytest.fail("it began"))
    got = run("demo", "--picture", tmp_path / "x.png", "--report", tmp_path / "x.png")
    assert got.exit_code == 2
    assert "is written twice" in got.output
