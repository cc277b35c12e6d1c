"""Kinematics, limits and reach of the arm; polar correction and calibration matrix."""

from __future__ import annotations

import math

import numpy as np
import pytest

import naive_field as naive
from surffollow.errors import ScanFileError, ScanInputError
from surffollow.scan import (
    Arm,
    CalibrationMatrix,
    PolarCorrection,
    TerrainGrid,
    WristLimits,
    polar_correction,
)
from surffollow.scan.limits import WorkSpace
from surffollow.scan.path import UNKNOWN_BENEATH
from surffollow.scan.plan import PlanSettings, plan_scan
from surffollow.scan.schemes import lanes

VEHICLE = naive.shift(0.4, -0.3, 0.2) @ naive.turn("z", 0.7)
BASE = naive.shift(0.1, 0.05, 0.5) @ naive.turn("z", -0.2)
CAMERA = naive.shift(0.05, 0.0, 0.1) @ naive.turn("x", 2.5)


def arm_of(**changes):
    return Arm(
        ground_from_vehicle=VEHICLE,
        vehicle_from_base=BASE,
        forearm_from_camera=CAMERA,
        **({"sag_at_2m_m": 0.05} | changes),
    )


def joints_of(rng, n):
    low = np.array([-2.0, 0.3, -1.8, -0.7, -0.7])
    high = np.array([2.0, 1.7, 0.2, 0.7, 0.7])
    q = rng.uniform(low, high, (n, 5))
    return q[q[:, 1] - q[:, 2] > 0.05]  # elbow up, and not straight


@pytest.mark.parametrize("seed", range(3))
def test_tip_and_joints_are_each_others_inverse_to_a_nanometre(seed):
    arm, q = arm_of(), joints_of(np.random.default_rng(seed), 4000)
    rho = arm.upper_m * np.cos(q[:, 1]) + arm.fore_m * np.cos(q[:, 2])
    q = q[rho > 0.2]  # beyond the vertical axis yaw turns round
    tip, normal = arm.forward(q)
    back = arm.inverse(tip, normal)
    assert np.abs(back - q).max() <= 1e-9, seed
    again, n2 = arm.forward(back)
    assert np.abs(again - tip).max() <= 1e-9, seed
    assert np.abs(n2 - normal).max() <= 1e-9, seed


def test_forward_kinematics_is_the_chain_of_the_frames():
    arm, q = arm_of(), joints_of(np.random.default_rng(5), 60)
    poses = arm.ground_from_tip(q)
    tip, normal = arm.forward(q)
    for k, joints in enumerate(q):
        twin = naive.ground_from_tip(arm, joints)
        assert np.abs(poses[k] - twin).max() < 1e-12
        assert np.abs(tip[k] - twin[:3, 3]).max() < 1e-12
        assert np.abs(normal[k] - twin[:3, 2]).max() < 1e-12


def test_camera_stays_level_whatever_the_wrist_does():
    arm, q = arm_of(), joints_of(np.random.default_rng(6), 20)
    other = q.copy()
    other[:, 3:] = 0.3
    assert np.array_equal(arm.ground_from_camera(q), arm.ground_from_camera(other))
    level = naive.ground_from_tip(arm_of(tool_m=0.0), [*q[0, :3], 0.0, 0.0]) @ CAMERA
    assert np.abs(arm.ground_from_camera(q)[0] - level).max() < 1e-12


def test_sag_of_five_centimetres_at_two_metres_lowers_the_real_tip():
    stiff, soft = arm_of(sag_at_2m_m=0.0), arm_of()
    assert soft.sag_m(2.0) == pytest.approx(0.05)
    q = joints_of(np.random.default_rng(7), 50)
    down = stiff.forward(q)[0] - soft.forward(q)[0]
    assert (down[:, 2] > 0).all()
    assert np.abs(down[:, :2]).max() == 0.0


def test_out_of_reach_is_no_joint_angle_and_not_reachable():
    arm = arm_of()
    base = np.array(arm.base_m)
    tip = base + np.array([[3.2, 0, 0], [2.0, 0, -0.5], [-2.0, 0, -0.5]])
    up = np.tile([0.0, 0.0, 1.0], (3, 1))
    c, s = math.cos(arm.heading_rad), math.sin(arm.heading_rad)
    tip[:, :2] = (tip - base)[:, :2] @ np.array([[c, s], [-s, c]]) + base[:2]
    assert np.isnan(arm.inverse(tip, up)[0]).all()
    assert arm.reachable(tip, up).tolist() == [False, True, False]  # too far, in front, behind the yaw limit
    steep = np.array([[math.sin(1.0), 0.0, math.cos(1.0)]])
    assert not arm.reachable(tip[1:2], steep)[0]
    assert arm_of(wrist=WristLimits.symmetric(1.2)).reachable(tip[1:2], steep)[0]


def test_a_plan_takes_the_arm_as_its_work_space():
    arm: WorkSpace = Arm(vehicle_from_base=naive.shift(0, 0, 0.6))
    ground = TerrainGrid.of(np.zeros((100, 320)), origin_m=(0.6, -0.5), grid_m=0.01)
    plan = plan_scan(
        ground,
        PlanSettings(
            region=(0.8, -0.3, 3.6, 0.3), gap_m=0.05, body_m=[[0, 0, 0]], swath_m=0.1, work_space=arm
        ),
    )
    far = np.hypot(plan.position_m[:, 0], plan.position_m[:, 1]) > 3.0
    assert plan.has(64)[far].all()
    assert not plan.has(64)[plan.position_m[:, 0] < 2.5].any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"upper_m": 0.0}, "upper_m"),
        ({"sag_at_2m_m": -0.01}, "sag_at_2m_m"),
        ({"vehicle_from_base": naive.turn("x", 0.1)}, "tilted"),
        ({"vehicle_from_base": 2.0 * np.eye(4)}, "last row"),
    ],
)
def test_an_impossible_arm_is_refused(change, message):
    with pytest.raises(ScanInputError, match=message):
        Arm(**change)


def test_polar_fit_recovers_the_arms_errors_and_brings_the_tip_to_the_desired_place():
    rng, base = np.random.default_rng(2), np.array([0.3, -0.2])
    desired = base + rng.uniform([1.0, -1.0], [2.5, 1.0], (40, 2))
    truth = PolarCorrection((0.3, -0.2), 1.02, -0.015, 0.02)
    commanded = truth.apply(desired)
    fit = PolarCorrection.fit(commanded, desired, base)
    assert (fit.scale, fit.offset_m, fit.offset_rad) == pytest.approx((1.02, -0.015, 0.02), abs=1e-12)
    noisy = PolarCorrection.fit(commanded + rng.normal(0, 0.002, (40, 2)), desired, base)
    assert np.abs(noisy.apply(desired) - commanded).max() < 0.004


def test_zone_of_effectiveness_ends_where_residuals_are_large():
    rng = np.random.default_rng(3)
    measured = rng.uniform([1.0, -1.0], [2.5, 1.0], (200, 2))
    commanded = measured.copy()
    commanded[measured[:, 0] > 2.2, 1] += 0.05  # the model is wrong out there
    fit = PolarCorrection.fit(commanded, measured, (0, 0), zone_m=0.02)
    assert fit.effective([[1.5, 0.0]])[0]
    assert not fit.effective([[2.4, 0.0]])[0]


def test_polar_correction_samples_z_again_and_keeps_the_attitude():
    _rows, cols = np.indices((120, 220))
    ground = TerrainGrid.of(0.1 * (cols + 0.5) * 0.01, grid_m=0.01)  # slope of 0.1 along x
    path = lanes((0.6, 0.3, 1.6, 0.8), 0.1, step_m=0.05)
    path = path.changed(position_m=np.column_stack([path.position_m[:, :2], 0.1 * path.position_m[:, 0]]))
    move = PolarCorrection((0.0, 0.5), 1.0, 0.05, 0.0)
    made = polar_correction(path, move, ground)
    assert np.abs(made.position_m[:, 2] - 0.1 * made.position_m[:, 0]).max() < 1e-12
    assert np.array_equal(made.normal, path.normal)
    assert np.array_equal(polar_correction(path, move).position_m[:, 2], path.position_m[:, 2])
    outside = polar_correction(path, PolarCorrection((0.0, 0.5), 2.0), ground)
    far = outside.position_m[:, 0] > 2.25
    assert outside.has(UNKNOWN_BENEATH)[far].all()
    assert far.any()


@pytest.mark.parametrize(
    ("commanded", "measured", "message"),
    [
        ([[1.0, 0.0]], [[1.0, 0.0]], "at least 2"),
        ([[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, 1.0]], "two distances"),
        ([[1.0, 0.0], [np.nan, 1.0]], [[1.0, 0.0], [0.0, 2.0]], "finite"),
    ],
)
def test_polar_fit_refuses_spots_that_say_too_little(commanded, measured, message):
    with pytest.raises(ScanInputError, match=message):
        PolarCorrection.fit(commanded, measured, (0.0, 0.0))


def spots_of(seed, n=30):
    rng = np.random.default_rng(seed)
    xy = rng.uniform([1.0, -1.0], [2.5, 1.0], (n, 2))
    return np.column_stack([xy, 0.01 * xy[:, 0] ** 2 - 0.006 * xy[:, 1] + rng.normal(0, 1e-3, n)])


@pytest.mark.parametrize("seed", range(5))
def test_matrix_holds_the_delaunay_surface_at_its_nodes(seed):
    spots = spots_of(seed)
    ocm = CalibrationMatrix.fit(spots, grid_m=0.05)
    rows, cols = ocm.values_m.shape
    x, y = np.meshgrid(ocm.origin_m[0] + 0.05 * np.arange(cols), ocm.origin_m[1] + 0.05 * np.arange(rows))
    twin = naive.delaunay_surface(spots, np.column_stack([x.ravel(), y.ravel()])).reshape(rows, cols)
    clear = np.isfinite(twin) & ocm.inside
    assert clear.sum() > 0.5 * rows * cols
    assert np.abs(ocm.values_m - twin)[clear].max() < 1e-12, seed
    assert (np.isfinite(twin) != ocm.inside).sum() <= 3  # nodes on the hull's edge
    at = np.column_stack([x.ravel(), y.ravel()])
    assert np.abs(ocm.at(at) - ocm.values_m.ravel()).max() < 1e-12
    middle = at[:-1] + [0.025, 0.0]
    inner = (np.arange(len(at) - 1) % cols) < cols - 1
    mean = 0.5 * (ocm.values_m.ravel()[:-1] + ocm.values_m.ravel()[1:])
    assert np.abs(ocm.at(middle) - mean)[inner].max() < 1e-12


def test_leave_one_out_residual_is_the_error_without_the_spot():
    spots = spots_of(9, 25)
    ocm = CalibrationMatrix.fit(spots)
    for k in range(len(spots)):
        value = naive.delaunay_surface(np.delete(spots, k, axis=0), spots[k : k + 1, :2])[0]
        assert np.isnan(ocm.left_out_m[k]) == np.isnan(value)
        if np.isfinite(value):
            assert ocm.left_out_m[k] == pytest.approx(spots[k, 2] - value, abs=1e-12)


def test_beyond_the_spots_the_policy_decides():
    spots = np.array([[1.0, 0.0, 0.01], [2.0, 0.0, 0.02], [1.0, 1.0, 0.03], [2.0, 1.0, 0.04]])
    assert CalibrationMatrix.fit(spots).at([[5.0, 5.0]])[0] == pytest.approx(0.04)
    unknown = CalibrationMatrix.fit(spots, outside="unknown")
    assert np.isnan(unknown.at([[5.0, 0.5]])[0])
    assert unknown.at([[1.5, 0.5]])[0] == pytest.approx(0.025)
    path = lanes((1.2, 0.2, 1.8, 0.8), 0.1, step_m=0.05)
    path = path.changed(position_m=np.nan_to_num(path.position_m))
    assert np.allclose(
        unknown.apply(path).position_m[:, 2], 0.01 * path.position_m[:, 0] + 0.02 * path.position_m[:, 1]
    )


def test_calibration_file_gives_back_the_same_matrix(tmp_path):
    ocm = CalibrationMatrix.fit(spots_of(4), outside="unknown")
    ocm.save(tmp_path / "arm.json")
    back = CalibrationMatrix.load(tmp_path / "arm.json")
    at = np.random.default_rng(0).uniform([0.5, -1.5], [3.0, 1.5], (200, 2))
    assert np.array_equal(ocm.at(at), back.at(at), equal_nan=True)
    assert np.array_equal(ocm.left_out_m, back.left_out_m, equal_nan=True)
    (tmp_path / "arm.json").write_text('{"format": "other"}')
    with pytest.raises(ScanFileError, match="format"):
        CalibrationMatrix.load(tmp_path / "arm.json")


@pytest.mark.parametrize(
    ("spots", "message"),
    [
        ([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 0.0, 0.0]], "line"),
        ([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]], "line"),
        ([[1.0, 0.0, 12.0], [2.0, 0.0, 0.0], [1.0, 1.0, 0.0]], "metres"),
        ([[1.0, 0.0, np.nan], [2.0, 0.0, 0.0], [1.0, 1.0, 0.0]], "finite"),
    ],
)
def test_spots_that_make_no_surface_are_refused(spots, message):
    with pytest.raises(ScanInputError, match=message):
        CalibrationMatrix.fit(spots)
