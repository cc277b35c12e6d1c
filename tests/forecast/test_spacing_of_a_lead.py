"""A sensor ahead of the tool shows the ground also where its samples lie far apart."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow import Follower

STANDOFF_M, TAU_S, LEAD_M, SPEED_MPS = 0.1, 0.04, 0.08, 0.5
MS = 1_000_000


@pytest.mark.parametrize("interval_ms", [8, 11, 13, 14, 15, 16, 20, 40])
@pytest.mark.parametrize("channels", [1, 2])
def test_a_lead_is_used_whatever_the_travel_between_its_samples(interval_ms: int, channels: int) -> None:
    """GIVEN a sensor 80 mm ahead WHEN 4 to 20 mm lie between two samples THEN the error is small."""

    def ground(x: float) -> float:
        return 0.02 * math.sin(2.0 * math.pi * x / 0.4)

    leads = [LEAD_M, 0.0][:channels]
    f = Follower(
        {
            "plant": {"tau_s": TAU_S, "v_max_mps": 0.5, "a_max_mps2": 10.0},
            "range_min_m": 0.03,
            "range_max_m": 0.3,
            "sensors": [{"position_m": [lead, 0.0, 0.0]} for lead in leads],
        },
        offset_m=STANDOFF_M,
    )
    rng, z = np.random.default_rng(interval_ms), ground(0.0) + STANDOFF_M
    target, clearance = z, []
    for ms in range(6000):
        x = SPEED_MPS * ms * 1e-3
        if ms % 10 == 0:
            f.pose(ms * MS, (x, 0.0, z, 0.0, 0.0, 0.0, 1.0))
        if ms % interval_ms == 0:
            f.step(ms * MS, [z - ground(x + lead) + 2e-4 * rng.standard_normal() for lead in leads])
        if ms % 10 == 0:
            target = z + f.step(ms * MS, [math.nan] * channels)[2]
            clearance.append(z - ground(x))
        z += (target - z) * 1e-3 / TAU_S
    error = np.array(clearance[200:]) - STANDOFF_M
    assert np.sqrt(np.mean(error**2)) < 0.01 * STANDOFF_M
    assert f.state()["preview_share"] > 0.9
