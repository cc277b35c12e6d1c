"""The demonstration as a newcomer runs it: real processes, real figures, a picture."""

from __future__ import annotations

import errno
import json
import os
import sys
from pathlib import Path

import pytest

from running_service import READY_S, begin_command, objects_of, run_command
from surffollow.apps.demo_figures import table, verdict
from surffollow.apps.demo_picture import draw_demo
from surffollow.apps.demo_task import DemoConfig
from surffollow.errors import FaultError

KEYS = {
    "standoff_rms_m",
    "standoff_peak_m",
    "cycles",
    "overruns",
    "lateness_p50_ns",
    "lateness_p99_ns",
    "grids_known",
    "replay_identical",
}


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    words = ["demo", "--seconds", "4", "--json", "--picture", str(folder / "demo.png"), "--keep", str(folder)]
    with begin_command([sys.executable, "-m", "surffollow", *words]) as demo:
        out, errors = demo.communicate(timeout=READY_S)
    assert demo.returncode == 0, errors + out
    return folder, json.loads(out), demo.pid


def test_demo_prints_one_json_object_with_the_promised_figures(result):
    _, figures, _ = result
    assert figures.keys() >= KEYS
    assert figures["failures"] == []


def test_demo_follows_within_its_criteria_and_maps_where_it_went(result):
    _, figures, _ = result
    assert figures["standoff_rms_m"] <= 5e-3
    # 4 s at 50 mm/s pass about 80 grids of 2.54 mm
    assert figures["grids_known"] >= 40
    assert figures["cycles"] > 3000


def test_demo_replays_with_the_same_bits(result):
    folder, figures, _ = result
    assert figures["replay_identical"] is True
    assert figures["replay_cycles"] > 3000
    assert (folder / "demo.mcap").stat().st_size > 0


def test_demo_draws_a_picture(result):
    folder, _, _ = result
    data = (folder / "demo.png").read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    assert len(data) > 20_000


def test_the_map_is_as_wide_as_the_panels_and_its_path_in_front(result, tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    drawn, save = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda f, *a, **k: (drawn.append(f), save(f, *a, **k)))
    folder, figures, _ = result
    draw_demo(folder, tmp_path / "other.png", DemoConfig(), figures)
    top, middle = drawn[0].axes[:2]
    assert top.get_window_extent().width > 0.85 * middle.get_window_extent().width
    (path,), (grids,) = top.lines, top.collections
    assert path.get_zorder() > grids.get_zorder()


def test_a_disk_without_room_leaves_the_picture_of_before(result, tmp_path, monkeypatch):
    folder, figures, _ = result
    target = tmp_path / "demo.png"
    target.write_bytes(b"before")

    def full(path, data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(FaultError, match="No space left"):
        draw_demo(folder, target, DemoConfig(seconds=4.0), figures)
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"before"]


def test_demo_leaves_nothing_in_shared_memory(result):
    assert objects_of(f"demo-{result[2]}") == set()


def test_verdict_names_everything_that_went_wrong():
    bad = {
        "standoff_rms_m": 6e-3,
        "standoff_rms_rolling_m": 3e-3,
        "replay_identical": False,
        "grids_known": 0,
        "samples_lost": 5,
        "seconds": 20.0,
        "moving_s": 8.2,
    }
    assert len(verdict(bad, 5e-3, 2e-3)) == 6
    assert len(verdict(bad | {"standoff_rms_rolling_m": None}, 5e-3, 2e-3)) == 6


def test_table_has_a_row_for_every_figure(result):
    _, figures, _ = result
    text = table(figures)
    for word in ("stand-off RMS", "lateness", "grids mapped", "replay", "overruns"):
        assert word in text


def test_closeness_above_the_criterions_speed_is_reported_not_scored_and_a_folder_may_be_used_again(result):
    folder, _, _ = result
    words = [
        "demo",
        "--mode",
        "paper",
        "--speed",
        "200 mm/s",
        "--seconds",
        "3",
        "--json",
        "--keep",
        str(folder),
    ]
    done = run_command([sys.executable, "-m", "surffollow", *words])
    figures = json.loads(done.stdout)
    assert done.returncode == 0, figures["failures"]
    assert figures["standoff_rms_m"] > 0.0
    assert "50 mm/s" in figures["notes"][0]
