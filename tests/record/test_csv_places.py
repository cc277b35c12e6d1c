"""CSV logs with a clock's times and a survey's coordinates: exact tables, late readings, rows far away."""

from __future__ import annotations

import csv
import errno
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from surffollow.cli.replay import replay_command
from surffollow.errors import MapFileError, UsageError
from surffollow.map import HeightMap
from surffollow.record.columns import Columns, load_columns
from surffollow.record.csv_log import CsvLog, read_csv
from surffollow.record.csv_points import target_points
from surffollow.record.csv_replay import run_csv, write_rows

COLUMNS = """
[time]
column = "t"
unit = "s"
[range]
column = "r"
unit = "m"
max = "100 m"
delay = "{delay} s"
[position]
east = "e"
north = "n"
up = "u"
unit = "m"
[attitude]
roll = "roll"
pitch = "pitch"
yaw = "yaw"
unit = "deg"
"""
CLOCK_S, EAST_M, NORTH_M = 1732716000, 512345.6789, 5812345.6789
RISE_MPS, SPEED_MPS = 1.0, 5.0
LATE_S = 0.2


def row(t: float, *, late_s: float = 0.0, yaw: float = 0.0, pitch: float = 0.0) -> str:
    """A vehicle that rises over level ground at 0; its range is as old as `late_s`."""
    up, then = 2.0 + RISE_MPS * t, 2.0 + RISE_MPS * max(0.0, t - late_s)
    east = EAST_M + SPEED_MPS * t
    return f"{CLOCK_S + t:.3f},{east:.4f},{NORTH_M},{up:.4f},{then:.4f},0,{pitch:.6f},{yaw:.6f}"


def survey(folder: Path, rows: list[str], delay_s: float = 0.0) -> tuple[CsvLog, Columns]:
    (folder / "log.csv").write_text("t,e,n,u,r,roll,pitch,yaw\n" + "\n".join(rows) + "\n")
    (folder / "c.toml").write_text(COLUMNS.format(delay=delay_s))
    columns = load_columns(folder / "c.toml")
    return read_csv(folder / "log.csv", columns), columns


def replayed(folder: Path, *options: str) -> str:
    words = [str(folder / "log.csv"), "--columns", str(folder / "c.toml"), *options]
    done = CliRunner().invoke(replay_command, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


def test_a_table_holds_times_and_places_as_they_were(tmp_path: Path) -> None:
    log, _ = survey(tmp_path, [row(0.02 * k) for k in range(100)])
    replayed(tmp_path, "--out", str(tmp_path / "rows.csv"))
    with open(tmp_path / "rows.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(r["t_s"]) for r in rows] == log.t_s.tolist()
    assert [float(r["range_m"]) for r in rows] == log.range_m.tolist()
    np.testing.assert_allclose([float(r["target_x_m"]) for r in rows], log.pose[:, 0], atol=1e-8, rtol=0)
    np.testing.assert_allclose([float(r["target_y_m"]) for r in rows], log.pose[:, 1], atol=1e-8, rtol=0)


def test_the_summary_and_the_figure_tell_the_first_time_from_the_last(tmp_path: Path) -> None:
    survey(tmp_path, [row(0.02 * k) for k in range(100)])
    figure = tmp_path / "log.svg"
    text = replayed(tmp_path, "--plot", str(figure))
    assert f"{CLOCK_S} to {CLOCK_S + 1}.98 s" in text
    drawn = figure.read_text()
    assert f"since {CLOCK_S} s of the log" in drawn
    texts = re.findall("<!-- (.*?) -->|<text[^>]*>([^<]*)<", drawn)
    assert len(texts) > 20
    assert not [t for t in texts if re.search(r"\de[+-]?\d", "".join(t))]  # no tick has an exponent


def test_a_log_with_dates_is_cut_and_described_by_dates(tmp_path: Path) -> None:
    rows = [row(0.5 * k).split(",", 1)[1] for k in range(40)]
    dated = [f"2024-11-27T14:{20 + k // 20}:{k % 20 * 3:02d}.250Z,{text}" for k, text in enumerate(rows)]
    survey(tmp_path, [row(0.0), row(1.0)])
    (tmp_path / "log.csv").write_text("t,e,n,u,r,roll,pitch,yaw\n" + "\n".join(dated) + "\n")
    declared = (tmp_path / "c.toml").read_text().replace('unit = "s"', 'unit = "iso8601"', 1)
    (tmp_path / "c.toml").write_text(declared)
    figure = tmp_path / "log.svg"
    text = replayed(tmp_path, "--plot", str(figure))
    assert "2024-11-27T14:20:00.250Z to 2024-11-27T14:21:57.250Z, adaptive mode" in text
    assert "since 2024-11-27T14:20:00.250Z<" in figure.read_text()
    cut = ["--start", "2024-11-27T14:21:00Z", "--end", "2024-11-27 14:21:30.5", "--json"]
    said = json.loads(replayed(tmp_path, *cut))
    assert (said["rows"], said["start"]) == (11, "2024-11-27T14:21:00.250Z")
    assert said["end"] == "2024-11-27T14:21:30.250Z"
    assert said["start_s"] == 1732717260.25


def test_a_late_reading_gives_a_point_below_the_place_where_it_was_taken(tmp_path: Path) -> None:
    log, columns = survey(tmp_path, [row(0.03 * k, late_s=LATE_S) for k in range(200)], LATE_S)
    points = target_points(log, columns)
    known = log.elapsed_s() >= LATE_S
    assert np.isnan(points[~known]).all()
    assert np.abs(points[known, 2]).max() < 1e-6
    then_m = EAST_M + SPEED_MPS * (log.elapsed_s()[known] - LATE_S)
    assert np.abs(points[known, 0] - then_m).max() < 2e-4  # the log has four decimals
    replayed(tmp_path, "--map", str(tmp_path / "m.npz"))
    heights = HeightMap.load(tmp_path / "m.npz").heights_m
    assert np.nanmax(np.abs(heights)) < 2e-3


@pytest.mark.parametrize(("delay_s", "tolerance_m"), [(0.2, 1e-5), (0.15, 5e-3)])
def test_a_late_reading_has_the_attitude_of_its_time(
    tmp_path: Path, delay_s: float, tolerance_m: float
) -> None:
    """A beam of 10 m on a vehicle that turns evenly, with north in between, and pitches."""

    def at(t: float) -> str:
        return row(t, yaw=(330.0 + 20.0 * t) % 360.0, pitch=5.0 * np.sin(t))

    times = 0.1 * np.arange(60)
    log, late = survey(tmp_path, [at(t) for t in times], delay_s)
    earlier, prompt = survey(tmp_path, [at(t) for t in times - delay_s])
    ten_m = np.full(60, 10.0)
    points = target_points(CsvLog(log.t_s, ten_m, log.pose, None), late)[2:]
    true = target_points(CsvLog(log.t_s, ten_m, earlier.pose, None), prompt)[2:]
    np.testing.assert_allclose(points, true, atol=tolerance_m, rtol=0)


def test_rows_of_one_time_and_a_log_of_one_row_have_points_where_a_pose_is_known(tmp_path: Path) -> None:
    log, columns = survey(tmp_path, [row(t) for t in (0.0, 0.1, 0.1, 0.3, 0.3, 0.4)], LATE_S)
    points = target_points(log, columns)
    assert np.isfinite(points[:, 0]).tolist() == [False, False, False, True, True, True]
    np.testing.assert_allclose(points[3:, 0] - EAST_M, [0.5, 0.5, 1.0], atol=1e-3)
    log, columns = survey(tmp_path, [row(0.0)], LATE_S)
    assert np.isnan(target_points(log, columns)).all()


@pytest.mark.parametrize("rows", [1, 3])
@pytest.mark.filterwarnings("error")
def test_a_log_that_is_shorter_than_its_delay_has_a_table_and_a_figure(tmp_path: Path, rows: int) -> None:
    survey(tmp_path, [row(0.05 * k) for k in range(rows)], LATE_S)
    replayed(tmp_path, "--out", str(tmp_path / "rows.csv"), "--plot", str(tmp_path / "log.svg"))
    assert (tmp_path / "rows.csv").read_text().count("\n") == rows + 1
    assert "shorter than the delay" in (tmp_path / "log.svg").read_text()


def test_a_table_that_cannot_be_written_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, columns = survey(tmp_path, [row(0.02 * k) for k in range(20)])
    replay = run_csv(log, columns)
    (tmp_path / "rows.csv").write_text("of yesterday\n")

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(MapFileError, match=r"cannot write .*rows\.csv: No space left"):
        write_rows(tmp_path / "rows.csv", replay)
    assert (tmp_path / "rows.csv").read_text() == "of yesterday\n"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.toml", "log.csv", "rows.csv"]


@pytest.mark.parametrize("cell", ["1_5.0", "1_732_716_000"])
@pytest.mark.parametrize("column", [0, 1, 4])
def test_digits_grouped_by_underscores_are_no_number(tmp_path: Path, cell: str, column: int) -> None:
    cells = row(0.0).split(",")
    cells[column] = cell
    with pytest.raises(UsageError, match=f"line 2, column '.': '{cell}' is not a finite number"):
        survey(tmp_path, [",".join(cells)])


def test_a_row_at_zero_among_a_surveys_is_named_before_anything_is_written(tmp_path: Path) -> None:
    rows = [row(0.02 * k) for k in range(100)]
    rows[40] = f"{CLOCK_S + 0.8:.3f},0,0,0,1,0,0,0"
    survey(tmp_path, rows)
    out = str(tmp_path / "rows.csv")
    with pytest.raises(UsageError, match=r"log\.csv: the target points extend over 5123\d\d\.\d+ × 58") as e:
        replayed(tmp_path, "--out", out, "--map", str(tmp_path / "m.npz"))
    assert "1 of 100 rows" in str(e.value)
    assert "line 42; correct or remove" in str(e.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.toml", "log.csv"]
    replayed(tmp_path, "--out", out)


def test_a_row_far_away_that_makes_the_grids_coarse_is_named_in_a_note(tmp_path: Path) -> None:
    rows = [row(0.02 * k) for k in range(100)]
    survey(tmp_path, rows)
    assert "note" not in replayed(tmp_path, "--map", str(tmp_path / "m.npz"))
    rows[40] = f"{CLOCK_S + 0.8:.3f},{EAST_M - 3e5},{NORTH_M - 3e5},0,1,0,0,0"
    survey(tmp_path, rows)
    text = replayed(tmp_path, "--map", str(tmp_path / "m.npz"))
    assert "note: the map's grids are" in text
    assert "1 of 100 rows" in text
    assert "line 42;" in text


def test_an_outlier_in_the_map_is_named_in_a_note(tmp_path: Path) -> None:
    rows = [row(0.02 * k) for k in range(100)]
    cells = rows[40].split(",")
    cells[4] = "60"
    rows[40] = ",".join(cells)
    survey(tmp_path, rows)
    assert "note" not in replayed(tmp_path)
    text = replayed(tmp_path, "--map", str(tmp_path / "m.npz"))
    assert "note: the map has 1 target point far above or below the neighbours" in text
    assert "line 42; correct or remove the rows, or leave them out with [range] min and max" in text
