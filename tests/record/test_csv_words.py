"""CSV logs with words for missing values, rows of units below the column names, and several wrong rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from csv_logs import HEADER, PLAIN, log_of, plain
from surffollow.errors import UsageError
from surffollow.record.csv_points import pose_notes, target_points
from surffollow.record.csv_replay import run_csv
from surffollow.record.forecast_scores import summarise

WORDS = ["", "N/A", "-", "null", "NaN", "None", "#N/A", "--"]


@pytest.mark.parametrize("word", WORDS)
def test_a_word_for_a_missing_value_is_no_reading(tmp_path: Path, word: str) -> None:
    log = log_of(tmp_path, HEADER + f"1,{word},0,0,0,0,0,0\n2,20,0,0,0,0,0,0\n")
    assert np.isfinite(log.range_m).tolist() == [False, True]
    assert log.has_pose().all()


@pytest.mark.parametrize("column", range(2, 8))
@pytest.mark.parametrize("word", WORDS[:4])
def test_a_row_without_a_value_of_the_pose_has_no_pose(tmp_path: Path, word: str, column: int) -> None:
    cells = ["2", "20", *"000000"]
    cells[column] = word
    log = log_of(tmp_path, HEADER + "1,20,0,0,0,0,0,0\n" + ",".join(cells) + "\n")
    assert log.has_pose().tolist() == [True, False]
    assert np.isfinite(log.range_m).all()
    assert np.isnan(log.pose[1]).all()


def test_a_depth_needs_no_attitude(tmp_path: Path) -> None:
    columns = plain(range={"column": "d", "unit": "cm", "kind": "depth"})
    log = log_of(tmp_path, HEADER + "1,20,0,0,0,-,-,-\n", columns)
    assert log.has_pose().all()


def test_a_reading_between_poses_has_a_point_and_one_in_a_long_gap_has_none(tmp_path: Path) -> None:
    """Poses every 100 ms, readings between them, and a gap of a second."""
    rows = ["50,100,-,-,-,-,-,-"]
    for t in (*range(100, 1000, 100), *range(2000, 3000, 100)):
        rows += [f"{t},,0,{t},0,0,0,0", f"{t + 50},100,,,,,,"]
    log = log_of(tmp_path, HEADER + "\n".join(rows) + "\n")
    points, read = target_points(log, plain()), np.isfinite(log.range_m)
    with_point = [round(1e3 * t) for t in log.t_s[read & np.isfinite(points[:, 0])]]
    assert with_point == [*range(150, 900, 100), *range(2050, 2900, 100)]
    np.testing.assert_allclose(points[np.isfinite(points[:, 0]), 0], 1e-3 * np.array(with_point))
    (note,) = pose_notes(log, points)
    assert note.startswith(
        "20 of 39 rows have no pose, because a cell of it has no value: line 2, 4, 6, 8, 10 "
    )
    assert "3 of 20 readings have no target point" in note


def test_a_log_of_ranges_and_poses_in_rows_of_their_own_is_followed(tmp_path: Path) -> None:
    rows = ["0,100,,,,,,"]
    for t in range(10, 5000, 20):
        rows += [f"{t},,0,{t},0,0,0,0", f"{t + 10},100,,,,,,"]
    log = log_of(tmp_path, HEADER + "\n".join(rows) + "\n")
    replay = run_csv(log, plain())
    assert np.isnan(replay.height_m[0]), "no pose yet"
    np.testing.assert_allclose(replay.height_m[50:], -1.0, atol=1e-6)
    summary = summarise("log.csv", replay, plain())
    assert any("have no pose" in note for note in summary["notes"])
    assert summary["forecast"][0]["n"] > 150


def test_a_part_of_a_log_without_a_pose_is_refused(tmp_path: Path) -> None:
    log = log_of(tmp_path, HEADER + "1000,20,0,0,0,0,0,0\n2000,20,-,0,0,0,0,0\n").between(1.5, None)
    with pytest.raises(UsageError, match="none of the 1 rows has a pose: "):
        run_csv(log, plain())


@pytest.mark.parametrize("empty", range(2, 8))
def test_a_column_of_the_pose_without_any_value_is_refused(tmp_path: Path, empty: int) -> None:
    row = ",".join("-" if k == empty else "20" for k in range(8))
    with pytest.raises(UsageError, match=f"column '{HEADER.strip().split(',')[empty]}' has no value in any"):
        log_of(tmp_path, HEADER + f"{row}\n{row}\n")


@pytest.mark.parametrize(
    "units",
    [
        "ms,cm,mm,mm,mm,deg,deg,deg",
        "[ms],(cm),mm,,-,Degrees,°,deg",
        "[-],[cm],[-],,,,,",
        "msec,CM,mm,mm,mm,,,",
    ],
)
def test_a_row_of_units_is_no_row(tmp_path: Path, units: str) -> None:
    log = log_of(tmp_path, HEADER + f"{units}\n\n1500,200,0,0,0,0,0,0\n")
    assert (log.t_s.tolist(), log.range_m.tolist()) == ([1.5], [2.0])
    assert log.lines is not None
    assert log.lines.tolist() == [4]


@pytest.mark.parametrize(
    ("units", "message"),
    [
        ("s,cm,mm,mm,mm,deg,deg,deg", r"'t' is in s, the column file says ms; write \[time\] unit = \"s\""),
        (
            "ms,[m],mm,mm,mm,deg,deg,deg",
            r"'d' is in m, the column file says cm; write \[range\] unit = \"m\"",
        ),
        ("ms,cm,mm,mm,metres,deg,deg,deg", r"'u' is in m, .* write \[position\] unit = \"m\" in the column"),
        ("ms,cm,mm,mm,mm,deg,deg,rad", r"'yaw' is in rad, .* write \[attitude\] unit = \"rad\""),
        ("ms,V,mm,mm,mm,deg,deg,7", r", column 't': 'ms' is not a finite number"),
    ],
)
def test_a_row_of_units_that_contradicts_the_column_file_is_refused(
    tmp_path: Path, units: str, message: str
) -> None:
    with pytest.raises(UsageError, match=r"log\.csv, line 2.*" + message):
        log_of(tmp_path, HEADER + f"{units}\n1500,200,0,0,0,0,0,0\n")


def test_a_row_of_units_of_dates_is_no_row(tmp_path: Path) -> None:
    columns = plain(time={"column": "t", "unit": "iso8601"})
    log = log_of(tmp_path, HEADER + "UTC,cm,mm,mm,mm,,,\n2025-05-04T09:30:00Z,20,0,0,0,0,0,0\n", columns)
    assert log.t_s.tolist() == [1746351000.0]


def test_wrong_rows_are_counted_and_the_first_are_shown(tmp_path: Path) -> None:
    rows = [f"{k},20,0,0,0,0,0,0" for k in range(20)]
    for k, row in {2: "x,20,0,0,0,0,0,0", 4: "4,20,0,0,0,0,0,0,1", 7: ",2,0,0,0,0,0,0"}.items():
        rows[k] = row
    for k in range(10, 15):
        rows[k] = f"{k},{'e' * 40},0,0,0,0,0,0"
    with pytest.raises(UsageError) as e:
        log_of(tmp_path, HEADER + "\n".join(rows) + "\n")
    assert str(e.value).endswith(
        "log.csv, line 4, column 't': 'x' is not a finite number; correct or remove the row. 8 of 20 rows "
        "are wrong: line 4 (t: 'x'), line 6 (9 values for 8 columns), line 9 (t: ''), "
        f"line 12 (d: '{'e' * 30}…'), line 13 (d: '{'e' * 30}…') and 3 more"
    )


def test_times_have_no_missing_value(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="line 3, column 't': '-' is not a finite number"):
        log_of(tmp_path, HEADER + "1,2,0,0,0,0,0,0\n-,2,0,0,0,0,0,0\n3,2,0,0,0,0,0,0\n")


def test_the_reference_may_have_missing_values(tmp_path: Path) -> None:
    columns = plain(**PLAIN, reference={"column": "g", "unit": "m"})
    log = log_of(tmp_path, HEADER.strip() + ",g\n1,2,0,0,0,0,0,0,n/a\n2,2,0,0,0,0,0,0,5\n", columns)
    assert log.reference_m is not None
    assert np.isnan(log.reference_m).tolist() == [True, False]
