"""A tilted tool: its stand-off is kept along its axis, to the ground that it points at."""

from __future__ import annotations

import math

import numpy as np
import pytest

from .tilted import UPRIGHT, Tilted, beam_of, turned

Z_DOWN, X_DOWN = (1.0, 0.0, 0.0, 0.0), (0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5))
Y_DOWN = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))


@pytest.mark.parametrize("pitch_deg", [-30.0, -10.0, -3.0, 3.0, 10.0, 30.0])
@pytest.mark.parametrize("slope", [-0.2, 0.0, 0.2])
def test_a_tilted_tool_keeps_its_distance_along_its_axis(pitch_deg, slope):
    e = Tilted(turned(pitch_deg), slope).carry(0.1, 0.4)[2000:]
    assert abs(e.mean()) < 1.5e-4
    assert e.std() < 1.5e-4


@pytest.mark.parametrize("frame", [Z_DOWN, X_DOWN, Y_DOWN])
@pytest.mark.parametrize("q", [turned(-20.0), turned(0.0), turned(20.0), turned(10.0, -15.0)])
@pytest.mark.parametrize("mount", [(0.0, 0.0, 0.0), (0.003, 0.002, 0.015)])
def test_how_the_axes_of_the_tool_are_named_makes_no_difference(frame, q, mount):
    assert abs(abs(beam_of(frame)).max() - 1.0) < 1e-12
    plain = Tilted(q, hill_m=4e-3, mount=mount).carry(0.1, 0.5)
    np.testing.assert_allclose(
        Tilted(q, hill_m=4e-3, mount=mount, frame=frame).carry(0.1, 0.5), plain, atol=2e-5
    )


@pytest.mark.parametrize("pitch_deg", [-20.0, -10.0, 10.0, 20.0])
@pytest.mark.parametrize("beside_m", [0.02, 0.05])
def test_a_sensor_before_a_tilted_tool_keeps_the_tools_distance_not_its_own(pitch_deg, beside_m):
    for slope in (0.0, 0.2, math.tan(math.radians(-pitch_deg))):
        e = Tilted(turned(pitch_deg), slope, mount=(beside_m, 0.0, 0.0)).carry(0.1, 0.4)[2500:]
        assert abs(e.mean()) < 2e-4, f"slope {slope:.2f}"


@pytest.mark.parametrize("slope", [-0.2, 0.0, 0.2])
def test_a_beam_tilted_forward_under_an_upright_tool_leads(slope):
    robot = Tilted(UPRIGHT, slope, turn=turned(-20.0))
    e = robot.carry(0.1, 0.4)[2500:]
    assert abs(e.mean() + 0.1 * (1.0 - math.cos(math.radians(20.0)))) < 2e-4, "its length is the stand-off"
    assert robot.f.state()["preview_share"] == 1.0


@pytest.mark.parametrize("q", [turned(-20.0), turned(20.0), turned(0.0, 20.0), turned(10.0, -15.0)])
def test_over_hills_it_follows_like_an_upright_one(q):
    upright = Tilted(turned(0.0), hill_m=4e-3).carry(0.1, 1.0)[3000:].std()
    assert Tilted(q, hill_m=4e-3).carry(0.1, 1.0)[3000:].std() < 1.3 * upright + 1e-4


@pytest.mark.parametrize("q", [turned(-20.0), turned(20.0), turned(0.0, 20.0), turned(10.0, -15.0)])
def test_what_it_remembers_serves_where_it_points(q):
    robot = Tilted(q, hill_m=6e-3)
    first = robot.carry(0.2, 0.6)[500:]
    robot.go_back()
    second = robot.carry(0.2, 0.45)[500:]
    assert robot.f.state()["preview_share"] == 1.0
    assert second.std() < 0.9 * first.std()
