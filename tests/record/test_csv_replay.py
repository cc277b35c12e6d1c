"""CSV logs as followed: heights, slopes, and the pairs that score a forecast."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import os
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from csv_logs import EXAMPLES, HEADER, ROOT, log_of, plain
from surffollow.cli.csv_replay import csv_text
from surffollow.cli.replay import replay_command
from surffollow.errors import InputFileError, UsageError
from surffollow.map import HeightMap
from surffollow.record.columns import Columns, load_columns
from surffollow.record.csv_log import CsvLog, read_csv
from surffollow.record.csv_replay import (
    ROWS_PER_REPORT,
    CsvReplay,
    follow_notes,
    horizon_notes,
    make_follower,
    run_csv,
    write_rows,
)
from surffollow.record.forecast_scores import score_forecast, summarise

DATA = Path(os.environ.get("SURFFOLLOW_DATA", ROOT.parent / "shared" / "data"))


def test_an_unknown_parameter_of_the_follower_is_refused(tmp_path: Path) -> None:
    columns = plain(follow={"intervall_size": "1 m"})
    log = log_of(tmp_path, HEADER + "1,20,0,0,0,0,0,0\n", columns)
    with pytest.raises(UsageError, match="interval_size"):
        run_csv(log, columns)


@pytest.mark.parametrize(
    ("cells", "says"),
    [
        # cm in the column file, mm in the log
        (["", "0", "12345"], "from min 0.05 to max 10 m: the first value of column 'd' is 12345 cm"),
        (["", "0", "12345"], "which is 123.45 m; check \\[range\\] unit, min and max"),
        (["", "0", "999"], "none of the 3 rows has a reading: column 'd' is empty or no_reading in all"),
    ],
)
def test_a_log_without_a_reading_is_refused_with_a_value_that_arrived(
    tmp_path: Path, cells: list[str], says: str
) -> None:
    rows = "".join(f"{n},{cell},0,0,0,0,0,0\n" for n, cell in enumerate(cells))
    with pytest.raises(UsageError, match=says):
        run_csv(log_of(tmp_path, HEADER + rows, plain()), plain())


def test_a_range_in_the_unit_of_the_kernels_is_not_converted_in_the_message(tmp_path: Path) -> None:
    columns = plain(range={"column": "d", "unit": "m", "min": "5 cm", "max": "10 m"})
    with pytest.raises(UsageError) as error:
        run_csv(log_of(tmp_path, HEADER + "1,1000,0,0,0,0,0,0\n", columns), columns)
    assert "is 1000 m (in mm it would be 1 m); check [range] unit" in str(error.value)


def test_a_log_whose_time_stands_still_is_refused_with_its_line(tmp_path: Path) -> None:
    rows = "".join(f"1000,200,{n},0,0,0,0,0\n" for n in range(150))
    with pytest.raises(UsageError, match=r"line 102, column 't': .*stands still.*check \[time\] column"):
        run_csv(log_of(tmp_path, HEADER + rows), plain())


def test_the_summary_says_why_no_forecast_could_be_compared(tmp_path: Path) -> None:
    """GIVEN a log in ms WHEN its column file says s THEN a note names the time between readings."""
    rows = "".join(f"{20 * n},200,0,0,0,0,0,0\n" for n in range(150))
    for unit, noted in (("ms", False), ("s", True)):
        columns = plain(time={"column": "t", "unit": unit})
        summary = summarise("log.csv", run_csv(log_of(tmp_path, HEADER + rows, columns), columns), columns)
        assert (summary["forecast"][0]["n"] == 0) == noted
        assert any("no forecast over 1 s" in note for note in summary["notes"]) == noted
        assert any("20 s apart" in note and "[time] unit" in note for note in summary["notes"]) == noted


@pytest.mark.parametrize("follow", [{"plant_tau": "0.5 s"}, {"plant_tau_s": 0.5}, {"plant": {"tau_s": 0.5}}])
def test_horizons_that_are_too_short_for_the_axis_are_noted(follow: dict[str, object]) -> None:
    """The forecast smooths over 3 time constants: below, a slow axis makes it worse than no change."""
    forecast = {"horizons": ["0.5 s", "1.5 s", "2 s"], "match": "0.3 s"}
    (note,) = horizon_notes(plain(follow=follow, forecast=forecast), "adaptive")
    assert "horizons of 0.5 s are below 3 plant_tau (1.5 s)" in note
    assert horizon_notes(plain(follow=follow, forecast=forecast), "paper") == []
    assert horizon_notes(plain(follow={}, forecast=forecast), "adaptive") == []


def test_the_summary_has_the_note_of_short_horizons(tmp_path: Path) -> None:
    columns = plain(follow={"plant_tau": "1 s"})
    notes = summarise("log.csv", run_csv(slope_log(tmp_path), columns), columns)["notes"]
    assert any("below 3 plant_tau (3 s)" in note for note in notes)


def make_replay(t_s: list[float], range_m: list[float], forecast_m: list[float]) -> CsvReplay:
    n = len(t_s)
    log = CsvLog(np.array(t_s), np.array(range_m), np.zeros((n, 7)), None)
    none = np.full(n, np.nan)
    return CsvReplay(log, np.full((n, 3), np.nan), none, none, np.array(forecast_m)[:, None], "paper")


def test_forecasts_are_scored_by_the_first_reading_at_or_after_the_horizon() -> None:
    nan = math.nan
    replay = make_replay(
        [0.0, 0.4, 1.0, 1.2, 1.6, 2.1, 2.55],
        [5.0, 4.0, nan, 7.0, 8.0, 3.0, 2.0],
        [5.5, 4.5, 9.0, 7.5, nan, 1.0, 1.0],
    )
    # 0.0 → 1.2 (1.0 has no reading); 0.4 → 1.6 (0.2 s late); 1.0 has no reading of its own;
    # 1.2 → 2.55 would be 0.35 s late; 1.6 has no forecast; the rest has no future
    [row] = score_forecast(replay, plain())
    assert row["n"] == 2
    assert row["rms_m"] == pytest.approx(math.sqrt((1.5**2 + 3.5**2) / 2))
    assert row["no_change_rms_m"] == pytest.approx(math.sqrt((2.0**2 + 4.0**2) / 2))


def test_a_reading_exactly_at_the_horizon_counts_whatever_its_last_bit() -> None:
    t = [k * 0.1 for k in range(40)]
    [row] = score_forecast(
        make_replay(t, [1.0] * 40, [1.0] * 40), plain(forecast={"horizons": ["1 s"], "match": 0})
    )
    assert row["n"] == 30


def slope_log(tmp_path: Path, until: int = 80) -> CsvLog:
    """A vehicle at constant height and 1 m/s over ground that rises by 0.1."""
    rows = [f"{100 * i},{300 - i},0,{100 * i},3000,0,0,90\n" for i in range(until)]
    return log_of(tmp_path, HEADER + "".join(rows))


def test_paper_mode_finds_the_height_and_slope_of_a_ramp_and_forecasts_it(tmp_path: Path) -> None:
    log = slope_log(tmp_path)
    replay = run_csv(log, plain(), "paper")
    assert replay.mode == "paper"
    # the newest interval is still filling, so its mean lags its centre
    assert replay.slope[-1] == pytest.approx(0.1, rel=0.1)
    assert replay.height_m[-1] == pytest.approx(3.0 - log.range_m[-1], abs=0.03)
    assert replay.forecast_m[-1, 0] == pytest.approx(log.range_m[-1] - replay.slope[-1])
    [row] = score_forecast(replay, plain())
    assert row["no_change_rms_m"] == pytest.approx(0.1)


@pytest.mark.parametrize("mode", ["paper", None])
def test_a_forecast_uses_no_row_after_its_own(tmp_path: Path, mode: str | None) -> None:
    whole = run_csv(slope_log(tmp_path, 60), plain(), mode)
    part = run_csv(slope_log(tmp_path, 33), plain(), mode)
    np.testing.assert_array_equal(part.forecast_m, whole.forecast_m[:33])
    np.testing.assert_array_equal(part.height_m, whole.height_m[:33])


@pytest.mark.parametrize("origin_ms", ["0", "86400000", "1763765270123", "-62135596800000"])
@pytest.mark.parametrize("cut", [False, True])
def test_the_clocks_origin_changes_no_figure(tmp_path: Path, origin_ms: str, cut: bool) -> None:
    rng = np.random.default_rng(8)
    steps_us = 100_000 * np.arange(60)
    steps_us[5::7] += rng.integers(1, 90_000, steps_us[5::7].size)
    heights_cm = 200.0 + 5.0 * np.sin(np.arange(60) / 9.0)

    def figures(origin: Decimal) -> dict[str, object]:
        rows = "".join(
            f"{origin + Decimal(int(us)) / 1000},{h:.3f},{us / 100:.2f},0,0,0,0,0\n"
            for us, h in zip(steps_us, heights_cm)
        )
        columns = plain(forecast={"horizons": ["0.2 s", "1 s", "3 s"], "match": "0.1 s"})
        log = log_of(tmp_path, HEADER + rows, columns)
        if cut:
            log = log.between(float(origin + 1050) / 1000, None)
        out = summarise("log.csv", run_csv(log, columns), columns)
        return {k: v for k, v in out.items() if k not in ("start_s", "end_s")}

    assert figures(Decimal(origin_ms)) == figures(Decimal(0))


@pytest.mark.parametrize("origin_s", [0.0, 1763765270.123])
def test_times_that_were_printed_with_a_floats_last_bit_are_scored_alike(
    tmp_path: Path, origin_s: float
) -> None:
    times = "".join(f"{origin_s + 0.1 * k:.18e},200,0,0,0,0,0,0\n" for k in range(40))
    columns = plain(time={"column": "t", "unit": "s"}, forecast={"horizons": ["1 s"], "match": 0})
    [row] = score_forecast(run_csv(log := log_of(tmp_path, HEADER + times, columns), columns), columns)
    assert log.t_s.size == 40
    assert row["n"] == 30


def test_a_log_of_micrometres_has_digits_in_the_text() -> None:
    replay = make_replay([0.0, 1.0, 2.0], [1e-4, 1.04e-4, 1.01e-4], [1.05e-4, 1.03e-4, 1e-4])
    replay = dataclasses.replace(replay, height_m=np.zeros(3), slope=np.zeros(3))
    text = csv_text(summarise("log.csv", replay, plain()))
    assert "0.0000" not in text
    assert f"{math.sqrt((1e-6**2 + 2e-6**2) / 2):.4g}" in text


def test_the_progress_of_a_long_log_is_told(tmp_path: Path) -> None:
    columns, n = plain(), 3 * ROWS_PER_REPORT
    rows = "".join(f"{k},20,0,0,0,0,0,0\n" for k in range(n))
    told: list[float] = []
    run_csv(log_of(tmp_path, HEADER + rows, columns), columns, "paper", told.append)
    assert told == pytest.approx([0.0, 1 / 3, 2 / 3, 1.0])


def test_start_and_end_choose_rows_and_an_empty_choice_names_the_times_of_the_log(tmp_path: Path) -> None:
    log = slope_log(tmp_path)
    assert log.between(1.0, 2.0).t_s.tolist() == pytest.approx([1.0 + 0.1 * k for k in range(11)])
    with pytest.raises(UsageError, match=f"the times of the log are 0 to {log.t_s[-1]:g} s"):
        log.between(100.0, None)


def test_written_rows_hold_target_height_and_slope(tmp_path: Path) -> None:
    log = slope_log(tmp_path)
    replay = run_csv(log, plain(), "paper")
    write_rows(tmp_path / "rows.csv", replay)
    with open(tmp_path / "rows.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 80
    assert float(rows[40]["target_z_m"]) == pytest.approx(3.0 - log.range_m[40])
    assert float(rows[40]["target_x_m"]) == pytest.approx(4.0)
    assert float(rows[79]["slope"]) == pytest.approx(replay.slope[79])
    assert rows[0]["reference_m"] == ""


def test_the_command_prints_json_and_says_when_columns_are_missing(tmp_path: Path) -> None:
    slope_log(tmp_path)
    columns = tmp_path / "c.toml"
    columns.write_text(
        '[time]\ncolumn = "t"\nunit = "ms"\n[range]\ncolumn = "d"\nunit = "cm"\n'
        '[position]\nnorth = "n"\neast = "e"\nup = "u"\nunit = "mm"\n'
        '[reference]\ncolumn = "yaw"\nunit = "m"\n[follow]\ninterval_size = "0.5 m"\n'
    )
    file = str(tmp_path / "log.csv")
    options = ["--columns", str(columns), "--mode", "paper", "--start", "1", "--json"]
    result = CliRunner().invoke(replay_command, [file, *options])
    assert result.exit_code == 0, result.output
    summary = json.loads(result.output)
    assert summary["rows"] == 70
    assert [row["horizon_s"] for row in summary["forecast"]] == [0.2, 0.5, 1.0, 2.0]
    assert summary["reference"]["target"]["n"] == 70
    people = CliRunner().invoke(replay_command, [file, *options[:-1]])
    assert "no change" in people.output
    with pytest.raises(UsageError, match="--columns"):
        CliRunner().invoke(replay_command, [file], catch_exceptions=False)
    with pytest.raises(InputFileError, match=r"cannot read 'absent\.csv'"):
        CliRunner().invoke(replay_command, ["absent.csv", *options], catch_exceptions=False)


@pytest.mark.parametrize(
    ("rows", "follow", "says"),
    [
        (
            "0,200,0,0,0,0,0,0\n",
            'plant_tau = "0.5"',
            "c.toml: [follow] parameter plant_tau: '0.5' has no unit",
        ),
        ("0,9e9,0,0,0,0,0,0\n", "", "log.csv: none of the 1 rows has a reading"),
    ],
)
def test_the_command_names_the_file_that_is_wrong(tmp_path: Path, rows: str, follow: str, says: str) -> None:
    log, columns = tmp_path / "log.csv", tmp_path / "c.toml"
    log.write_text(HEADER + rows)
    columns.write_text(
        '[time]\ncolumn = "t"\nunit = "ms"\n[range]\ncolumn = "d"\nunit = "cm"\n[follow]\n' + follow
    )
    with pytest.raises(UsageError) as error:
        CliRunner().invoke(replay_command, [str(log), "--columns", str(columns)], catch_exceptions=False)
    assert str(error.value).startswith(f"{tmp_path}/{says}")
    assert error.value.exit_code == 1


def measured(name: str, start_s: float | None = None, end_s: float | None = None) -> tuple[CsvLog, Columns]:
    file = {"quad_flight": "flight_first_half.csv", "hydroball": "18_37_04-2017_12_11.csv"}[name]
    path = DATA / name / file
    if not path.exists():
        pytest.skip(f"no measured data at {path} (SURFFOLLOW_DATA)")
    columns = load_columns(EXAMPLES / f"{name}.toml")
    return read_csv(path, columns).between(start_s, end_s), columns


def test_the_quadcopters_ground_agrees_with_its_own_filters_terrain() -> None:
    log, columns = measured("quad_flight", 40.0, 450.0)
    summary = summarise("quad", run_csv(log, columns, "paper"), columns)
    for what in ("target", "height"):
        difference = summary["reference"][what]
        assert difference["n"] == 2695
        assert abs(difference["mean_m"]) < 0.01
        assert difference["std_m"] == pytest.approx(0.25, abs=0.02)
    still = [row["no_change_rms_m"] for row in summary["forecast"]]
    np.testing.assert_allclose(still, [0.03, 0.06, 0.11, 0.20], rtol=0.2)
    assert all(row["n"] > 2000 for row in summary["forecast"])


def test_the_echo_sounders_zeros_are_no_readings() -> None:
    log, columns = measured("hydroball")
    assert np.isnan(log.range_m).mean() == pytest.approx(0.071, abs=0.001)
    replay = run_csv(log, columns, "paper")
    summary = summarise("buoy", replay, columns)
    still = [row["no_change_rms_m"] for row in summary["forecast"]]
    np.testing.assert_allclose(still, [0.19, 0.52, 0.95], rtol=0.02)
    assert summary["height_m"]["max"] < -4.0, "a zero depth would put the bottom at the surface"


def test_follow_has_the_last_word_under_either_name_of_a_parameter(tmp_path: Path) -> None:
    log = slope_log(tmp_path)
    given = {"offset": "2.5 m", "sensor_latency": "20 ms", "range_min": "10 cm", "range_max": "9 m"}
    full = {"offset_m": 2.5, "sensor_latency_ns": 20_000_000, "range_min_m": 0.1, "range_max_m": 9.0}
    short, long = (make_follower(plain(follow=follow), log, None) for follow in (given, full))
    assert short.state()["offset_m"] == 2.5
    assert short._params.tobytes() == long._params.tobytes()
    assert float(short._params["range_max_m"][0]) == 9.0
    with pytest.raises(UsageError, match="as offset and as offset_m"):
        run_csv(log, plain(follow={"offset": 2.5, "offset_m": 2.5}))
    assert follow_notes(plain(follow={"plant": {"tau_s": 0.2}, "memory": False}), "adaptive") == []


@pytest.mark.parametrize("mode", ["paper", "adaptive"])
def test_what_a_note_calls_idle_changes_nothing_and_what_it_does_not_changes_something(
    tmp_path: Path, mode: str
) -> None:
    log = slope_log(tmp_path)
    before = run_csv(log, plain(follow={}), mode)
    changes = {
        "ee_readings": 2,
        "interval_size": "0.1 m",
        "range_size": 3,
        "sensor_readings": 3,
        "permitted_variance": "1 mm",
    }
    seen = []
    for key, value in changes.items():
        columns = plain(follow={key: value})
        after = run_csv(log, columns, mode)
        same = all(
            np.array_equal(getattr(after, name), getattr(before, name), equal_nan=True)
            for name in ("height_m", "slope", "forecast_m", "target_m")
        )
        if follow_notes(columns, mode):
            assert same, key
            seen.append(key)
        elif mode == "paper" or key == "sensor_readings":
            assert not same, key
    assert "sensor_readings" not in seen
    assert ("interval_size" in seen) == (mode == "adaptive")


def test_a_log_becomes_a_map_of_all_its_heights(tmp_path: Path) -> None:
    rows = "".join(f"{500 * k},{300 + 10 * k},{1000 * k},0,0,0,0,0\n" for k in range(60))
    (tmp_path / "log.csv").write_text(HEADER + rows)
    (tmp_path / "c.toml").write_text(
        '[time]\ncolumn="t"\nunit="ms"\n[range]\ncolumn="d"\nunit="cm"\nmax="10 m"\n'
        '[position]\nnorth="n"\nunit="mm"\n'
    )
    words = [
        str(tmp_path / "log.csv"),
        "--columns",
        str(tmp_path / "c.toml"),
        "--map",
        str(tmp_path / "m.txt"),
    ]
    done = CliRunner().invoke(replay_command, words, catch_exceptions=False)
    assert done.exit_code == 0
    made = HeightMap.load(tmp_path / "m.txt")
    heights = made.heights_m[np.isfinite(made.heights_m)]
    assert made.clipped == 0
    assert heights.size == pytest.approx(60, abs=2)
    assert (heights.max(), heights.min()) == (pytest.approx(-3.0, abs=1e-3), pytest.approx(-8.9, abs=1e-3))
