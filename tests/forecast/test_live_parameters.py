"""Parameters that change while the tool follows: lower limits of the setpoint, adaptation frozen early."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from surffollow.benchmark.job_loop import BOOM, follow
from surffollow.forecast.modes import adapts
from surffollow.forecast.quantities import FULL_POWER_SAMPLES
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_adaptive import AdaptiveState
from surffollow.shm.layout_follow import RUN_FREEZE

from .feeding import default_params

FIELD = replace(
    BOOM, standoff_m=0.5, tau_s=0.15, reading_s=0.02, v_max_mps=0.8, a_max_mps2=4.0, sigma_m=0.005
)


def rolling(x, t):
    """Ground of three waves."""
    return sum(0.03 * math.sin(2.0 * math.pi * x / length_m + length_m) for length_m in (9.0, 17.0, 31.0))


@pytest.mark.parametrize("live", [{"max_jerk": 12.0}, {"max_accel": 1.2}], ids=["jerk", "acceleration"])
@pytest.mark.parametrize("at_s", [3.0, 3.4, 3.8, 4.2])
def test_a_limit_that_falls_does_not_throw_the_tool(live, at_s):
    """GIVEN a tool that follows WHEN jerk or acceleration is limited more THEN it goes on as from the start.

    The setpoint carried an acceleration that it could shed at the new jerk only: it went through the ground.
    """
    run = follow(FIELD, rolling, 10.0, 5.0, live=(at_s, live))
    print(f"{run.clearance_m.min() / FIELD.standoff_m:.2f} stand-offs")
    assert run.clearance_m.min() > 0.7 * FIELD.standoff_m
    assert run.clearance_m.max() < 1.4 * FIELD.standoff_m


@pytest.mark.parametrize("samples", [0, 10, 22, 50])
def test_adaptation_frozen_early_is_frozen_when_enough_is_learned(samples):
    """It froze weights of the first samples: a boom drove into a slope of 5 %, health OK."""

    def hills(x, t):
        return 0.05 * abs((x + 20.0) % 40.0 - 20.0)

    run = follow(FIELD, hills, 20.0, 5.0, live=(samples * FIELD.reading_s, {"adapt": "frozen"}))
    assert run.clearance_m.min() > 0.7 * FIELD.standoff_m


@pytest.mark.parametrize("frozen", [False, True])
@pytest.mark.parametrize("scored", [0, FULL_POWER_SAMPLES - 1, FULL_POWER_SAMPLES])
def test_what_is_frozen_needs_as_many_samples_as_the_full_power_of_the_index(frozen, scored):
    params, a = default_params(), zeros(AdaptiveState)[0]
    params["adapt"], a["weights"]["scored"] = int(not frozen), scored
    assert adapts(params, a) == (not frozen or scored < FULL_POWER_SAMPLES)
    params["run"] = RUN_FREEZE
    assert not adapts(params, a)
