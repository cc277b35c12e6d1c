"""A sensor that sees the ground behind the tool."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow.forecast.plant.shadow_axes import compared_lag_s
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState

from .test_adaptive_closed_loop import Job, clearances_m


@pytest.mark.parametrize(("speed_mps", "lag_s"), [(0.1, 0.2), (0.02, 0.32), (0.0, 0.0)])
def test_shadow_axes_are_compared_when_the_tool_was_over_the_ground_but_at_rest_at_once(speed_mps, lag_s):
    """The trail of a tool stays when it stops: its axes were compared with ground of 0.32 s later."""
    a = zeros(AdaptiveState)[0]
    a["sample"]["lead_m"], a["kinematics"]["speed_mps"] = -0.02, speed_mps
    assert compared_lag_s(a) == pytest.approx(lag_s)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(("trail", "slope", "speed"), [(0.68, 0.58, 0.6), (1.0, 0.67, 0.44), (1.0, 1.0, 0.3)])
def test_level_ground_behind_a_long_fall_is_no_trough_of_a_wave(trail, slope, speed, seed):
    """GIVEN a trail of 0.7 or 1 stand-off D WHEN a fall of 20 D ends THEN the tool stays above 0.75 D.

    The sensor sees the end of the fall late. Waves far steeper than the ground fitted the fall over the trail
    and went on to fall: the least clearance was 0.25 to 0.53 D.
    """
    d, tau_s = 0.1, 0.04
    speed_mps = speed * d / tau_s
    job = Job(
        window_m=(0.3 * d, 2.5 * d),
        v_max_mps=0.5 * d / tau_s,
        a_max_mps2=1.5 * d / tau_s**2,
        speed_mps=speed_mps,
        mount_m=-trail * d,
    )
    places = speed_mps * 1e-3 * np.arange(round(28e3 * d / speed_mps))
    heights = -slope * np.clip(places - 4.0 * d, 0.0, 20.0 * d)
    least = clearances_m(job, job.follower(), seed, places, heights).min() / d
    print(f"least clearance {least:.2f} D")
    assert least > 0.75
