"""Plant identification after another controller has moved the robot."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow import Follower
from surffollow.forecast.plant.plant_identification import update_plant
from surffollow.forecast.pose import push_pose
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_follow import FollowState, Inputs

from .feeding import MS, default_params
from .tilted import Tilted, turned


@pytest.mark.parametrize("set_ns", [0, 1])
def test_after_a_loss_the_common_error_is_subtracted_and_its_differences_stay(set_ns):
    params, state = default_params(), zeros(FollowState)[0]
    a, sense = state["adaptive"], state["sense"]
    params["plant_tau_s"] = a["plant"]["tau_s"] = a["plant"]["tau_configured_s"] = 0.04
    a["plant"]["error_m2"] = [5e-6, 4e-6, 3e-6, 2e-6, 3e-6, 4e-6, 5e-6]
    before = a["plant"]["error_m2"].copy()
    a["setpoint"]["t_ns"] = set_ns
    push_pose(sense, 100 * MS, np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0]), 0)
    update_plant(params, a, sense, zeros(Inputs)[0])
    assert a["plant"]["error_m2"].min() == pytest.approx(2e-6 if set_ns else 0.0)
    np.testing.assert_allclose(np.diff(a["plant"]["error_m2"]), np.diff(before))
    assert a["plant"]["tau_s"] == 0.04


def test_after_it_was_carried_back_the_plan_over_remembered_ground_begins_at_once():
    robot = Tilted(turned(0.0), hill_m=4e-3)
    robot.z_m += 8e-3  # a start with a jump, which no axis without jerk can make
    robot.carry(0.2, 0.6)
    robot.go_back()
    robot.carry(0.2, 0.025)
    assert robot.f.state()["preview_share"] == 1.0


@pytest.mark.parametrize("period_ms", [2, 4, 5, 8, 10])
def test_the_time_constant_is_found_for_controllers_of_100_to_500_hz(period_ms):
    """GIVEN an axis of τ = 40 ms over hills WHEN each report brings a setpoint THEN τ is found within 6 %.

    Setpoints of periods of 10 ms alone gave 33 ms to a controller of 2 to 8 ms.
    """
    tau_s, standoff_m, rng = 0.04, 0.1, np.random.default_rng(4)
    f = Follower(
        {"plant": {"tau_s": tau_s}, "sensors": [{"near_m": 0.03, "far_m": 0.3}]}, offset_m=standoff_m
    )
    z = setpoint = standoff_m
    for ms in range(15_000):
        x, t_ns = 0.2e-3 * ms, 10**9 + ms * MS
        if ms % 4 == 0:
            ground = 0.01 * math.sin(2.0 * math.pi * x / 0.4)
            f.step(t_ns, [z - ground + 1e-4 * rng.standard_normal()])
        if ms % period_ms == 0:
            f.pose(t_ns, (x, 0.0, z, 0.0, 0.0, 0.0, 1.0))
            setpoint = z + f.step(t_ns, [math.nan])[2]
        z += (setpoint - z) * (1.0 - math.exp(-1e-3 / tau_s))
    print(f"{1e3 * f.state()['tau_s']:.1f} ms")
    assert f.state()["tau_s"] == pytest.approx(tau_s, rel=0.06)
