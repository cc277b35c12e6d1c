"""Figures: written in the format of their suffix, telling the numbers; nothing else passes for one."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from surffollow.cli.convert import convert_command, recover_command
from surffollow.cli.plot import plot_command
from surffollow.cli.replay import replay_command
from surffollow.errors import MapFileError, UsageError
from surffollow.map import HeightMap
from surffollow.record.figure import new_figure, outliers, save_figure, spans
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


def test_outliers_are_found_and_steps_are_not() -> None:
    rng = np.random.default_rng(3)
    values = np.where(np.arange(300) < 150, 0.0, 0.02) + rng.normal(0, 1e-4, 300)
    values[[50, 200]] += [0.01, -0.01]
    values[100:104] = np.nan
    assert np.flatnonzero(outliers(values)).tolist() == [50, 200]


def test_spans_end_with_the_sample_after_them() -> None:
    t = np.arange(6.0)
    assert spans(t, np.array([1, 1, 0, 0, 1, 1], bool)) == [(0.0, 2.0), (4.0, 5.0)]


def test_shares_of_a_histogram_add_up() -> None:
    share, edges = log_histogram(np.array([10.0, 11.0, 1000.0]), np.array([1.0, 1.0, 2.0]))
    assert share.sum() == pytest.approx(100.0)
    assert share[-1] == 50.0
    assert edges[0] <= 10.0 < 1000.0 < edges[-1]


def test_the_forecast_is_compared_with_what_was_found_later(recording: Path) -> None:
    data = read_figure_data(recording)
    predicted, still = forecast_errors(data, 0.1)
    ground = data.ground_m
    k = int(np.flatnonzero(np.isfinite(still))[40])
    before = np.flatnonzero(np.isfinite(ground) & (data.t_s <= data.t_s[k] - 0.1 + 1e-6))[-1]
    o = data.rows["output"][before]
    assert still[k] == ground[before] - ground[k]
    assert predicted[k] == o["height_m"] + o["slope"] * o["speed_mps"] * 0.1 - ground[k]
