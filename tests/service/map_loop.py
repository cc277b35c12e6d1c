"""One sensor, and a map of what it saw: the daemon's cycle and map thread one after the other."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from shell_loop import ShellLoop
from surffollow.forecast.step import follow_step
from surffollow.forecast.terrain.preview_schedule import preview_uses, preview_window
from surffollow.map.header import init_header
from surffollow.map.kernels.geometry import open_journal, reset_begin, reset_step
from surffollow.map.kernels.grids import update_map
from surffollow.service import memory as m
from surffollow.service.map_preview import fill_preview
from surffollow.shm import map_layout as ml
from surffollow.shm.conversion import pack_conversion
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_follow import VALID
from surffollow.sim.robot_config import RobotConfig
from surffollow.sim.world_surface import WorldConfig

BEAM = ((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),)
STANDOFF_M = 0.1


class MapLoop(ShellLoop):
    """A robot that goes over a surface and back, and its follower with preview.

    Parameters
    ----------
    surface : of the simulated world
    period_ms : of the robot's controller
    params : of the follower

    Attributes
    ----------
    previews : heights looked up, by cycle
    """

    def __init__(self, surface: str, period_ms: int = 10, **params: float) -> None:
        world = WorldConfig(surface=surface, region=(0.0, 0.0, 0.7, 0.2))
        region = (0.0, 0.05, 0.6, 0.15)
        robot = RobotConfig(world=world, path="line", speed_mps=0.1, seconds=10.8, region=region)
        super().__init__(robot, list(BEAM), period_ms=period_ms, **params)
        self.header, self.pairs = zeros(ml.MapHeader), zeros(ml.GridPair, 50_000)
        init_header(self.header, capacity_grids=100_000)
        reset_begin(self.header, 0.0, 0.0, 0.7, 0.2)
        while reset_step(self.header, self.pairs, 1 << 20) == 0:
            pass
        memory = m.make_cycle_memory(self.header, self.pairs)
        self.memory = memory._replace(params=self.params, state=self.state, inputs=self.inputs)
        self.previews: list[int] = []

    def _cycle(self, t_ns: int) -> None:
        self._sense(t_ns)
        fill_preview(self.memory)
        self.previews.append(int(self.inputs[0]["n_preview"]))
        follow_step(self.params, self.state, self.inputs, self.output, self.scratch)
        self.inputs["n_poses"] = 0
        o = self.output[0]
        if o["fresh"] & 1:
            update_map(self.header, self.pairs, *o["target_m"][:3])

    def run_to_end(self) -> None:
        self.run(20.0)
        assert self.core.done

    def passes(self, x0: float = 0.15, x1: float = 0.45) -> list[float]:
        """Scatter of the stand-off error over a stretch, pass by pass [m]."""
        trace = self.core.trace()
        x, error = trace["x_m"], trace["standoff_m"] - STANDOFF_M
        inside = np.flatnonzero((x > x0) & (x < x1))
        pieces = np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1)
        return [float(error[k].std()) for k in pieces if abs(x[k[-1]] - x[k[0]]) > 0.95 * (x1 - x0)]

    @property
    def is_valid(self) -> bool:
        return bool(self.output["status"][0] & VALID)

    def raise_map(self, by_m: float) -> None:
        """The map is wrong everywhere, as after another part was put there."""
        self.header["datum_m"] += by_m

    def begin_refocus(self) -> None:
        """The map is being laid anew from now on."""
        open_journal(self.header, ml.REFOCUSING)

    # -- the coming cycle, and what of the map it will use ------------------------------------------

    @property
    def _adaptive(self) -> Any:
        return self.state["adaptive"][0]

    def expect_nothing(self) -> None:
        """The coming cycle has no input, and its controller period is answered already."""
        self.inputs["n_poses"] = self.inputs["n_conversions"] = 0
        self._adaptive["controller"]["period_ns"] = self._adaptive["clock"]["now_ns"]

    def expect_period(self) -> None:
        """The coming cycle has no input, and a controller period to answer."""
        self.expect_nothing()
        self._adaptive["controller"]["period_ns"] = 0

    def expect_reading(self, change_counts: int, channel: int = 0, flags: int = 0) -> None:
        """The coming cycle has one conversion, so far from the last one, and no period to answer."""
        self.expect_nothing()
        last_m, p = self._adaptive["hold"]["range_m"], self.params[0]
        counts = int((last_m - p["zero_m"][0]) / p["scale_m"][0]) + change_counts
        self.inputs["n_conversions"] = 1
        self.inputs[0]["conversion"][0] = pack_conversion(counts, channel, flags, -1000)

    @contextlib.contextmanager
    def tried(self) -> Iterator[None]:
        """Restore parameters, state and inputs at the end of the context."""
        records = self.params, self.state, self.inputs
        before = [r.copy() for r in records]
        try:
            yield
        finally:
            for record, old in zip(records, before, strict=True):
                record[:] = old

    def set_param(self, name: str, value: float) -> float:
        """Change a parameter of the follower; its value before."""
        before: float = self.params[0][name].item()
        self.params[name] = value
        return before

    def lead(self, by_m: float) -> None:
        """The footprint lies so far ahead of the tool."""
        self._adaptive["sample"]["lead_m"] = by_m

    def look_ahead(self, by_m: float) -> None:
        """A second sensor leads by this distance now; 0: it did before."""
        self._adaptive["lookahead"]["ahead_m"] = by_m
        self._adaptive["lookahead"]["seen_ns"] = self._adaptive["clock"]["now_ns"]

    def tilt(self, x_m: float, y_m: float) -> None:
        """The tool's axis meets the ground beside the tool."""
        self._adaptive["sample"]["tip_x_m"], self._adaptive["sample"]["tip_y_m"] = x_m, y_m

    def newest_place(self) -> tuple[float, float]:
        """Place of the newest pose [m]."""
        sense = self.state["sense"][0]
        newest = 7 * ((int(sense["pose_count"]) - 1) % (len(sense["pose"]) // 7))
        x, y = sense["pose"][newest : newest + 2]
        return float(x), float(y)

    def preview_uses(self) -> tuple[bool, bool]:
        """Whether the next cycle uses a preview for a sample, and for a controller period."""
        t_ns = max(int(self.inputs["t_ns"][0]), int(self._adaptive["clock"]["now_ns"]))
        for_sample, for_period = preview_uses(self.params[0], self._adaptive, self.inputs[0], t_ns)
        return bool(for_sample), bool(for_period)

    def preview_begin(self) -> tuple[float, float]:
        """Where the coming cycle's preview begins [m]."""
        _, x, y, *_ = preview_window(self.params, self.state, self.inputs)
        return float(x), float(y)
