"""The simulated field: rendering, occlusion, modes and sensors against closed forms and stepped twins."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim

from surffollow.errors import UsageError
from surffollow.sim.field_ground import hump_height, make_ground
from surffollow.sim.field_sensors import accelerometer, laser_range, steepest, target_signal
from surffollow.sim.flexible_tip import Compliance, response, tip_deflection
from surffollow.sim.stereo_camera import render_depth, stereo_disparity
from surffollow.sim.surfaces import HeightField, ramp_field, step_field

LENS = (200.0, 200.0, 31.5, 23.5)
SHAPE = (48, 64)


def looking_down(x, y, z, tilt=0.0):
    c, s = math.cos(tilt), math.sin(tilt)
    made = np.eye(4)
    made[:3, :3] = np.array([[0.0, -c, s], [-1.0, 0.0, 0.0], [0.0, -s, -c]])
    made[:3, 3] = (x, y, z)
    return made


def test_depth_of_a_slope_is_that_of_the_plane():
    ground = ramp_field((-2.0, -2.0, 2.0, 2.0), 0.2, grid_m=0.01)
    pose = looking_down(0.1, -0.2, 1.5, tilt=0.3)
    depth = render_depth(ground, pose, LENS, SHAPE, baseline_m=0.1)
    v, u = np.indices(SHAPE)
    rays = np.stack([(u - LENS[2]) / LENS[0], (v - LENS[3]) / LENS[1], np.ones(SHAPE)], axis=-1)
    places = (rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    assert np.isfinite(depth).all()
    truth = np.array([ground.height_m(x, y) for x, y in places[..., :2].reshape(-1, 2)]).reshape(SHAPE)
    assert np.abs(places[..., 2] - truth).max() < 1e-6


def test_the_foot_of_a_step_is_hidden_where_the_second_camera_looks_over_its_edge():
    ground = step_field((-1.0, -1.0, 1.0, 1.0), 0.0, height_m=0.3, grid_m=0.005)
    pose = np.eye(4)  # x of the camera along x of the ground, looking down
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = (-0.15, 0.0, 1.0)
    one = render_depth(ground, pose, LENS, SHAPE)
    pair = render_depth(ground, pose, LENS, SHAPE, baseline_m=0.4)
    assert np.isfinite(one).all()
    hidden = np.isnan(pair)
    x = -0.15 + (np.arange(64) - LENS[2]) / LENS[0] * one
    foot = (x < -0.008) & (one > 0.9)
    # from (0.25, 1) over the edge at (0, 0.3): shadow to x = -0.3 · 0.25 / 0.7
    shadow = -0.3 * 0.25 / 0.7
    assert hidden[foot & (x > shadow + 0.01)].all()
    assert not hidden[x < shadow - 0.01].any()


def test_noise_of_disparities_has_the_stated_size_and_holes():
    depth = np.full((200, 300), 1.3)
    q = stereo_disparity(depth, 33.0, np.random.default_rng(0), noise_px=0.2, shots=0.0)
    assert np.nanstd(q) == pytest.approx(0.2, rel=0.05)
    assert 0.001 < np.isnan(q).mean() < 0.05
    again = stereo_disparity(depth, 33.0, np.random.default_rng(0), noise_px=0.2, shots=0.0)
    assert np.array_equal(q, again, equal_nan=True)


def test_the_hump_is_as_steep_as_asked_for_and_as_high():
    r = np.linspace(0.0, 0.4, 40001)
    slope = np.abs(np.diff(hump_height(r)) / np.diff(r)).max()
    assert math.degrees(math.atan(slope)) == pytest.approx(70.0, abs=0.01)
    ground = make_ground("hump", (1.2, -0.5, 2.2, 0.5), 1)
    assert 66.0 < math.degrees(steepest(ground)) < 71.0
    assert ground.heights_m.max() == pytest.approx(0.2, abs=0.01)


def test_grounds_differ_by_seed_and_unknown_ones_are_refused():
    region = (0.0, 0.0, 1.0, 1.0)
    first, again, other = (make_ground("bumpy", region, s).heights_m for s in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    with pytest.raises(UsageError, match="flat, bumpy, hump"):
        make_ground("swamp", region, 0)


@pytest.mark.parametrize(("frequency", "zeta"), [(2.0, 0.03), (4.5, 0.0), (1.2, 0.25)])
def test_mode_answers_as_the_discrete_state_space_does(frequency, zeta):
    drive = np.random.default_rng(3).normal(size=500)
    omega, dt = 2 * math.pi * frequency, 0.005
    system = (
        np.array([[0, 1], [-(omega**2), -2 * zeta * omega]]),
        np.array([[0.0], [1.0]]),
        np.array([[1.0, 0.0]]),
        np.zeros((1, 1)),
    )
    twin = dlsim(cont2discrete(system, dt, "zoh"), drive)[1][:, 0]
    made = response(drive, 1 / dt, frequency, zeta)
    assert np.abs(made - twin).max() < 1e-10


def test_a_mode_excited_along_the_radius_does_not_bend_the_arm_sideways():
    t = np.arange(0.0, 3.0, 0.005)
    tip = np.column_stack([1.5 + 0.1 * np.sin(3 * t), np.zeros(len(t)), np.full(len(t), 0.1)])
    moved = tip_deflection(tip, 200.0, np.array([0.0, 0.0, 0.6]), Compliance())
    assert np.abs(moved[:, 1]).max() < 1e-12  # sway only
    assert np.abs(moved[:, 2]).max() > 1e-4
    still = tip_deflection(np.tile(tip[:1], (50, 1)), 200.0, np.zeros(3), Compliance())
    assert np.abs(still).max() == 0.0


def test_laser_reads_the_distance_along_the_body_axis():
    field = ramp_field((-1.0, -1.0, 1.0, 1.0), 0.1, grid_m=0.01)
    tip = np.array([[0.0, 0.0, field.height_m(0.0, 0.0) + 0.05], [0.2, 0.1, field.height_m(0.2, 0.1) - 0.01]])
    up = np.tile([0.0, 0.0, 1.0], (2, 1))
    assert laser_range(field, tip, up) == pytest.approx([0.05, -0.01], abs=1e-6)
    tilted = np.array([[math.sin(0.3), 0.0, math.cos(0.3)]])
    grade = field.normal(0.0, 0.0)
    high = 0.05 * grade[2]  # distance from the plane
    assert laser_range(field, tip[:1], tilted)[0] == pytest.approx(high / (tilted[0] @ grade), abs=1e-6)
    flat = HeightField(np.zeros((10, 10)), 0.0, 0.0, 0.01)
    assert np.isnan(laser_range(flat, np.array([[0.05, 0.05, 3.0]]), up[:1]))[0]
    assert laser_range(flat, np.array([[0.05, 0.05, 3.0]]), up[:1], 4.0)[0] == pytest.approx(3.0, abs=1e-6)


def test_accelerometer_and_detector_follow_their_formulas():
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 2.0, 0.005)
    tip = np.column_stack([0.1 * np.sin(5 * t), t, 0 * t])
    felt = accelerometer(tip, 200.0, rng, sigma_mps2=0.0)[5:-5]
    assert np.abs(felt[:, 0] + 2.5 * np.sin(5 * t[5:-5])).max() < 0.01
    signal = target_signal(tip, np.array([0.0, 0.5, -0.1]), rng, size_m=0.1, sigma=0.0)
    assert signal.max() <= 1.0 / 8.0 + 1e-12  # 0.1 m away at best
    assert abs(t[signal.argmax()] - 0.5) < 0.1
