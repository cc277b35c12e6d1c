"""Preview from the live map: second passes, simulated and live with a replay; when it is looked up."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from shell_loop import MS, START, ShellLoop
from surffollow.forecast.plant.controller_clock import (
    latch_time,
    observe_report,
    open_period,
    period_is_due,
)
from surffollow.forecast.step import follow_step
from surffollow.forecast.terrain.preview_schedule import FOR_PERIOD, FOR_SAMPLE, preview_window
from surffollow.hw.simulation.pose_history import add_pose
from surffollow.hw.simulation.sensor_rig import produce
from surffollow.map.header import init_header
from surffollow.map.kernels.geometry import open_journal, reset_begin, reset_step
from surffollow.map.kernels.grids import update_map
from surffollow.service import memory as m
from surffollow.service.map_preview import fill_preview
from surffollow.shm import map_layout as ml
from surffollow.shm.conversion import pack_conversion
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_follow import MODE_PAPER
from surffollow.sim.robot_config import RobotConfig
from surffollow.sim.world_surface import WorldConfig

TOOLS = Path(__file__).parents[2] / "tools"
BEAM = ((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),)
STANDOFF_M = 0.1


class MapLoop(ShellLoop):
    """One sensor, and a map of what it saw: the daemon's cycle and map thread one after the other."""

    def __init__(self, surface, **params):
        world = WorldConfig(surface=surface, region=(0.0, 0.0, 0.7, 0.2))
        region = (0.0, 0.05, 0.6, 0.15)
        robot = RobotConfig(world=world, path="line", speed_mps=0.1, seconds=10.8, region=region)
        super().__init__(robot, list(BEAM), **params)
        self.header, self.pairs = zeros(ml.MapHeader), zeros(ml.GridPair, 50_000)
        init_header(self.header, capacity_grids=100_000)
        reset_begin(self.header, 0.0, 0.0, 0.7, 0.2)
        while reset_step(self.header, self.pairs, 1 << 20) == 0:
            pass
        memory = m.make_cycle_memory(self.header, self.pairs)
        self.memory = memory._replace(params=self.params, state=self.state, inputs=self.inputs)
        self.heights = self.core._field.heights_m
        self.previews = []

    def _cycle(self, t_ns):
        world = self.core.world[0]
        add_pose(self.history, int(world["t_ns"]), world["pose"], world["velocity"])
        produce(self.rig, self.led, self.history, self.heights, self.frame, t_ns)
        i, n = self.inputs[0], 0
        for stamp, word in self.queue.drain(64).tolist():
            i["conversion"][n] = ((stamp - t_ns) << 32) | (word & 0xFFFFFFFF)
            n += 1
        i["n_conversions"], i["t_ns"] = n, t_ns
        fill_preview(self.memory)
        self.previews.append(int(i["n_preview"]))
        follow_step(self.params, self.state, self.inputs, self.output, self.scratch)
        i["n_poses"] = 0
        o = self.output[0]
        if o["fresh"] & 1:
            update_map(self.header, self.pairs, *o["target_m"][:3])

    def passes(self, x0=0.15, x1=0.45):
        """Scatter of the stand-off error over a stretch, pass by pass [m]."""
        trace = self.core.trace()
        x, error = trace["x_m"], trace["standoff_m"] - STANDOFF_M
        inside = np.flatnonzero((x > x0) & (x < x1))
        pieces = np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1)
        return [float(error[k].std()) for k in pieces if abs(x[k[-1]] - x[k[0]]) > 0.95 * (x1 - x0)]


def run_to_end(loop):
    loop.run(20.0)
    assert loop.core.done
    return loop


def test_the_way_back_over_ground_just_mapped_is_followed_far_better_than_the_way_there():
    loop = run_to_end(MapLoop("fy91"))
    first, second = loop.passes()
    assert second <= 0.4 * first, (first, second)
    assert not any(loop.previews[2500:5500]), "the first pass has nothing to remember"


def test_with_the_parameter_off_nothing_is_looked_up():
    loop = MapLoop("fy91", preview=0)
    loop.run(9.0)
    assert not any(loop.previews)


def test_ground_is_looked_up_only_in_cycles_that_use_it():
    loop = run_to_end(MapLoop("fy91-rolling"))
    first, second = loop.passes()
    assert second <= 0.5 * first, (first, second)
    back = np.array(loop.previews[8000:10000])
    # 100 ticks and 250 samples a second, some of them in one cycle; long pieces for ticks alone
    assert 0.25 < np.mean(back > 0) < 0.5
    assert 0.08 < np.mean(back > 20) < 0.13


def test_memory_that_is_plainly_wrong_is_soon_distrusted():
    loop = MapLoop("fy91-rolling")
    loop.run(5.9)
    loop.header["datum_m"] += 0.02  # as after another part was put there
    run_to_end(loop)
    first, second = loop.passes()
    assert second < 1.5 * first, (first, second)


def test_a_map_that_is_laid_anew_meanwhile_previews_nothing_and_the_cycle_goes_on():
    loop = MapLoop("fy91-rolling")
    loop.run(8.0)
    assert any(loop.previews[-100:])
    open_journal(loop.header, ml.REFOCUSING)
    loop.run(0.5)
    assert not any(loop.previews[-500:])
    assert loop.output["status"][0] & 1


def due(loop):
    return preview_window(loop.params, loop.state, loop.inputs)[0]


def test_a_preview_is_due_for_ticks_and_new_samples_and_never_in_paper_mode():
    loop = MapLoop("flat")
    loop.run(3.0)
    a, i, p = loop.state["adaptive"][0], loop.inputs[0], loop.params[0]
    i["n_poses"], i["n_conversions"] = 0, 0
    a["controller"]["period_ns"] = a["clock"]["now_ns"]
    assert due(loop) == 0
    a["controller"]["period_ns"] = 0
    assert due(loop) == FOR_PERIOD
    a["controller"]["period_ns"] = a["clock"]["now_ns"]
    counts = int((a["hold"]["range_m"] - p["zero_m"][0]) / p["scale_m"][0])
    i["n_conversions"] = 1
    for word, expected in (
        (pack_conversion(counts + 40, 0, 0, -1000), FOR_SAMPLE),
        (pack_conversion(counts + 40, 1, 0, -1000), 0),
        (pack_conversion(counts + 40, 0, 1, -1000), 0),
    ):
        i["conversion"][0] = word
        assert due(loop) == expected
    i["conversion"][0] = pack_conversion(counts + 40, 0, 0, -1000)
    for name, value in (("mode", MODE_PAPER), ("preview", 0)):
        before = p[name].item()
        p[name] = value
        assert due(loop) == 0
        p[name] = before
    a["sample"]["lead_m"] = 0.05
    assert due(loop) == 0, "a leading sensor sees better than memory"


def test_the_map_is_read_where_a_tilted_tool_points():
    loop = MapLoop("flat")
    loop.run(3.0)
    a, i, sense = loop.state["adaptive"][0], loop.inputs[0], loop.state["sense"][0]
    i["n_poses"], a["controller"]["period_ns"] = 0, 0
    newest = 7 * ((int(sense["pose_count"]) - 1) % (len(sense["pose"]) // 7))
    _, x, y, *_ = preview_window(loop.params, loop.state, loop.inputs)
    assert (x, y) == pytest.approx(tuple(sense["pose"][newest : newest + 2]), abs=1e-9)
    a["sample"]["tip_x_m"], a["sample"]["tip_y_m"] = 0.03, -0.01
    _, tip_x, tip_y, *_ = preview_window(loop.params, loop.state, loop.inputs)
    assert (tip_x - x, tip_y - y) == pytest.approx((0.03, -0.01))


def test_ticks_are_put_before_reports_that_come_a_hundred_times_a_second():
    a = zeros(AdaptiveState)[0]
    ticks, late = [], np.random.default_rng(5).uniform(0, 300_000, 3000)
    for k in range(3000):
        t = START + k * MS + int(late[k])
        if k % 10 == 3:
            observe_report(a["controller"], k // 10 + 1, t)
        if period_is_due(a["controller"], 0, t) != 0:
            a["controller"]["period_ns"], a["controller"]["periods"] = t, a["controller"]["periods"] + 1
            open_period(a["controller"], 0, t)
            ticks.append((k, latch_time(a["controller"], 0, t) - START))
    settled = [(k, taken) for k, taken in ticks if k > 1000]
    assert {k % 10 for k, _ in settled} <= {4, 5}
    assert len(settled) == pytest.approx(200, abs=2)
    for k, taken in settled:
        report = k + (3 - k) % 10
        assert abs(taken - (report * MS - 500_000)) < 600_000
    # without reports, and where the caller takes each answer himself, a tick is every 10 ms
    assert period_is_due(a["controller"], 1, int(a["controller"]["period_ns"]) + 9_999_000) == 1
    assert period_is_due(a["controller"], 1, int(a["controller"]["period_ns"]) + 9_998_000) == 0
    assert latch_time(a["controller"], 1, START) == START


def test_live_the_second_pass_is_better_and_its_replay_has_the_same_bits(monkeypatch):
    monkeypatch.syspath_prepend(str(TOOLS))
    bench = __import__("bench_second_pass")
    try:
        for _ in range(4):  # a stall at an edge takes the plan away for half a second, as it should
            got = bench.there_and_back("fy91", length_m=0.45)
            assert got["replay_identical"], got
            first, second = got["passes"]
            if second["rms_m"] <= 0.6 * first["rms_m"]:
                break
    finally:
        sys.modules.pop("bench_second_pass", None)
    assert second["rms_m"] <= 0.6 * first["rms_m"], got
