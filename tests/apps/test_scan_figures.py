"""Figures and pictures of scans at a gap of metres, as drones fly them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from surffollow.apps import scan_report
from surffollow.apps.scan_expected import expected_range_m
from surffollow.apps.scan_figures import true_figures
from surffollow.apps.scan_gap import GapWatch
from surffollow.apps.scan_run import Executed, progress_text
from surffollow.cli.scan_run import _print_gap
from surffollow.scan import pictures
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.path import ScanPath
from surffollow.sim.surfaces import HeightField
from surffollow.units import length_unit

GAP_M = 2.0
EAST_M, NORTH_M = 452300.0, 5411200.0


def path_at(height_m: float) -> ScanPath:
    """A level pass over 4 m in 4 s."""
    n = 50
    xy_m = np.column_stack([EAST_M + 3.0 + np.linspace(0.0, 4.0, n), NORTH_M + np.linspace(4.0, 5.0, n)])
    facts = {"gap_m": GAP_M, "body_m": [[0.0, 0.0, 0.0]]}
    made = ScanPath.planar(xy_m, np.zeros(n, np.int32), facts=facts)
    position_m = np.column_stack([xy_m, np.full(n, height_m)])
    return made.changed(
        position_m=position_m,
        t_s=np.linspace(0.0, 4.0, n),
        clearance_m=np.full(n, height_m),
        lift_m=np.zeros(n),
    )


def executed(path: ScanPath) -> Executed:
    """That path without an error."""
    t = path.t_s
    columns = {"t_s": t, "path_s": t, "rate": np.ones(len(t)), "scanning": np.ones(len(t))}
    columns |= {f"real_{c}_m": path.position_m[:, k] for k, c in enumerate("xyz")}
    columns |= {f"n{c}": path.normal[:, k] for k, c in enumerate("xyz")} | {"z_m": path.position_m[:, 2]}
    ranges_m = np.column_stack([t, np.full(len(t), GAP_M)])
    summary: dict[str, Any] = {"finished": True, "progress": 1.0, "planned_s": 4.0, "way": "plan"}
    summary |= {"inside_times": 0, "from_s": 1.0, "followed_to_s": 4.0, "continue_from": None}
    return Executed(
        path, columns, ranges_m, np.zeros(len(t)), np.full(len(t), path.position_m[0, 2]), summary
    )


def flat(slope: float = 0.0) -> TerrainGrid:
    return TerrainGrid.of(slope * np.tile(np.arange(20.0), (20, 1)), origin_m=(EAST_M, NORTH_M), grid_m=0.5)


def field() -> HeightField:
    return HeightField(np.zeros((20, 20)), EAST_M + 0.25, NORTH_M + 0.25, 0.5)


def test_the_expected_range_sees_the_ground_at_a_gap_of_metres() -> None:
    assert expected_range_m(path_at(2.4), flat()) == pytest.approx(2.4, abs=1e-6)


def test_errors_count_at_a_gap_of_metres_and_are_none_where_nothing_is_in_reach() -> None:
    found = true_figures(executed(path_at(2.4)), field())
    assert found["rms_m"] == pytest.approx(0.0, abs=1e-6)
    found = true_figures(executed(path_at(50.0)), field())
    assert (found["rms_m"], found["p99_m"], found["mean_m"]) == (None, None, None)
    assert found["clearance_min_m"] == pytest.approx(50.0, abs=1e-3)


def test_pictures_at_a_gap_of_metres_have_metres_and_keep_the_origin_of_far_places(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []
    for module in (pictures, scan_report):
        monkeypatch.setattr(module, "save_figure", lambda figure, path: made.append(figure))
    pictures.draw_plan(tmp_path / "plan.png", flat(0.1), path_at(2.4))
    scan_report.draw_run(tmp_path / "run.png", executed(path_at(2.4)), flat(0.1))
    scan_report.draw_run(tmp_path / "run.png", executed(path_at(2.4)), None)
    for figure in made:
        labels = [text for axes in figure.axes for text in (axes.get_xlabel(), axes.get_ylabel())]
        assert not [text for text in labels if "mm" in text]
        assert f"x − {EAST_M:.0f} m [m]" in labels
    plan, run, _ = made
    assert "clearance, lift [m]" in [axes.get_ylabel() for axes in plan.axes]
    assert "stand-off [m]" in [axes.get_ylabel() for axes in run.axes]


def test_the_progress_of_a_run_has_the_unit_of_its_gap_and_a_dash_without_a_reading() -> None:
    assert progress_text("scan", 2.0126, length_unit(GAP_M)) == "scan, stand-off 2.013 m"
    assert progress_text("scan", 0.0523, length_unit(0.05)) == "scan, stand-off 52.3 mm"
    assert progress_text("approach", float("nan"), length_unit(0.05)) == "approach, stand-off -"


def robot_inside(gap_m: float, limit_m: float) -> Any:
    """A robot 13 mm inside its gap that needs a lift of 3 m."""
    monitor = SimpleNamespace(gap_m=gap_m, clearance_m=lambda pose: gap_m - 0.0133)
    rest = {"newest": np.zeros(7), "number": 0, "t_ns": 1, "state": {"start_ns": [0]}, "lifting_s": 1.0}
    return SimpleNamespace(
        desired_m=gap_m, monitor=monitor, leaving=False, inside=True, lift_m=3.0, limit_m=limit_m, **rest
    )


def test_texts_of_events_have_the_unit_of_the_gap(capsys: pytest.CaptureFixture[str]) -> None:
    # GIVEN a tool inside a gap of metres
    watch = GapWatch(robot_inside(GAP_M, GAP_M))
    # THEN the line and the reason are in metres
    assert watch.tick(None) == ["inside the gap: 1.987 m from the ground at x 0.000, y 0.000 m"]
    assert watch.why == (
        "the underside is 1.987 m from the ground at x 0.000, y 0.000 m, the gap is 2.000 m: it needs more "
        "lift than the correction may be (2 m)"
    )
    narrow = GapWatch(robot_inside(0.05, 0.05))
    assert narrow.tick(None) == ["inside the gap: 36.7 mm from the ground at x 0.000, y 0.000 m"]
    assert narrow.why.endswith("(50 mm)")
    # AND so is the list that the command prints
    done = executed(path_at(2.4))
    figures = {"stop_reason": "", "inside_times": 1, "inside_s": 1.0, "inside_least_m": 1.9867}
    done = replace(done, inside=watch.events)
    done.summary.update(figures | {"inside_later_part": 0.0, "coverage": None})
    _print_gap(done)
    said = capsys.readouterr().err
    assert "pass 1, x 0.000, y 0.000 m: 1.987 m\n" in said
    assert "at least 1.987 m away" in said
    assert "mm" not in said
