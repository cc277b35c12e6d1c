"""Conversions of several channels, as a service has them: one wrong conversion is one wrong sample."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow.shm.conversion import FLAG_INVALID
from surffollow.shm.layout_adaptive import HEALTH_NAMES, reason_text

from .driving import MS, Kernel, default_params

SCALE_M, ZERO_M = 0.1016 / 4095, 0.0508


def counts_of(range_m: float) -> int:
    return round((range_m - ZERO_M) / SCALE_M)


def mounted(kernel: Kernel, places: list[tuple[float, float]]) -> None:
    for mount, place in zip(kernel.params[0]["tool_from_sensor"].reshape(8, 7), places, strict=False):
        mount[:2] = place


@pytest.mark.parametrize("glitch_m", [0.012, 0.02])
def test_one_wrong_conversion_of_a_ring_turns_nothing(glitch_m):
    """It was a seventh of its size in seven means, which agreed with each other: 1.1 degrees."""
    kernel, rng = Kernel(default_params(mode=1, orient=1, n_channels=3)), np.random.default_rng(0)
    mounted(kernel, [(0.03 * math.cos(2.1 * c), 0.03 * math.sin(2.1 * c)) for c in range(3)])
    slopes, demands = [], []
    for n in range(140):
        t_ns, ranges = 10_000 * MS + 4 * MS * n, 0.1 + 5e-5 * rng.standard_normal(3)
        ranges[1] += glitch_m if n == 100 else 0.0
        poses = [(t_ns, (0.4e-3 * n, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))] if n % 2 == 0 else []
        o = kernel.step(t_ns, poses, [(0, c, 0, counts_of(r)) for c, r in enumerate(ranges)])
        plane = kernel.state[0]["adaptive"]["plane"]
        if n >= 100:
            slopes.append(math.degrees(math.hypot(plane["slope_x"], plane["slope_y"])))
            demands.append(abs(float(o["demand"][2])))
    assert max(slopes) < 0.2
    assert max(demands) < 0.1e-3


def lowest_buffered_m(glitch: int, rest: int) -> tuple[float, int]:
    """Lowest height in the terrain buffer [m] of a tool with a sensor ahead, and the cycle of the first.

    `glitch`: the cycle in which the sensor ahead reads 20 mm more; `rest`: cycles at rest before.
    """
    kernel, rng = Kernel(default_params(mode=1, orient=0, n_channels=2)), np.random.default_rng(0)
    mounted(kernel, [(0.0, 0.0), (0.05, 0.0)])
    x, first = 0.0, -1
    for n in range(rest + 60):
        t_ns, ranges = 10_000 * MS + 4 * MS * n, 0.1 + 5e-5 * rng.standard_normal(2)
        x += 0.4e-3 if n >= rest else 0.0
        ranges[1] += 0.02 if n == glitch else 0.0
        poses = [(t_ns, (x, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))] if n % 2 == 0 else []
        kernel.step(t_ns, poses, [(0, c, 0, counts_of(r)) for c, r in enumerate(ranges)])
        a = kernel.state[0]["adaptive"]
        if first < 0 and a["kinematics"]["speed_mps"] > 0.0:
            first = n
    buffer = kernel.state[0]["adaptive"]["buffer"]
    return float(buffer["height_m"][buffer["cell"] != 0].min()), first


def test_the_first_reading_ahead_behind_a_rest_does_not_count_alone():
    """A sample that agrees with none before entered the buffer: known ground 20 mm too low."""
    _, first = lowest_buffered_m(-1, 100)
    lowest, _ = lowest_buffered_m(first, 100)
    assert lowest > -1e-3


@pytest.mark.parametrize(
    ("flags", "counts", "health", "reason"),
    [
        (0, 4095, "OUT_OF_RANGE", "readings outside the window"),
        (FLAG_INVALID, counts_of(0.1), "DROPOUT", "no reading for several sample intervals"),
    ],
)
@pytest.mark.parametrize(("per_cycle", "tau_s"), [(1, 0.04), (2, 0.04), (4, 0.04), (2, 0.1)])
def test_the_reason_says_whether_readings_are_outside_or_none(
    per_cycle, tau_s, flags, counts, health, reason
):
    """Two conversions of a cycle outside the window were no reading, one that is none was outside."""
    kernel = Kernel(default_params(mode=1, orient=0, plant_tau_s=tau_s))
    for n in range(260):
        t_ns, good = 10_000 * MS + 4 * MS * n, n < 200
        poses = [(t_ns - 1000, (0.2e-3 * n, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))] if n % 2 == 0 else []
        word = (0, 0, 0, counts_of(0.1) + n % 3) if good else (0, 0, flags, counts)
        o = kernel.step(t_ns, poses, [(-MS // 2 * k, *word[1:]) for k in reversed(range(per_cycle))])
    assert (HEALTH_NAMES[o["health"]], reason_text(int(o["reason"]))) == (health, reason)


@pytest.mark.parametrize("live", [False, True])
def test_a_long_hold_puts_no_reading_into_the_future(live):
    """GIVEN a hold of 10 s, for good or for a moment THEN VALID ends with the loss time-out.

    Readings had times 5 s ahead: VALID lasted so much longer, also when the hold was set back.
    """
    kernel = Kernel(default_params(mode=1, orient=0, sensor_latency_ns=0))
    p, ends_ns, last_ns = kernel.params[0], 0, 0
    before, timeout_ns = int(p["hold_ns"]), int(p["loss_timeout_ns"])
    rng = np.random.default_rng(1)
    for n in range(2500):
        t_ns = 10_000 * MS + 4 * MS * n
        p["hold_ns"] = 10_000 * MS if not live or 500 <= n < 575 else before
        poses = [(t_ns, (0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))] if n % 2 == 0 else []
        words = [(0, 0, 0, counts_of(0.1 + 2e-4 * rng.standard_normal()))] if n < 1250 else []
        o = kernel.step(t_ns, poses, words)
        last_ns = t_ns if words else last_ns
        assert o["late_s"] >= 0.0, f"cycle {n}"
        ends_ns = t_ns if int(o["status"]) & 1 else ends_ns
    assert ends_ns - last_ns < timeout_ns + 100 * MS


def test_a_hold_that_was_set_back_leaves_no_corrected_timestamps():
    """GIVEN a latency of 200 ms and a hold of 400 ms for 0.3 s THEN timestamps are the sensor's own again.

    Readings seemed to go back in time: they counted as old as usual, for good.
    """
    kernel, rng = (
        Kernel(default_params(mode=1, orient=0, sensor_latency_ns=200 * MS)),
        np.random.default_rng(1),
    )
    p = kernel.params[0]
    before = int(p["hold_ns"])
    for n in range(1000):
        t_ns = 10_000 * MS + 4 * MS * n
        p["hold_ns"] = 400 * MS if 500 <= n < 575 else before
        poses = [(t_ns, (0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))] if n % 2 == 0 else []
        o = kernel.step(t_ns, poses, [(0, 0, 0, counts_of(0.1 + 2e-4 * rng.standard_normal()))])
    assert kernel.state[0]["adaptive"]["hold"]["shift_ns"] == 0
    assert o["late_s"] == pytest.approx(0.2, abs=0.01)
