"""A turn between two slow reports is no jump, and a reset no short run of repeated ranges."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow import Follower

from .driving import MS, Kernel, default_params


@pytest.mark.parametrize("max_tilt_rad", [0.05, 0.1])
def test_a_turn_that_the_limits_allow_is_no_jump(max_tilt_rad):
    """GIVEN poses at 10 Hz WHEN the tool turns to the normal THEN the rotation is demanded all the way.

    A turn of 0.3 `max_tilt_rad` between two reports counted as a jump of the frame: no rotation for a while.
    """
    places = [(0.03 * math.cos(2.1 * c), 0.03 * math.sin(2.1 * c)) for c in range(3)]
    sensors = [{"near_m": 0.02, "far_m": 0.25, "position_m": [*p, 0.0]} for p in places]
    f = Follower({"sensors": sensors, "max_tilt_rad": max_tilt_rad}, offset_m=0.1)
    slope, rng = math.tan(0.9 * max_tilt_rad), np.random.default_rng(3)
    tilt = goal = reported = 0.0
    missing = turned = 0
    for ms in range(2000):
        t_ns = 10**9 + ms * MS
        if ms % 4 == 0:  # the ground turns about y at 1 s, below a tool that has adapted
            angle = math.atan(slope if ms >= 1000 else 0.0) - tilt
            ranges = [0.1 + p[0] * math.tan(angle) + 1e-4 * rng.standard_normal() for p in places]
            demand = f.step(t_ns, ranges)
            if ms % 100 == 0:
                f.pose(t_ns, (0.0, 0.0, 0.1, 0.0, math.sin(tilt / 2), 0.0, math.cos(tilt / 2)))
                demand, reported = f.step(t_ns, [math.nan] * 3), tilt
            goal = reported + float(demand[4])
            left = abs(0.9 * max_tilt_rad - tilt)
            if ms > 1100 and left > 0.3 * max_tilt_rad:
                turned, missing = turned + 1, missing + (demand[4] == 0.0)
        tilt += 1e-3 * (goal - tilt) / 0.04
    print(f"{missing} of {turned} steps without rotation, at the end {tilt:.4f} rad of {0.9 * max_tilt_rad}")
    assert abs(tilt - 0.9 * max_tilt_rad) < 0.1 * max_tilt_rad
    assert missing == 0


def test_resets_do_not_shorten_the_usual_run_of_repeated_ranges():
    """GIVEN a sensor that gives each range eight times WHEN SFReset comes often THEN eight stay usual."""
    kernel = Kernel(default_params(mode=1, orient=0, hold_ns=0, sensor_readings=1))
    rng = np.random.default_rng(5)
    usual, held = [], 0.1
    for n in range(1600):
        t_ns = 10_000 * MS + 4 * MS * n
        if n % 8 == 0:
            held = 0.1 + 1e-4 * rng.standard_normal()
            if n >= 800:
                kernel.reset(0.1)
        poses = [(t_ns, (0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))] if n % 2 == 0 else []
        kernel.step(t_ns, poses, ranges=[held], given_t_ns=t_ns)
        usual.append(float(kernel.state[0]["adaptive"]["repeats"]["usual"]))
    print(f"usual {usual[799]:.2f}, behind resets {usual[-1]:.2f}")
    assert usual[799] > 6.0
    assert usual[-1] > 0.8 * usual[799]
