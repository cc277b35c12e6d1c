"""The field demonstration end to end on the finished package, and `scan calibrate` on files."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from surffollow.apps.field import Errors, make_field, survey_field
from surffollow.apps.field_calibration import as_seen, calibrate, touch
from surffollow.apps.field_demo import demonstrate, failures, shaper_of
from surffollow.apps.field_report import write_report
from surffollow.apps.field_scan import Task, plan, run
from surffollow.cli.main import cli
from surffollow.map import HeightMap
from surffollow.scan.calibration import CalibrationMatrix
from surffollow.scan.shaping import Shaper


@pytest.fixture(scope="module")
def made():
    return demonstrate("bumpy", 11)


def test_a_scan_with_everything_on_keeps_the_gap_and_finds_the_target(made):
    f = made.figures
    assert f["failures"] == []
    assert f["shaped"]["gap_error_p99_m"] <= 5e-3
    assert f["target"]["error_m"] <= 0.03
    line = f["line"]
    assert line["zvd"]["residual_m"] <= 0.1 * line["unshaped"]["residual_m"]
    assert max(line["ei"]["residual_part"].values()) <= 0.1
    assert f["shaped"]["tip_acceleration_rms_mps2"] < f["unshaped"]["tip_acceleration_rms_mps2"]
    assert f["calibration"]["mode_hz"] == pytest.approx(2.0, rel=0.02)
    json.dumps(f, allow_nan=False)


def test_the_report_is_one_page_with_picture_and_figures(made, tmp_path):
    pytest.importorskip("matplotlib", reason="extra `plot`")
    write_report(tmp_path / "scan.html", made, {"elements": [{"switched_off": "<noise>", "x_m": 0.5}]})
    page = (tmp_path / "scan.html").read_text(encoding="utf-8")
    assert "all limits met" in page
    assert page.count("data:image/png;base64,") == 1
    assert "&lt;noise&gt;" in page
    assert f"<td>{1e3 * made.figures['shaped']['gap_error_p99_m']:.1f}</td>" in page


def test_a_missed_criterion_is_reported(made):
    worse = json.loads(json.dumps(made.figures))
    worse["shaped"]["gap_error_p99_m"] = 0.006
    worse["target"]["error_m"] = 0.04
    worse["line"]["zvd"]["residual_m"] = 1.0
    assert len(failures(worse)) == 3


def test_an_arm_without_calibration_misses_by_more_than_the_calibrated_one(made):
    """On ground that is known exactly, so that nothing but the arm's errors is left."""
    place = make_field("flat", 3, Errors(noise=False, modes=False, sway=False))
    command, touched = touch(place)
    real, _, _ = place.real_tip(command, np.tile([0.0, 0.0, 1.0], (len(command), 1)))
    ground = [place.ground.height_m(x, y) for x, y in real[:, :2]]
    assert np.abs(real[:, 2] - ground).max() < 1e-6  # a touch is a touch
    assert np.abs(as_seen(place, touched) - touched).max() > 2e-3  # and the camera sees it elsewhere
    exact = make_field("bumpy", 3, Errors(False, False, False, False, False, False))
    task = Task(following="atf", smooth_m=0.0)
    path = plan(exact.true_grid(), task, Shaper.none())
    assert run(exact, path, None, task).figures()["gap_error_p99_m"] < 3e-4


def test_the_same_seed_gives_the_same_map_and_another_one_another():
    first, again = (survey_field(make_field("flat", 5)).heights_m for _ in range(2))
    assert np.array_equal(first, again, equal_nan=True)
    assert not np.array_equal(first, survey_field(make_field("flat", 6)).heights_m, equal_nan=True)


def test_calibrate_command_makes_the_matrix_of_a_spot_file(tmp_path):
    rng = np.random.default_rng(0)
    xy = rng.uniform(0.1, 0.9, (20, 2))
    HeightMap.from_heights(np.full((100, 100), 0.2), origin_m=(0.0, 0.0), grid_m=0.01).save(
        tmp_path / "m.npz"
    )
    lines = [f"{x:.6f},{y:.6f},{0.2 + 0.01 * x:.6f}" for x, y in xy]
    (tmp_path / "spots.csv").write_text("x_m,y_m,z_m\n" + "\n".join(lines) + "\n")
    words = ["scan", "calibrate", str(tmp_path / "spots.csv"), "-o", str(tmp_path / "arm.json"), "--json"]
    done = CliRunner().invoke(cli, [*words, "--map", str(tmp_path / "m.npz")])
    assert done.exit_code == 0, done.output
    facts = json.loads(done.stdout)
    assert facts["spots"] == 20
    assert facts["left_out_max_m"] < 1e-4
    matrix = CalibrationMatrix.load(tmp_path / "arm.json")
    assert matrix.at(xy) == pytest.approx(0.01 * xy[:, 0], abs=1e-3)
    bad = CliRunner().invoke(cli, words)  # no correction_m without a map
    assert bad.exit_code != 0
    assert "correction_m" in str(bad.exception) + bad.output


def test_calibration_is_better_than_none_on_the_sagging_arm():
    place = make_field("flat", 8, Errors(noise=False))
    ground, found, task = survey_field(place), calibrate(place), Task()
    path = plan(ground, task, shaper_of(found))
    with_it, without = (run(place, path, c, task).figures() for c in (found, None))
    assert with_it["gap_error_rms_m"] < without["gap_error_rms_m"]
