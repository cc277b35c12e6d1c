"""Plant identification after another controller has moved the robot."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow.forecast.plant.plant_identification import model_error, update_plant
from surffollow.forecast.pose import push_pose
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_follow import FollowState

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
    update_plant(params, a, sense, 1)
    assert model_error(a["plant"]) == pytest.approx(2e-6 if set_ns else 0.0)
    np.testing.assert_allclose(np.diff(a["plant"]["error_m2"]), np.diff(before))
    assert a["plant"]["tau_s"] == 0.04


def test_after_it_was_carried_back_the_plan_over_remembered_ground_begins_at_once():
    robot = Tilted(turned(0.0), hill_m=4e-3)
    robot.z_m += 8e-3  # a start with a jump, which no axis without jerk can make
    robot.carry(0.2, 0.6)
    robot.go_back()
    robot.carry(0.2, 0.025)
    assert robot.f.state()["preview_share"] == 1.0
