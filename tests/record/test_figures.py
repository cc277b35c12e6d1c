"""Figures: written in the format of their suffix, telling the numbers; nothing else passes for one."""

from __future__ import annotations

import errno
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from matplotlib import figure
from matplotlib.backends.backend_agg import FigureCanvasAgg

from surffollow.cli.convert import convert_command, recover_command
from surffollow.cli.plot import plot_command
from surffollow.cli.replay import replay_command
from surffollow.errors import MapFileError, RecordingError, UsageError
from surffollow.map import HeightMap
from surffollow.map.formats.axis_labels import round_origin
from surffollow.record import plot_recording, samples, writer
from surffollow.record.drawn_series import MAX_ROWS, drawn_series
from surffollow.record.figure import (
    limits_beside_outliers,
    new_figure,
    outliers,
    save_figure,
    shade,
    spans,
    with_room,
)
from surffollow.record.latency_histogram import log_histogram
from surffollow.record.plot_recording import forecast_errors, read_figure_data

BEGINNINGS = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}
COLUMNS = """
[time]
column = "t"
unit = "s"
[range]
column = "d"
unit = "m"
max = "20 m"
no_reading = [0.0]
[position]
north = "n"
unit = "m"
[forecast]
horizons = ["0.5 s"]
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, recording_bytes: bytes) -> Path:
    path = tmp_path_factory.mktemp("figures") / "run.mcap"
    path.write_bytes(recording_bytes)
    return path


@pytest.fixture
def log(tmp_path: Path) -> Path:
    rows = ["t,d,n"]
    for k in range(200):
        reading = 0.0 if 80 <= k < 95 else 12.0 if k == 40 else 2.0 + 0.2 * np.sin(k / 15)
        rows.append(f"{k / 10},{reading:.4f},{k / 20}")
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "columns.toml").write_text(COLUMNS)
    return tmp_path / "log.csv"


def words_of(svg: Path) -> str:
    return svg.read_text()


@pytest.mark.parametrize("suffix", BEGINNINGS)
def test_a_recording_becomes_a_figure_of_the_format_asked_for(
    recording: Path, tmp_path: Path, suffix: str
) -> None:
    out = tmp_path / f"run{suffix}"
    done = CliRunner().invoke(plot_command, [str(recording), "--out", str(out)], catch_exceptions=False)
    assert done.exit_code == 0
    assert out.read_bytes().startswith(BEGINNINGS[suffix])
    words = [str(recording), "--out", str(out), "--json"]
    assert json.loads(CliRunner().invoke(plot_command, words).stdout) == {"out": str(out)}
    if suffix == ".svg":
        for text in (
            "Ground and tool",
            "Stand-off error",
            "Health and status",
            "Latencies",
            "Map of",
            "no distance",
        ):
            assert text in words_of(out), text


def test_a_log_becomes_a_figure_with_its_outlier_gap_and_forecast(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "log.svg"
    words = [str(log), "--columns", str(tmp_path / "columns.toml"), "--out", str(out)]
    CliRunner().invoke(plot_command, words, catch_exceptions=False)
    for text in ("1 outlier", "no reading", "Forecast error by horizon", "0.5 s ahead", "from above"):
        assert text in words_of(out), text


def figure_of(folder: Path, rows: list[str]) -> str:
    """Text of the figure of a log with the columns t, d and n."""
    (folder / "log.csv").write_text("\n".join(["t,d,n", *rows]) + "\n")
    (folder / "columns.toml").write_text(COLUMNS)
    out = folder / "log.svg"
    words = [str(folder / "log.csv"), "--columns", str(folder / "columns.toml"), "--out", str(out)]
    CliRunner().invoke(plot_command, words, catch_exceptions=False)
    return words_of(out)


def test_the_errors_drawn_are_of_the_first_horizon_that_has_readings(tmp_path: Path) -> None:
    """A log of a reading per second had an empty panel for the default 0.2 s."""
    forecast = COLUMNS.replace('["0.5 s"]', '["0.2 s", "1 s"]')
    rows = [f"{k},{2.0 + 0.2 * np.sin(k)},{k}" for k in range(60)]
    (tmp_path / "log.csv").write_text("\n".join(["t,d,n", *rows]) + "\n")
    (tmp_path / "columns.toml").write_text(
        forecast.replace('unit = "m"\nmax', 'kind = "depth"\nunit = "m"\nmax')
    )
    out = tmp_path / "log.svg"
    words = [str(tmp_path / "log.csv"), "--columns", str(tmp_path / "columns.toml"), "--out", str(out)]
    CliRunner().invoke(plot_command, words, catch_exceptions=False)
    assert "Depth 1 s ahead" in words_of(out)
    assert "no forecast has a reading" not in words_of(out)


def test_wild_readings_leave_the_ground_its_axis_and_its_colours(tmp_path: Path) -> None:
    rows = [
        f"{k / 10},{18.0 if k in (50, 90) else 2.0 + 0.2 * np.sin(k / 9):.4f},{k / 20}" for k in range(200)
    ]
    drawn = figure_of(tmp_path, rows)
    assert "2 outliers, 2 beyond the axis" in drawn
    assert re.search(r">distance \[mm\]<", drawn), "the others span less than half a metre"
    assert re.search(r">height[^<]*\[mm\]<", drawn), "of the colours"
    usual = 2.0 + 0.2 * np.sin(np.arange(200) / 9)
    odd = np.arange(200) % 100 == 50
    low, high = limits_beside_outliers(np.where(odd, 18.0, usual), odd)
    assert (low, high) == pytest.approx((1.76, 2.9), abs=0.1), "a span more, and room for the legend"
    near = np.where(odd, 2.4, usual)
    assert limits_beside_outliers(near, odd) == with_room(near)


@pytest.mark.parametrize(
    ("low", "high", "origin"),
    [
        (0.0, 0.0, 0.0),
        (-0.4, 0.7, 0.0),
        (99.8, 100.0, 0.0),
        (1499.98, 1500.16, 1500.0),
        (512350.2, 512410.9, 512400.0),
        (-3000.2, -2999.9, -3000.0),
        (5812345.6789, 5812345.6789, 5812345.68),
        (float("nan"), float("nan"), 0.0),
    ],
)
def test_ticks_count_from_a_round_number_where_values_lie_far_from_zero(low, high, origin):
    assert round_origin(low, high) == pytest.approx(origin)


def test_a_log_at_the_coordinates_of_a_survey_has_short_ticks_and_full_origins_in_its_labels(
    tmp_path: Path,
) -> None:
    rows = ["t,d,e,n,u"]
    rows += [
        f"{k / 10},{0.15 + 0.01 * np.sin(k / 9):.5f},{512345.6 + k / 100},{5812345.6},1500.15"
        for k in range(200)
    ]
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    place = 'north = "n"\neast = "e"\nup = "u"\n'
    (tmp_path / "columns.toml").write_text(COLUMNS.replace('north = "n"\n', place).replace("20 m", "1 m"))
    out = tmp_path / "log.svg"
    words = [str(tmp_path / "log.csv"), "--columns", str(tmp_path / "columns.toml"), "--out", str(out)]
    CliRunner().invoke(plot_command, words, catch_exceptions=False)
    labels = re.findall(r"<text[^>]*>([^<]+)</text>", words_of(out))
    for label in ("height − 1500 m [mm]", "east − 512350 m [m]", "north − 5812350 m [m]"):
        assert label in labels, labels
    numbers = [text for text in labels if re.fullmatch(r"[+−-]?[0-9.]+(e[+−-]?[0-9]+)?", text)]
    assert max(map(len, numbers)) <= 6, numbers
    # the ground and the tool 150 mm above it take more than half of their panel
    low, high = with_room(np.array([1499.99, 1500.01, 1500.15]) * 1e3)
    assert 160.0 / (high - low) > 0.5


def test_the_title_over_a_great_error_ends_on_the_page(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # GIVEN a recording with errors of metres, one of them beyond the axis
    data = read_figure_data(recording)
    data.rows["output"]["range_m"][:, 0] += 2.0 * np.sin(np.arange(len(data.rows)) / 30)
    data.rows["output"]["range_m"][100, 0] += 100.0
    drawn = []
    monkeypatch.setattr(plot_recording, "read_figure_data", lambda *a: data)
    monkeypatch.setattr(plot_recording.fg, "save_figure", lambda figure, path: drawn.append(figure))
    # WHEN it is drawn
    plot_recording.plot_recording(recording, tmp_path / "run.png")
    drawn[0].canvas.draw()
    # THEN every title ends before the border of the page
    page = drawn[0].bbox
    for ax in drawn[0].axes:
        for title in (ax.title, ax._left_title):
            assert title.get_window_extent().x1 <= page.x1, title.get_text()
    assert "(1 sample beyond the axis" in "".join(ax._left_title.get_text() for ax in drawn[0].axes)


def test_a_log_of_one_row_becomes_a_figure_without_numbers_that_are_none(tmp_path: Path) -> None:
    text = figure_of(tmp_path, ["0,2,1"])
    assert "nan" not in text.replace("no forecast", "")
    assert text.count("no forecast has a reading to compare with") == 2
    assert "the horizontal position does not change" in text
    assert "1 row, 1 reading (" in text


def test_a_figure_names_the_pauses_of_a_log_and_no_line_bridges_them(tmp_path: Path) -> None:
    times = [k / 10 for k in range(200) if not 50 <= k < 150]
    text = figure_of(tmp_path, [f"{t},{2.0 + 0.01 * t},{t}" for t in times])
    assert "no rows in 1 pause, 10.1 s in all" in text


@pytest.mark.parametrize("n", [200, 200_000])
def test_a_series_is_drawn_whole_or_by_its_envelope_and_ends_at_pauses(n: int) -> None:
    # GIVEN n rows with two pauses, a part without values and one great value
    t = np.arange(n) * 1e-2
    t[n // 2 :] += 0.1 * n * 1e-2
    t[n - 1] += 0.1 * n * 1e-2
    values = np.sin(np.arange(n))
    values[n // 4 : n // 4 + n // 10] = np.nan
    values[n // 8] = 9.0
    # WHEN they are drawn
    drawn = drawn_series(t, values)
    # THEN the figure has a few thousand columns at most, and their range is that of the values
    assert drawn.reduced == (n > MAX_ROWS)
    assert drawn.t_s.size <= MAX_ROWS + 2
    assert np.nanmax(drawn.high) == 9.0
    assert np.nanmin(drawn.low) == np.nanmin(values)
    assert (np.diff(drawn.t_s) >= 0.0).all()
    known = np.isfinite(drawn.middle)
    assert ((drawn.low <= drawn.middle) & (drawn.middle <= drawn.high))[known].all()
    # THEN there is nothing between the sides of a pause, and nothing where there are no values
    for before in (n // 2 - 1, n - 2):
        after = int(np.searchsorted(drawn.t_s, t[before + 1] - 1e-9))
        assert not known[after - 1]
        assert known[after]
        assert known[after - 2]
    inside = (drawn.t_s > t[n // 4] + 3e-3 * t[-1]) & (drawn.t_s < t[n // 4 + n // 10 - 1] - 3e-3 * t[-1])
    assert inside.any()
    assert not known[inside].any()


@pytest.mark.parametrize("kind", ["recording", "log"])
def test_a_file_whose_name_is_no_utf_8_becomes_a_figure(
    request: pytest.FixtureRequest, tmp_path: Path, kind: str
) -> None:
    source: Path = request.getfixturevalue(kind)
    named = Path(os.fsdecode(os.fsencode(tmp_path) + b"/run-\xff" + os.fsencode(source.suffix)))
    named.write_bytes(source.read_bytes())
    columns = ["--columns", str(tmp_path / "columns.toml")] if kind == "log" else []
    done = CliRunner().invoke(plot_command, [str(named), *columns, "--out", str(tmp_path / "a.svg")])
    assert done.exit_code == 0, done.exception
    assert "run-\N{REPLACEMENT CHARACTER}" in words_of(tmp_path / "a.svg")


@pytest.mark.parametrize("kind", ["recording", "log"])
def test_names_with_dollar_signs_are_no_formulas(
    request: pytest.FixtureRequest, tmp_path: Path, kind: str
) -> None:
    source: Path = request.getfixturevalue(kind)
    named = tmp_path / rf"$\frac${source.suffix}"
    column = rb"$\frac$" if kind == "log" else b"n"
    named.write_bytes(source.read_bytes().replace(b"n", column))
    reference = "[reference]\ncolumn = '$\\frac$'\nunit = 'm'\n"
    (tmp_path / "columns.toml").write_text(COLUMNS.replace('"n"', r"'$\frac$'") + reference)
    columns = ["--columns", str(tmp_path / "columns.toml")] if kind == "log" else []
    done = CliRunner().invoke(plot_command, [str(named), *columns, "--out", str(tmp_path / "a.svg")])
    assert done.exit_code == 0, done.exception
    assert rf"$\frac${source.suffix}: " in words_of(tmp_path / "a.svg")


def test_a_map_file_becomes_a_figure(tmp_path: Path) -> None:
    HeightMap.from_heights(np.zeros((4, 5)), origin_m=(0, 0), grid_m=0.01).save(tmp_path / "m.txt")
    CliRunner().invoke(plot_command, [str(tmp_path / "m.txt")], catch_exceptions=False)
    assert (tmp_path / "m.png").read_bytes().startswith(BEGINNINGS[".png"])


def test_replay_writes_tables_and_figures_and_nothing_in_disguise(
    recording: Path, log: Path, tmp_path: Path
) -> None:
    def replay(*words: object) -> Result:
        return CliRunner().invoke(replay_command, [str(w) for w in words])

    assert replay(recording, "--out", tmp_path / "run.csv").exit_code == 0
    assert (tmp_path / "run.csv").read_text().startswith("time_s,")
    columns = ("--columns", tmp_path / "columns.toml")
    for k, more in enumerate((("--out", "a.png"), ("--plot", "b.png"))):
        for file in ((recording,), (log, *columns)):
            target = tmp_path / f"{k}{more[1]}"
            target.unlink(missing_ok=True)
            assert replay(*file, more[0], target).exit_code == 0
            assert target.read_bytes().startswith(BEGINNINGS[".png"])
    refused = replay(recording, "--out", tmp_path / "x.doc")
    assert isinstance(refused.exception, UsageError)
    assert not (tmp_path / "x.doc").exists()


def test_a_replay_whose_table_or_figure_is_not_whole_says_so(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # GIVEN a recording of which the replay reads more than the samples do
    feed = samples.Sampler.feed

    def short(self: samples.Sampler, words: np.ndarray) -> Iterator[samples.Run | samples.Event]:
        yield from feed(self, words)
        raise RecordingError("the word at 3 of a batch begins no entry")

    monkeypatch.setattr(samples.Sampler, "feed", short)
    for option, target in (("--out", tmp_path / "run.csv"), ("--plot", tmp_path / "run.png")):
        words = [str(recording), option, str(target)]
        # WHEN it is replayed with a table or a figure
        text, report = (CliRunner().invoke(replay_command, w) for w in (words, [*words, "--json"]))
        # THEN text, JSON and exit code say that the file written is not whole
        assert f"NOT WHOLE: {target}: the word at 3" in text.output
        assert str(target) in json.loads(report.output)["output_damage"][0]
        assert (text.exit_code, report.exit_code) == (1, 1)


def test_no_command_writes_over_what_it_reads(recording: Path, log: Path, tmp_path: Path) -> None:
    columns = str(tmp_path / "columns.toml")
    other = tmp_path / "other.csv"
    other.symlink_to(log)
    before = recording.read_bytes(), log.read_bytes()
    for command, words in (
        (replay_command, (log, "--columns", columns, "--out", log)),
        (replay_command, (log, "--columns", columns, "--out", other)),
        (replay_command, (log, "--columns", columns, "--map", log)),
        (convert_command, (recording, "--to", "foxglove", "--force", "--out", recording)),
        (recover_command, (recording, "--force", "--out", recording)),
    ):
        refused = CliRunner().invoke(command, [str(w) for w in words])
        assert isinstance(refused.exception, UsageError), (words, refused.exception)
        assert "is read; choose another name" in str(refused.exception)
    assert (recording.read_bytes(), log.read_bytes()) == before


def test_converted_files_are_what_their_names_say_and_in_order(recording: Path, tmp_path: Path) -> None:
    for to, out in (("csv", "run.mcap"), ("csv", "run.png"), ("foxglove", "run.csv"), ("parquet", "run.csv")):
        refused = CliRunner().invoke(
            convert_command, [str(recording), "--to", to, "--out", str(tmp_path / out)]
        )
        assert isinstance(refused.exception, UsageError), (to, out)
        assert not (tmp_path / out).exists()
    twice = [str(recording), str(recording), "--to", "csv", "--out", str(tmp_path / "twice.csv")]
    refused = CliRunner().invoke(convert_command, twice)
    assert "in their order, each once" in str(refused.exception)


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_a_figure_that_finds_no_room_is_reported(
    suffix: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(MapFileError, match="No space left"):
        save_figure(new_figure((1.0, 1.0)), tmp_path / f"x{suffix}")
    assert not list(tmp_path.iterdir())


def test_a_conversion_that_finds_no_room_names_the_file_asked_for(
    recording: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(writer._Sink, "write", full)
    out = tmp_path / "x.mcap"
    done = CliRunner().invoke(convert_command, [str(recording), "--to", "foxglove", "--out", str(out)])
    assert str(done.exception).startswith(f"cannot write {out}: the disk is full; free some space")
    assert not list(tmp_path.iterdir())


def test_outliers_are_found_and_steps_are_not() -> None:
    rng = np.random.default_rng(3)
    values = np.where(np.arange(300) < 150, 0.0, 0.02) + rng.normal(0, 1e-4, 300)
    values[[50, 200]] += [0.01, -0.01]
    values[100:104] = np.nan
    assert np.flatnonzero(outliers(values)).tolist() == [50, 200]


@pytest.mark.parametrize("wild", [0, 1, 98, 99])
def test_a_wild_reading_at_an_end_is_an_outlier(wild: int) -> None:
    """The first and the last counted five times in their own median of nine."""
    values = 2.0 + 0.1 * np.sin(np.arange(100) / 9)
    assert not outliers(values).any()
    values[wild] = 130.0
    assert np.flatnonzero(outliers(values)).tolist() == [wild]


@pytest.mark.parametrize("times", [1, 2, 3, 4])
def test_rows_that_are_repeated_make_no_outliers_of_others(times: int) -> None:
    values = 1.0 + 0.1 * np.sin(0.05 * np.arange(600))
    assert not outliers(np.repeat(values, times)).any()
    values[[77, 300]] += 0.5
    assert np.unique(np.flatnonzero(outliers(np.repeat(values, times))) // times).tolist() == [77, 300]


def test_a_span_narrower_than_a_pixel_is_seen() -> None:
    # GIVEN a gap of a second in three hours, WHEN it is shaded
    drawing = figure.Figure(figsize=(4.0, 1.0), dpi=100)
    canvas = FigureCanvasAgg(drawing)
    ax = drawing.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.axis("off")
    ax.set_xlim(0.0, 10_000.0)
    shade(ax, [(5000.0, 5001.0)], "#ff0000", "gap")
    canvas.draw()
    # THEN a line of that colour is in the picture
    red = np.asarray(canvas.buffer_rgba())[50, :, 1] < 200
    assert 1 <= red.sum() <= 3
    assert abs(int(np.argmax(red)) - 200) <= 2


def test_spans_end_with_the_sample_after_them() -> None:
    t = np.arange(6.0)
    assert spans(t, np.array([1, 1, 0, 0, 1, 1], bool)) == [(0.0, 2.0), (4.0, 5.0)]


def test_shares_of_a_histogram_add_up() -> None:
    share, edges = log_histogram(np.array([10.0, 11.0, 1000.0]), np.array([1.0, 1.0, 2.0]))
    assert share.sum() == pytest.approx(100.0)
    assert share[-1] == 50.0
    assert edges[0] <= 10.0 < 1000.0 < edges[-1]


def test_the_forecast_is_compared_with_the_height_that_was_known_later(recording: Path) -> None:
    data = read_figure_data(recording)
    predicted, still = forecast_errors(data, 0.1)
    height = data.rows["output"]["height_m"]
    k = int(np.flatnonzero(np.isfinite(still))[40])
    found = np.isfinite(data.ground_m) & (data.t_s <= data.t_s[k] - 0.1 + 1e-6)
    before = np.flatnonzero(found)[-1]
    o = data.rows["output"][before]
    assert still[k] == height[before] - height[k]
    assert predicted[k] == o["height_m"] + o["slope"] * o["speed_mps"] * 0.1 - height[k]
    # WHEN the target points lie elsewhere than under the tool, as with a tilted one
    data.rows["output"]["target_m"][:, 2] += 0.05
    # THEN the errors are the same
    np.testing.assert_array_equal(forecast_errors(data, 0.1), (predicted, still))


@pytest.mark.parametrize(("spread_m", "unit"), [(1.0, "m"), (0.02, "mm")])
def test_all_errors_of_a_figure_have_one_unit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spread_m: float, unit: str
) -> None:
    """The RMS at the horizons lies within half a metre of each other, while the errors do not."""
    log, columns = tmp_path / "log.csv", tmp_path / "columns.toml"
    noise = np.random.default_rng(1).uniform(-spread_m, spread_m, 200)
    log.write_text("t,d,n\n" + "".join(f"{k / 10},{8 + d:.4f},{k / 20}\n" for k, d in enumerate(noise)))
    columns.write_text(COLUMNS)
    kept = []
    monkeypatch.setattr("surffollow.record.figure.save_figure", lambda drawn, out: kept.append(drawn))
    run = CliRunner().invoke(plot_command, [str(log), "--columns", str(columns), "--out", "x.png"])
    assert run.exit_code == 0, run.output
    labels = [ax.get_ylabel() for ax in kept[0].axes]
    assert f"error [{unit}]" in labels
    assert f"RMS [{unit}]" in labels
