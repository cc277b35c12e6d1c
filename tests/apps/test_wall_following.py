"""Wall following: clients that share a simulated base, in simulated time and as processes."""

from __future__ import annotations

import json
import math
import signal
import sys
import uuid

import numpy as np
import pytest
from click.testing import CliRunner

from running_service import begin_command, run_command
from surffollow.apps import child_processes, wall_following, wall_processes
from surffollow.apps.base_process import run_base
from surffollow.apps.child_processes import Child
from surffollow.apps.wall_clients import Avoid, make_clients
from surffollow.apps.wall_figures import Run, figures
from surffollow.apps.wall_following import Arbitration, ring_of, run_experiment, sense, tick
from surffollow.apps.wall_heading import heading_table
from surffollow.apps.wall_pictures import figure_of
from surffollow.apps.wall_processes import run_processes
from surffollow.apps.wall_sensing import BaseRequest
from surffollow.cli.base import base_command, wall_follow_command
from surffollow.errors import ConfigError, MapFileError, ServiceError, UsageError
from surffollow.sim.base import BaseConfig, SimulatedBase


def test_a_lap_with_heading_corrections_keeps_its_distance_and_heading():
    f = figures(run_experiment("2", laps=1, seed=77))
    assert f["turns"] >= 4
    assert f["contacts"] == 0
    assert f["distance_rms_m"] < 0.025
    assert f["heading_rms_rad"] < math.radians(1.5)


def test_the_fused_pose_turns_the_base_better_than_a_pair():
    fused, pair = (figures(run_experiment(e, laps=1, seed=5)) for e in ("1", "1-pair"))
    assert fused["heading_rms_rad"] < 0.5 * pair["heading_rms_rad"]
    assert fused["contacts"] == pair["contacts"] == 0


def test_a_run_is_repeatable_and_its_seed_matters():
    first, again, other = (run_experiment("paper", laps=1, seed=s) for s in (3, 3, 4))
    assert np.array_equal(first.x_m, again.x_m)
    assert not np.array_equal(first.x_m[:500], other.x_m[:500])


def test_avoid_halts_before_a_wall_whoever_drives():
    base = SimulatedBase(BaseConfig(start=(4.0, 2.0, 0.0)), seed=1)
    ring = ring_of(base.config)

    class Ram:
        name = "go"

        def step(self, seen, held):
            return BaseRequest(True, 0.3)

    clients, arbitration = [Avoid(ring), Ram()], Arbitration(["avoid", "go"])
    base.run(0.15)
    held = []
    while base.time_s < 30.0:
        tick(base, clients, arbitration)
        base.run(base.time_s + 0.02)
        held.append(arbitration.holder)
        assert base.wall_gap_m > 0.02
    assert 0 in held
    assert 1 in held


def wall_follow(*words):
    return CliRunner().invoke(wall_follow_command, words)


def test_a_command_arrives_after_the_serial_delay():
    base = SimulatedBase(BaseConfig(serial_s=0.5), seed=1)
    base.command(0.2, 0.0)
    base.run(0.49)
    assert base.state[3] == 0.0
    base.run(1.2)
    assert base.state[3] == pytest.approx(0.2)


def test_a_base_that_is_driven_against_a_wall_stays_in_the_room_while_its_wheels_slip():
    base = SimulatedBase(BaseConfig(start=(5.0, 2.0, 0.3)), seed=1)
    base.command(0.5, 0.0)
    base.run(6.0)
    x, y, _ = base.state[:3]
    assert x == pytest.approx(6.0 - 0.35 + 0.001)
    assert y > 2.5, "it slides along the wall"
    assert -0.0011 < base.wall_gap_m < 0.0
    assert base.state[5] > 7.0, "odometry does not feel the wall"


@pytest.mark.parametrize("start", [(0.3, 2.0, 0.0), (3.0, 3.7, 0.0), (math.nan, 2.0, 0.0)])
def test_a_start_in_a_wall_is_refused(start):
    with pytest.raises(ConfigError, match=r"not inside a room of \(6.0, 4.0\) m"):
        SimulatedBase(BaseConfig(start=start))


def test_short_runs_tell_what_they_can_and_how_long_walls_were_touched():
    out = wall_follow("--experiment", "paper", "--laps", "1", "--seeds", "31006")
    assert "contacts of" in out.stdout
    assert "heading repeatability only from two laps on" in out.stdout
    assert "-°" not in out.stdout
    assert "0.95 laps" in out.stdout
    assert out.stdout.endswith("; lap 1 counts as done 20° before its end\n")


def test_a_run_without_a_straight_between_turns_says_so(monkeypatch):
    monkeypatch.setattr(wall_following, "MAX_S", 3.0)
    out = wall_follow("--experiment", "2", "--laps", "1", "--seeds", "1").stdout
    assert "distance and heading to the wall only from two turns on" in out
    assert not {"-", "nan"} & set(out.replace(",", " ").split())


def test_a_run_whose_time_is_over_says_so(monkeypatch):
    monkeypatch.setattr(wall_following, "MAX_S", 3.0)
    assert run_experiment("paper", laps=1).ended == "the time of 3 s was over before lap 1 was done"


@pytest.mark.parametrize(
    ("words", "says"),
    [(("--seeds", "-3"), "from 0 on"), (("--seeds", "1:3", "--processes"), "one seed at a time")],
)
def test_seeds_that_cannot_be_run_are_refused(words, says):
    refused = wall_follow(*words)
    assert refused.exit_code == 2
    assert says in refused.output


def test_sonars_are_fired_in_turn_nine_rounds_a_second():
    base = SimulatedBase(seed=1)
    base.run(1.0)
    order = np.argsort(base.sonar_s)
    assert np.diff(np.sort(base.sonar_s)) == pytest.approx(1 / (9 * 24), abs=1e-9)
    assert set(np.diff(order)) <= {1, -23}


def test_odometry_slips_and_ranges_are_noisier_in_motion():
    still, moving = [], []
    for seed in range(40):
        base = SimulatedBase(BaseConfig(start=(3.0, 2.0, 0.0)), seed)
        base.run(0.2)
        still.append(base.sonar_m[0] - (3.0 - 0.35))
        base.command(0.4, 0.0)
        base.run(2.0)
        x = base.state[0]
        seen = sense(base)
        assert seen.pose[0] != x
        fired_x = x - 0.4 * (base.time_s - base.sonar_s[0])
        moving.append((base.sonar_m[0] - (6.0 - fired_x - 0.35)) / (6.0 - x - 0.35))
    assert np.std(moving) > 1.5 * np.std(still) / 2.65


def test_what_cannot_be_run_is_refused():
    with pytest.raises(UsageError, match="experiment"):
        run_experiment("3")
    with pytest.raises(UsageError, match="laps"):
        run_experiment("1", laps=0)
    with pytest.raises(ConfigError, match="room"):
        BaseConfig(room_m=(1.0, 4.0))
    assert [c.name for c in make_clients("2", ring_of(BaseConfig()))] == [
        "avoid",
        "follow-wall",
        "follow-wall-2",
        "go",
    ]


def test_processes_share_the_base_through_the_arbiter():
    # 0.6 m before follow-wall's trigger: it takes the base within the run
    run, history = run_processes("1", 9.0, seed=2, start=(4.35, 1.05, 0.0))
    held = {run.names[k] for k in set(run.holder.tolist()) if k >= 0}
    assert {"go", "follow-wall"} <= held
    assert run.gap_m.min() > 0.1
    assert run.x_m.max() > 4.4
    assert any(e.event == "GRANT" for e in history)


@pytest.mark.parametrize("victim", ["arbiter", "go"])
def test_a_run_without_one_of_its_processes_is_an_error(monkeypatch, victim):
    """GIVEN a client or the arbiter that is killed THEN the run is none: its figures were those of a run."""
    children = {}

    class Noted(Child):
        def __init__(self, what, words, folder):
            super().__init__(what, words, folder)
            children[what] = self

    await_clients = wall_processes._await_clients

    def kill_when_all_are_attached(name, expected, child):
        numbers = await_clients(name, expected, child)
        if "go" in expected:
            children[victim].child.kill()
        return numbers

    monkeypatch.setattr(child_processes, "Child", Noted)
    monkeypatch.setattr(wall_processes, "_await_clients", kill_when_all_are_attached)
    with pytest.raises(ServiceError, match=f"the {victim} ended during the run with code -9"):
        run_processes("paper", 2.0)


def test_the_command_prints_json_and_draws(tmp_path):
    words = [
        sys.executable,
        "-m",
        "surffollow",
        "wall-follow",
        "--experiment",
        "paper",
        "--laps",
        "1",
        "--json",
    ]
    got = run_command([*words, "--plot", str(tmp_path / "run.svg")])
    got.check_returncode()
    assert json.loads(got.stdout)["median"]["turns"] >= 3
    assert (tmp_path / "run.svg").read_text().lstrip().startswith("<?xml")
    wrong = run_command([*words, "--plot", str(tmp_path / "run.doc")])
    assert wrong.returncode == 2
    assert not (tmp_path / "run.doc").exists()


def test_corrections_mend_the_heading_and_scatter_it_more_in_motion():
    seeds = range(40, 46)
    table = heading_table(seeds)
    # no command turns an uncorrected base; motion noise is in the ranges alone
    assert table["still"]["variance_rad2"] < 1e-12, seeds
    assert table["moving"]["variance_rad2"] < 1e-12, seeds
    still, moving = table["still, corrected"], table["moving, corrected"]
    assert 0.0 < still["variance_rad2"] < moving["variance_rad2"] < math.radians(0.4) ** 2, seeds
    for case in ("still", "moving"):
        after, before = table[f"{case}, corrected"]["error_rms_rad"], table[case]["error_rms_rad"]
        assert after < 0.25 * before, (case, seeds)


def test_a_base_without_an_arbiter_says_what_it_waits_for():
    words = [sys.executable, "-m", "surffollow", "base", "--name", f"lone{uuid.uuid4().hex[:8]}"]
    with begin_command(words) as base:
        assert base.stderr is not None
        try:
            assert "no arbiter" in base.stderr.readline()
            base.send_signal(signal.SIGINT)
            assert "no client commanded the base" in base.communicate(timeout=60)[0]
        finally:
            base.kill()


def test_what_a_base_cannot_do_is_refused_before_it_waits(tmp_path):
    log = str(tmp_path / "nowhere" / "run.csv")
    with pytest.raises(MapFileError, match="nowhere"):
        run_base(f"lone{uuid.uuid4().hex[:8]}", 1.0, log=log)
    done = CliRunner().invoke(base_command, ["--seed", "-1"])
    assert done.exit_code == 2
    assert "--seed" in done.output


def test_a_run_without_a_straight_is_drawn_over_its_whole_time():
    time_s = np.linspace(0.0, 14.0, 50)
    zero = np.zeros(50)
    run = Run(["go"], time_s, zero + 1.0, zero + 1.0, zero, zero + 0.5, np.zeros(50, np.int64))
    axes = figure_of(run, "short").axes
    timed = [ax for ax in axes if "heading [°]" in ax.get_ylabel() or ax.get_title() == "who held the base"]
    assert [ax.get_xlim() for ax in timed][-1] == pytest.approx((0.0, 14.0))
    # an empty panel says why it is empty
    (distance,) = (ax for ax in axes if "distance to the" in ax.get_ylabel())
    assert [text.get_text() for text in distance.texts] == ["counted between two turns"]


def test_the_heading_along_the_first_wall_is_drawn_without_jumps():
    time_s = np.linspace(0.0, 14.0, 50)
    zero = np.zeros(50)
    heading_rad = math.radians(3.0) * np.sin(time_s)
    run = Run(["go"], time_s, zero + 1.0, zero + 1.0, heading_rad, zero + 0.5, np.zeros(50, np.int64))
    panels = [ax for ax in figure_of(run, "first wall").axes if ax.get_ylabel() == "heading [°]"]
    drawn_deg = panels[-1].lines[0].get_ydata()
    assert drawn_deg == pytest.approx(np.degrees(heading_rad))
