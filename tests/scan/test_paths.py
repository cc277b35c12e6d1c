"""Paths: coverage, attitudes against the linear programme, clearance, times."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

import naive_scan as naive
from scan.sample_ground import GRID, ground_of
from surffollow.errors import ScanInputError
from surffollow.scan import TerrainGrid, WristLimits, disc, parse_body
from surffollow.scan.attitude_angles import body_axes, normals_of, wrist_angles
from surffollow.scan.check import check_path
from surffollow.scan.clearance import clear_ground, control_points
from surffollow.scan.envelope import envelope_of
from surffollow.scan.following import advanced_terrain_following, reactionary, sample_terrain
from surffollow.scan.limits import Annulus
from surffollow.scan.path import OUT_OF_REACH, STOP, TURN, WRIST_LIMIT, ScanPath
from surffollow.scan.path_file import write_path
from surffollow.scan.plan import PlanSettings, plan_scan
from surffollow.scan.schemes import arcs, lanes
from surffollow.scan.shaped_motion import limited_climb
from surffollow.scan.shaping import Shaper
from surffollow.scan.timing import MotionLimits, timed

BODY = disc(0.1)


def sampled(ground, gap=0.05, step=0.03):
    envelope = envelope_of(ground, gap)
    return sample_terrain(lanes((0.25, 0.25, 0.65, 0.65), 0.1, step_m=step), envelope), envelope


@pytest.mark.parametrize("scheme", ["lanes", "arcs"])
def test_every_point_of_the_region_is_within_half_a_swath_of_a_pass(scheme):
    for seed in range(30):
        rng = np.random.default_rng(seed)
        sides, swath = rng.uniform(0.3, 1.5, 2), float(rng.uniform(0.02, 0.3))
        if scheme == "lanes":
            path = lanes((0, 0, *sides), swath, step_m=0.01, angle_rad=float(rng.uniform(-4, 4)))
        else:
            path = arcs((0, 0, *sides), swath, step_m=0.01, base_m=(-0.6, float(rng.uniform(-2, 2))))
        xy = path.position_m[:, :2]
        step = np.linalg.norm(np.diff(xy, axis=0), axis=1).max()
        points = rng.uniform(0, 1, (1500, 2)) * sides
        d = cKDTree(xy[path.passes >= 0]).query(points)[0]
        assert np.sqrt(np.maximum(d**2 - (step / 2) ** 2, 0)).max() <= swath / 2 + 1e-9, f"seed {seed}"
        assert step < 0.02


def test_polygons_are_covered_and_turns_are_smooth():
    corners = np.array([[0.0, 0.0], [1.0, 0.2], [0.7, 0.9], [0.1, 0.6]])
    path = lanes(corners, 0.1, step_m=0.002, angle_rad=0.4)
    step = np.diff(path.position_m[:, :2], axis=0)
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    assert np.abs(np.diff(heading)).max() < 0.12
    assert path.has(TURN).any()
    assert (np.linalg.norm(step, axis=1) > 0).all()


def test_arcs_move_the_base_joint_alone_along_a_pass():
    base = (-0.5, 0.3)
    path = arcs((0, 0, 1, 1), 0.15, step_m=0.01, base_m=base)
    d = path.position_m[:, :2] - base
    for k in range(path.passes.max() + 1):
        on = path.passes == k
        assert np.ptp(np.hypot(d[on, 0], d[on, 1])) < 1e-12
    np.testing.assert_allclose(np.arctan2(d[:, 1], d[:, 0]), path.azimuth_rad, atol=1e-12)


def test_wrist_angles_normals_and_quaternions_belong_together():
    rng = np.random.default_rng(1)
    angles, azimuth = rng.uniform(-1.2, 1.2, (50, 2)), rng.uniform(-3.1, 3.1, 50)
    normal = normals_of(angles, azimuth)
    np.testing.assert_allclose(wrist_angles(normal, azimuth), angles, atol=1e-9)
    for axes, (pitch, roll), psi in zip(body_axes(normal, azimuth), angles, azimuth):
        np.testing.assert_allclose(axes, naive.rotation(psi, pitch, roll), atol=1e-9)


def test_heights_and_normals_on_a_slope_are_those_of_the_equations():
    y, x = np.mgrid[0:90, 0:90] * GRID + GRID / 2
    path, _ = sampled(TerrainGrid.of(0.5 * x - 0.2 * y, grid_m=GRID))
    normal = np.array([-0.5, 0.2, 1.0]) / math.sqrt(1.29)
    np.testing.assert_allclose(path.normal, np.tile(normal, (len(path), 1)), atol=1e-9)
    above = 0.5 * path.position_m[:, 0] - 0.2 * path.position_m[:, 1]
    assert np.abs(path.position_m[:, 2] - above - 0.05 * math.sqrt(1.29)).max() < 3e-4


def test_attitude_needs_no_more_lift_than_the_linear_programme():
    for seed in range(25):
        rng = np.random.default_rng(seed)
        ground = ground_of(seed, steepest=1.0)
        path, envelope = sampled(ground)
        limit = math.radians(45)
        got = advanced_terrain_following(path, BODY, envelope, limit)
        e, points = envelope.grid.heights_m, control_points(got, BODY)
        over = naive.bilinear(e, GRID, points[..., 0], points[..., 1]) - points[..., 2]
        assert over.max() < 1e-6, f"seed {seed}"
        angles = wrist_angles(got.normal, got.azimuth_rad)
        assert np.abs(angles).max() <= limit + 1e-9
        for i in rng.choice(len(got), 3, replace=False):
            offsets = (points[i] - got.position_m[i])[:, :2]
            slopes = (math.tan(limit), math.tan(limit) / math.cos(angles[i, 0]))
            lp = naive.least_lift_lp(e, GRID, path.position_m[i], offsets, slopes)
            assert got.lift_m[i] <= 1.05 * lp + 5e-4, f"seed {seed}, sample {i}"


def test_attitude_on_broken_ground_is_as_good_as_a_search_over_attitudes():
    for seed in range(8):
        rng = np.random.default_rng(seed)
        path, envelope = sampled(ground_of(seed))
        limit = math.radians(float(rng.choice([20, 45])))
        got = advanced_terrain_following(path, BODY, envelope, limit)
        for i in rng.choice(len(got), 3, replace=False):
            best = naive.least_lift_search(envelope.grid.heights_m, GRID, path.position_m[i], BODY, limit, 21)
            assert got.lift_m[i] <= 1.05 * best + 5e-4, f"seed {seed}, sample {i}"


def test_turning_saves_lift_over_the_reactionary_baseline():
    saved = []
    for seed in range(5):
        path, envelope = sampled(ground_of(seed, steepest=1.0))
        turned = advanced_terrain_following(path, BODY, envelope, 0.8)
        lifted = reactionary(path, BODY, envelope)
        np.testing.assert_array_equal(lifted.normal, path.normal)
        saved.append(lifted.lift_m.mean() - turned.lift_m.mean())
    assert min(saved) > 0.0


def test_flat_ground_is_followed_without_turning_or_lifting():
    path, envelope = sampled(TerrainGrid.of(np.zeros((90, 90)), grid_m=GRID))
    got = advanced_terrain_following(path, BODY, envelope, 0.5)
    np.testing.assert_array_equal(got.normal, path.normal)
    assert got.lift_m.max() == 0.0


def test_a_slope_beyond_the_wrist_is_flagged():
    x = np.tile(np.arange(90) * GRID, (90, 1))
    path, envelope = sampled(TerrainGrid.of(0.8 * x, grid_m=GRID))
    got = advanced_terrain_following(path, BODY, envelope, math.radians(20))
    assert got.has(WRIST_LIMIT).all()
    assert np.abs(wrist_angles(got.normal, got.azimuth_rad)).max() <= math.radians(20) + 1e-9
    assert (got.lift_m > 0.0).all()


def test_no_control_point_is_inside_the_gap_after_the_last_lift():
    for seed in range(12):
        ground = ground_of(seed)
        path, envelope = sampled(ground)
        got = clear_ground(advanced_terrain_following(path, BODY, envelope, 0.6), BODY, ground, 0.05)
        y, x = np.indices(ground.shape)
        cells = np.column_stack(
            [(x.ravel() + 0.5) * GRID, (y.ravel() + 0.5) * GRID, ground.heights_m.ravel()]
        )
        d = cKDTree(cells).query(control_points(got, BODY).reshape(-1, 3))[0].reshape(len(got), -1)
        assert d.min() >= 0.05
        near = np.isfinite(got.clearance_m)  # of the whole underside
        assert (got.clearance_m[near] <= d.min(axis=1)[near] + 1e-12).all()


def test_speeds_keep_their_limits_and_the_tip_rests_at_both_ends_only():
    limits = MotionLimits(speed_mps=0.4, acceleration_mps2=1.0, lateral_mps2=0.5)
    path = timed(lanes((0, 0, 1, 0.5), 0.1, step_m=0.005), limits)
    ds = np.linalg.norm(np.diff(path.position_m[:, :2], axis=0), axis=1)
    speed = ds / np.diff(path.t_s)
    assert speed.max() <= 0.4 + 1e-9
    assert speed.max() > 0.39
    dt = np.diff(path.t_s)
    assert (np.abs(np.diff(speed)) / (0.5 * (dt[1:] + dt[:-1]))).max() <= 1.05
    assert speed[20:-20].min() > 0.05
    assert np.flatnonzero(path.has(STOP)).tolist() == [0, len(path) - 1]


def test_a_plan_out_of_reach_is_flagged():
    ground = ground_of(8, 120, steepest=0.5)
    near = Annulus((-0.2, 0.6, 0.0), radius_max_m=0.9)
    plan = plan_scan(ground, PlanSettings((0.3, 0.3, 0.9, 0.9), 0.05, BODY, work_space=near))
    out = plan.has(OUT_OF_REACH)
    d = np.hypot(plan.position_m[:, 0] + 0.2, plan.position_m[:, 1] - 0.6)
    np.testing.assert_array_equal(out, d > 0.9)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"region": (5, 5, 6, 6)}, "beside the map"),
        ({"region": (0, 0, 0, 1)}, "positive sides"),
        ({"gap_m": 0.7}, "larger than the region"),
        ({"gap_m": float("nan")}, "finite"),
        ({"scheme": "spiral"}, "lanes, arcs"),
        ({"scheme": "arcs"}, "base"),
        ({"scheme": "arcs", "base_m": (0.5, 0.5)}, "inside the region"),
        ({"body_m": np.zeros((1, 3))}, "swath"),
        ({"body_m": np.full((2, 3), 100.0)}, "metres"),
    ],
)
def test_plans_that_cannot_be_are_refused(options, match):
    given = {"region": (0.3, 0.3, 0.9, 0.9), "gap_m": 0.05, "body_m": BODY} | options
    with pytest.raises(ScanInputError, match=match):
        plan_scan(ground_of(9, 120), PlanSettings(**given))


def test_a_region_without_known_ground_is_refused():
    ground = TerrainGrid.of(np.full((50, 50), np.nan), grid_m=0.02)
    with pytest.raises(ScanInputError, match="known"):
        plan_scan(ground, PlanSettings((0.2, 0.2, 0.8, 0.8), 0.05, BODY))


def test_bodies_and_limits_that_cannot_be_are_refused():
    for text in ("disc", "disc:-1", "disc:0.1kg", "ball:0.1", "rectangle:0.1"):
        with pytest.raises(ScanInputError):
            parse_body(text)
    assert len(parse_body("rectangle:30cmx0.2")) == 25
    with pytest.raises(ScanInputError, match="wrist"):
        WristLimits.symmetric(2.0)
    with pytest.raises(ScanInputError, match="shape"):
        WristLimits.of([1.0, 2.0])


def test_a_climb_that_is_too_fast_is_raised_and_never_lowered():
    rng = np.random.default_rng(5)
    n = 200
    path = ScanPath.planar(np.zeros((n, 2)), np.zeros(n, np.int32))
    z = rng.uniform(0.0, 0.3, n)
    z[[50, 120]] = np.nan
    position = path.position_m.copy()
    position[:, 2] = z
    path = path.changed(position_m=position, t_s=np.cumsum(rng.uniform(0.01, 0.05, n)))
    made = limited_climb(path, 0.5)
    up = made.position_m[:, 2]
    slow = np.abs(np.diff(up)) / np.diff(path.t_s)
    assert np.nanmax(slow) <= 0.5 * (1 + 1e-9)
    np.testing.assert_array_equal(np.isnan(up), np.isnan(z))
    for part in (slice(0, 50), slice(51, 120), slice(121, n)):
        t = path.t_s[part]
        least = (z[part][None, :] - 0.5 * np.abs(t[:, None] - t[None, :])).max(axis=1)
        np.testing.assert_allclose(up[part], least, atol=1e-12)
    np.testing.assert_allclose(made.lift_m, np.nan_to_num(up - z), atol=1e-12)


def test_a_shaped_plan_beside_unknown_ground_keeps_the_limit_of_climbing(tmp_path):
    rng = np.random.default_rng(3)
    z = 0.02 * rng.normal(size=(100, 120)).cumsum(axis=1).cumsum(axis=0) / 40.0
    z[:, 100:] = np.nan
    ground = TerrainGrid.of(z, grid_m=0.01)
    motion = MotionLimits(speed_mps=0.5, vertical_mps=0.3)
    settings = PlanSettings(
        (0.2, 0.2, 0.95, 0.8), 0.05, disc(0.05), motion=motion, shaper=Shaper.zvd(2.0, 0.03)
    )
    write_path(tmp_path / "path.csv", plan_scan(ground, settings))
    findings = check_path(ground.heights_m, ground.origin_m, ground.grid_m, tmp_path / "path.csv")
    assert [
        f.name for f in findings if f.name in ("climb", "clearance", "clearance_column") and not f.ok
    ] == []
