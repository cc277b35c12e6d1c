"""A sensor that sees the ground behind the tool."""

from __future__ import annotations

import pytest

from surffollow.forecast.plant.shadow_axes import compared_lag_s
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState


@pytest.mark.parametrize(("speed_mps", "lag_s"), [(0.1, 0.2), (0.02, 0.32), (0.0, 0.0)])
def test_shadow_axes_are_compared_when_the_tool_was_over_the_ground_but_at_rest_at_once(speed_mps, lag_s):
    """The trail of a tool stays when it stops: its axes were compared with ground of 0.32 s later."""
    a = zeros(AdaptiveState)[0]
    a["sample"]["lead_m"], a["kinematics"]["speed_mps"] = -0.02, speed_mps
    assert compared_lag_s(a) == pytest.approx(lag_s)
