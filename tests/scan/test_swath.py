"""Swaths and widths of bodies: what a pass covers, and what the body itself does not."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from click.testing import CliRunner

from surffollow.cli.scan import scan_group
from surffollow.map import HeightMap
from surffollow.scan import TerrainGrid, parse_body
from surffollow.scan.check import check_path
from surffollow.scan.limits import Annulus
from surffollow.scan.path_file import write_path
from surffollow.scan.plan import PlanSettings, plan_scan
from surffollow.scan.swath import swath_warning

GROUND = TerrainGrid.of(np.zeros((120, 140)), grid_m=0.01)
REGION = (0.25, 0.25, 1.15, 0.95)
BASE = (-0.5, 0.6, 0.5)


def run(*words):
    got = CliRunner().invoke(scan_group, [str(w) for w in words])
    assert got.exit_code == 0, got.output
    return got


@pytest.fixture
def ground(tmp_path):
    HeightMap.from_heights(np.zeros((320, 340)), origin_m=(-1, -1), grid_m=0.01).save(tmp_path / "m.npz")
    return tmp_path / "m.npz"


def planned(ground, *options):
    path = ground.with_name("p.csv")
    region = ",".join(map(str, REGION))
    return path, run("plan", ground, "--region", region, "--gap", "5cm", *options, "-o", path)


def test_passes_farther_apart_than_the_body_is_wide_are_warned_of_by_plan_and_check(ground):
    """Two passes of 0.2 m over 0.7 m: the body itself passes over 4/7 of the region."""
    path, plan = planned(ground, "--body", "disc:0.1", "--swath", "0.4")
    assert "warning: passes are 0.35 m apart for a swath of 0.4 m, but the body is 0.2 m wide" in plan.stderr
    check = run("check", ground, path)
    [line] = [x for x in check.output.splitlines() if x.startswith("warn")]
    assert "a swath is 0.4 m wide, the body 0.2 m" in line
    part = float(line.split("passes over ")[1].split(" %")[0])
    assert part == pytest.approx(400 / 7, abs=1.0)  # two places of 128
    assert check.output.splitlines()[-1] == "accepted, with a warning: swath"
    found = json.loads(run("check", ground, path, "--json").output)
    assert found["accepted"]
    assert [f["name"] for f in found["findings"] if f["warning"]] == ["swath"]


@pytest.mark.parametrize(
    "options",
    [
        ["--body", "disc:0.1"],
        ["--body", "disc:0.1", "--angle", "15deg"],
        ["--body", "ring:0.1", "--angle", "11deg"],
        ["--body", "rectangle:0.3x0.1"],
        ["--body", "point", "--swath", "0.2"],
    ],
)
def test_a_swath_of_the_bodys_width_is_no_reason_for_a_warning(ground, options):
    path, plan = planned(ground, *options)
    assert "warning" not in plan.stderr
    assert run("check", ground, path).output.splitlines()[-1] == "accepted"


@pytest.mark.parametrize(
    ("options", "width_m"),
    [
        ({}, 0.1),
        ({"angle_rad": math.radians(90.0)}, 0.3),
        ({"scheme": "arcs", "base_m": BASE}, 0.3),
        ({"work_space": Annulus(BASE, radius_max_m=3.0)}, 0.1),
    ],
    ids=["along", "across", "arcs", "turned"],
)
def test_passes_are_no_farther_apart_than_a_plate_is_wide_across_them(tmp_path, options, width_m):
    """The diagonal of the plate, 0.316 m, was taken for its width."""
    plan = plan_scan(GROUND, PlanSettings(REGION, 0.05, parse_body("rectangle:0.3x0.1"), **options))
    assert plan.facts["swath_m"] == pytest.approx(width_m)
    assert swath_warning(plan) is None
    write_path(tmp_path / "p.csv", plan)
    findings = {f.name: f for f in check_path(GROUND.heights_m, (0.0, 0.0), 0.01, tmp_path / "p.csv")}
    assert findings["swath"].value >= width_m - 1e-9
    assert findings["coverage"].ok


def test_the_warning_of_a_turned_plate_takes_the_width_that_it_has_across_the_pass(tmp_path):
    plan = plan_scan(GROUND, PlanSettings(REGION, 0.05, parse_body("rectangle:0.3x0.1"), swath_m=0.3))
    assert "the body is 0.1 m wide" in swath_warning(plan)
    write_path(tmp_path / "p.csv", plan)
    findings = {f.name: f for f in check_path(GROUND.heights_m, (0.0, 0.0), 0.01, tmp_path / "p.csv")}
    assert findings["swath"].warning
    assert findings["swath"].value == pytest.approx(0.1)
