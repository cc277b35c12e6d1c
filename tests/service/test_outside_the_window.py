"""Distances that arrive outside the window are named in the status: mostly the unit is wrong."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import pytest

from running_service import Service, until
from surffollow.hw import metre_info, pack_range
from surffollow.service import memory as m
from surffollow.service.window_watch import NOTED_RUN, watch_window, window_notes


@pytest.mark.parametrize(
    ("range_m", "shown"),
    [(1500.0, "1500"), (13.0, "13"), (0.0, "0"), (-0.5, "-0.5"), (0.1, "0.1"), (1e9, "83886.1")],
)
def test_a_distance_outside_the_window_is_counted_with_its_value(range_m: float, shown: str) -> None:
    info = metre_info("laser", 0.2, 12.0, n_channels=2)
    mem = m.make_cycle_memory()
    params, inputs = mem.params[0], mem.inputs[0]
    params["range_min_m"], params["range_max_m"], params["scale_m"] = 0.2, 12.0, info.scale_m
    inputs["n_conversions"] = NOTED_RUN
    inputs["conversion"][:NOTED_RUN] = pack_range(info, 1, range_m)
    watch_window(mem)
    (note,) = window_notes(mem.ctx)
    assert note.startswith(f"channel 1: the latest {NOTED_RUN} distances are outside the window 0.2 to 12 m")
    assert f"the last one is {shown} m" in note
    inputs["n_conversions"] = 1
    inputs["conversion"][0] = pack_range(info, 1, math.nan)  # no echo is no distance
    watch_window(mem)
    assert window_notes(mem.ctx) == [note]
    inputs["conversion"][0] = pack_range(info, 1, 1.0)
    watch_window(mem)
    assert window_notes(mem.ctx) == []


def test_the_status_names_pushed_ranges_in_another_unit(make_service: Callable[..., Service]) -> None:
    service = make_service(kind="external", driver="range_min_m = 0.05\nrange_max_m = 0.3").start()
    with service.attach() as client:

        def text_after(range_m: float) -> str:
            client.push_range(0, time.monotonic_ns(), range_m)
            return str(client.status()["main"]["text"])

        until(lambda: "the last one is 100 m; is the unit right?" in text_after(100.0), "note")
        assert "outside the window 0.05 to 0.3 m" in service.run("status").stdout
        until(lambda: "outside the window" not in text_after(0.1), "the note's end")
