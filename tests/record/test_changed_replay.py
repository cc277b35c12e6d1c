"""`replay --set`: the follower gets other parameters for the whole run, the inputs stay the recorded ones."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from surffollow.cli.changed_replay import value_text
from surffollow.cli.replay import replay_command
from surffollow.errors import ConfigError, UsageError
from surffollow.forecast.step import follow_step, reset_stop, sf_reset
from surffollow.forecast.stop import latch_stop
from surffollow.record import changed_replay
from surffollow.record.changed_params import read_changes
from surffollow.record.changed_replay import replay_changed
from surffollow.record.reader import RecordingReader
from surffollow.record.recorder import Recorder
from surffollow.record.recording_writer import RecordingWriter
from surffollow.record.synthetic_log import SyntheticLog
from surffollow.shm import journal
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import HEALTH_NAMES
from surffollow.shm.layout_follow import VALID, FollowState, Inputs, Output, Params

CHANGES = {"offset_m": 0.11, "plant_tau_s": 0.08, "permitted_variance_m": 2e-3}


def all_words(path: Path) -> np.ndarray:
    with RecordingReader(path) as reader:
        return np.concatenate([np.frombuffer(bytes(b.words), np.int64) for b in reader.batches()])


def stepped(path: Path, values: dict[str, float]) -> np.ndarray:
    """Every cycle's `Output` with these parameters: entry by entry, as a service that had them would step."""
    words = all_words(path)
    floats = words.view(np.float64)
    params, state, inputs, output = (zeros(s) for s in (Params, FollowState, Inputs, Output))
    scratch, out, at, started = np.zeros(7), [], 0, False
    while at < words.size:
        kind, n = int(journal.entry_kind(words[at])), int(journal.entry_words(words[at]))
        if kind == journal.CYCLE:
            journal.decode_cycle(words, floats, at, inputs)
            follow_step(params, state, inputs, output, scratch)
            out.append(output.copy())
        elif kind == journal.RESET:
            sf_reset(params, state, values.get("offset_m", float(floats[at + 2])))
        elif kind == journal.STOP and words[at + 2]:
            latch_stop(state, words[at + 2])
        elif kind == journal.STOP:
            reset_stop(params, state)
        elif kind == journal.PARAMS or (kind == journal.SNAPSHOT and not started):
            end = at + 2 + journal.PARAMS_WORDS
            params.view(np.int64)[:] = words[at + 2 : end]
            if kind == journal.SNAPSHOT:
                state.view(np.int64)[:] = words[end : at + n]
            for name, value in values.items():
                params[name] = value
            if kind == journal.SNAPSHOT and {"offset_m", "plant_tau_s"} & set(values):
                sf_reset(params, state, float(params["offset_m"][0]))
            started = True
        at += n
    return np.concatenate(out)


def rows_of(spans: list[changed_replay.HealthSpan], t_s: np.ndarray) -> np.ndarray:
    """Which cycles lie in a span."""
    found = np.zeros(t_s.size, bool)
    for s in spans:
        found |= (t_s >= s.begin_s - 1e-9) & (t_s <= s.end_s + 1e-9)
    return found


def test_the_values_hold_for_the_whole_run_and_all_figures_are_those_of_its_cycles(
    make_recording: Callable[..., Path],
) -> None:
    # GIVEN a recording with changes of parameters, SFResets, stops and losses
    path = make_recording(mode=1, cycles=6000)
    recorded, changed = stepped(path, {}), stepped(path, CHANGES)
    # WHEN it is replayed with other parameters
    report, outcomes = replay_changed(path, CHANGES)
    # THEN every demand is that of a follower which had them from the beginning
    t_s = (recorded["t_ns"] - recorded["t_ns"][0]) * 1e-9
    valid = [(o["status"] & VALID) != 0 for o in (recorded, changed)]
    both = valid[0] & valid[1]
    off_m = (changed["demand"][:, 2] - recorded["demand"][:, 2])[both]
    differs = np.any(recorded["demand"] != changed["demand"], axis=1)
    states_differ = (recorded["health"] != changed["health"]) | (recorded["reason"] != changed["reason"])
    assert report.cycles == len(recorded) == 6000
    assert report.differing == differs.sum() > 5000
    assert report.z_compared == both.sum() > 5000
    assert report.z_rms_m == pytest.approx(np.sqrt(np.mean(off_m**2)), rel=1e-12)
    assert report.z_max_m == np.abs(off_m).max()
    assert report.z_max_at_s == t_s[both][np.abs(off_m).argmax()]
    shares = (report.valid_share_recorded, report.valid_share, report.valid_share_both)
    assert shares == tuple(v.mean() for v in (*valid, both))
    assert report.health_differing == states_differ.sum() > 100
    assert np.array_equal(rows_of(report.health_spans, t_s), states_differ)
    for s in report.health_spans:
        at = int(np.searchsorted(t_s, s.begin_s - 1e-9))
        assert (s.recorded_health, s.health) == tuple(
            HEALTH_NAMES[o["health"][at]] for o in (recorded, changed)
        )
    assert [p.recorded for p in report.parameters] == [
        [(0.0, 0.1), (t_s[4000], 0.101)],
        [(0.0, 0.04)],
        [(0.0, 1e-4), (t_s[1500], 1e-5), (t_s[3400], 2e-5), (t_s[5300], 1e-5 * 3)],
    ]
    assert report.open_loop
    assert not report.otherwise
    kept = np.searchsorted(recorded["t_ns"], outcomes.recorded["t_ns"])
    assert len(kept) == 600
    assert np.array_equal(outcomes.changed["demand"], changed["demand"][kept])


def test_a_run_recorded_from_its_middle_on_begins_with_the_reset_that_a_new_time_constant_needs(
    tmp_path: Path,
) -> None:
    # GIVEN a recording that begins with a follower that has run for a while
    log, path = SyntheticLog(1 << 16, mode=1), tmp_path / "middle.mcap"
    log.run(1100)
    recorder = Recorder(log, RecordingWriter(path, {"name": "synthetic_log"}))
    for _ in range(8):  # the small log holds no older snapshot than that of cycle 1000
        log.run(250)
        recorder.poll()
    recorder.finish()
    # WHEN it is replayed with another τ of the same reference scale
    report, _ = replay_changed(path, {"plant_tau_s": 0.06})
    # THEN the demands are those behind an SFReset: until then the new τ is not in force
    changed, recorded = stepped(path, {"plant_tau_s": 0.06}), stepped(path, {})
    differs = np.any(recorded["demand"] != changed["demand"], axis=1)
    assert report.segments == 1
    assert recorded["cycle"][0] >= 1000
    assert report.differing == differs.sum() > 0
    assert report.z_max_m == np.abs(recorded["demand"] - changed["demand"])[:, 2].max()


def test_recorded_values_give_the_recorded_demands_and_no_reset(make_recording: Callable[..., Path]) -> None:
    path = make_recording(mode=1, cycles=1200)  # one stand-off, one τ
    report, _ = replay_changed(path, {"offset_m": 0.1, "plant_tau_s": 0.04})
    assert (report.differing, report.health_spans, report.z_rms_m, report.z_max_m) == (0, [], 0.0, 0.0)


def test_cycles_behind_a_loss_have_the_values_too(make_recording, recovered_without):
    path = make_recording(mode=1, cycles=12000, snapshot_cycles=500)
    report, _ = replay_changed(recovered_without(path, 1), {"max_demand_m": 0.0})
    assert report.segments > 1
    assert report.damage
    assert not report.otherwise
    whole, _ = replay_changed(path, {"max_demand_m": 0.0})
    # a demand of 0 differs from every other one: before the loss and behind it
    assert report.differing_share > 0.9 * whole.differing_share > 0.8


def test_more_spans_than_are_kept_are_counted(make_recording, monkeypatch):
    path = make_recording(mode=1, cycles=6000)
    every, _ = replay_changed(path, CHANGES)
    monkeypatch.setattr(changed_replay, "MAX_SPANS", 1)
    some, _ = replay_changed(path, CHANGES)
    assert some.health_spans == every.health_spans[:1]
    assert some.health_spans_left_out == len(every.health_spans) - 1 > 0
    assert some.health_differing == every.health_differing


def run(*words: str, code: int = 0) -> str:
    done = CliRunner().invoke(replay_command, list(words))
    if code == 2:
        assert isinstance(done.exception, UsageError), done.output
        return str(done.exception)
    assert done.exit_code == code, done.output
    return done.stdout


def test_the_command_says_what_changed_and_that_the_loop_is_open(make_recording, tmp_path):
    path, figure = make_recording(mode=1, cycles=6000), tmp_path / "run.svg"
    words = ["--set", "offset=110 mm", "--set", "plant_tau_s=0.08", "--set", "permitted_variance=2 mm"]
    text = run(str(path), *words, "--plot", str(figure))
    for part in (
        "changed   offset_m 100 mm, from 4.000 s on 101 mm → 110 mm\n",
        "changed   plant_tau_s 40 ms → 80 ms\n",
        "demand    differs in 9",
        "demand.z  difference RMS 10.",
        " mm, greatest 1",
        "VALID     94.93% of the time as recorded",
        "health    or its reason differs ",
        "OK → DROPOUT (no reading for several sample intervals)\n",
        "open loop: the poses are those of a tool that followed the recorded demands",
        "benchmark",
    ):
        assert part in text, (part, text)
    assert "identical" not in text
    for part in (
        "as recorded",
        "with the change",
        "open loop",
        "health, recorded",
        "VALID, changed",
        "DROPOUT",
    ):
        assert part in figure.read_text(), part
    found = json.loads(run(str(path), *words, "--json"))
    report, _ = replay_changed(path, CHANGES)
    assert found["differing"] == report.differing
    assert found["z_rms_m"] == report.z_rms_m
    assert [p["name"] for p in found["parameters"]] == list(CHANGES)


def test_health_is_not_compared_with_the_mode_that_has_none(make_recording):
    path = make_recording(mode=1, cycles=1200)
    assert "not compared: the paper's mode has none" in run(str(path), "--set", "mode=paper")


def test_a_file_that_is_not_whole_ends_with_1(make_recording):
    path = make_recording(mode=1, cycles=6000)
    data = path.read_bytes()
    path.write_bytes(data[: int(0.8 * len(data))])
    assert "DAMAGED: " in run(str(path), "--set", "max_demand=1 mm", code=1)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--set", "tau=50 ms"], "did you mean plant_tau_s"),
        (["--set", "plant_tau=5 mm"], "a time in 's'"),
        (["--set", "plant_tau"], "write NAME=VALUE"),
        (["--set", "=5"], "write NAME=VALUE"),
        (["--set", "hold=5"], "hold = 5 has no unit"),
        (["--set", "range_size=2.5"], "whole number"),
        (["--set", "range_size=1000"], "between 1 and 512"),
        (["--set", "mode=other"], "one of paper, adaptive"),
        (["--set", "offset=0.1", "--set", "offset_m=0.1"], "given twice"),
        (["--set", "n_channels=2"], "change the configuration and record again"),
        (["--set", "tool_from_sensor=1"], "change the configuration and record again"),
        (["--set", "stop_on=1"], "change the configuration and record again"),
        (["--set", "offset=30 mm"], "outside the sensor's window"),
        (["--set", "too_close=105 mm", "--set", "too_close_exit=110 mm"], "not below offset_m 0.1 m"),
        (["--set", "offset=0.1", "--live"], "does not go with --live"),
        (["--set", "offset=0.1", "--map", "x.npz"], "does not go with --map"),
        (["--set", "offset=0.1", "--out", "x.csv"], "shows the recorded parameters"),
        (["--set", "offset=0.1", "--columns", "c.toml"], "under [follow]"),
    ],
)
def test_what_cannot_be_is_refused_with_the_remedy(make_recording, tmp_path, monkeypatch, words, text):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "c.toml").write_text("")
    assert text in run(str(make_recording(mode=1, cycles=300)), *words, code=2)


def test_values_that_do_not_fit_a_later_stand_off_are_refused_there(make_recording):
    path = make_recording(mode=1, cycles=3999)
    assert replay_changed(path, {"range_max_m": 0.1005})[0].cycles == 3999
    path = make_recording(mode=1, cycles=4001)  # with an SFReset to 101 mm
    with pytest.raises(ConfigError, match=r"--set does not fit .* offset_m 0.101 m is outside"):
        replay_changed(path, {"range_max_m": 0.1005})


def test_values_are_written_as_in_a_configuration():
    assert read_changes(["orient=false", "mode = paper", "hold_ns=5000000", "plant_tau=5e-2"]) == {
        "orient": 0.0,
        "mode": 0.0,
        "hold_ns": 5e6,
        "plant_tau_s": 0.05,
    }


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("mode", 1.0, "adaptive"),
        ("offset_m", 5.0, "5 m"),
        ("offset_m", 0.004, "4 mm"),
        ("plant_tau_s", 0.5, "500 ms"),
        ("loss_timeout_ns", 2.5e9, "2.5 s"),
        ("range_size", 5.0, "5"),
        ("plant_v_max_mps", 0.2, "0.2 m/s"),
    ],
)
def test_values_are_shown_in_units(name, value, text):
    assert value_text(name, value) == text
