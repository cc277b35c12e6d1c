"""Depth images: filters and patches against pixel-by-pixel twins, and what a user relies on."""

from __future__ import annotations

import math

import numpy as np
import pytest

import naive_scan as naive
from surffollow.errors import ScanInputError
from surffollow.scan.camera import Camera, looking_down
from surffollow.scan.cloud_terrain import general_slope
from surffollow.scan.deviation import planar_deviation
from surffollow.scan.image_filters import gaussian_filter, median_filter
from surffollow.scan.patch_labels import label_patches
from surffollow.scan.patches import coherent_patches
from surffollow.scan.patches_of_clouds import cloud_patches
from surffollow.scan.planar_filter import conditional_planar_filter
from surffollow.scan.planar_kernels import NO_DATA, PLANAR, ROUGH

CAMERA = Camera(300.0, 300.0, 79.5, 59.5, looking_down(0.0, 0.0, 1.5), baseline_m=0.12)


def depth_of(height_at, shape=(120, 160)):
    return naive.render_depth(height_at, CAMERA, shape, steps=300, far=3.0)


@pytest.mark.parametrize("seed", range(4))
def test_deviations_are_those_of_direct_plane_fits(seed):
    rng = np.random.default_rng(seed)
    z = 40 + rng.normal(0, 1, (17, 21))
    z[rng.random(z.shape) < (0.0, 0.1, 0.5, 0.9)[seed]] = np.nan
    mad, rms = naive.planar_deviation(z, 5)
    np.testing.assert_allclose(planar_deviation(z, window=5)[0], mad, atol=1e-9)
    np.testing.assert_allclose(
        planar_deviation(z, window=5, mode="fast")[0], rms * math.sqrt(2 / math.pi), atol=1e-6
    )


def test_fast_and_exact_deviations_agree_on_noise_and_part_on_outliers():
    rng = np.random.default_rng(1)
    z = rng.normal(0, 0.1, (80, 80))
    exact, fast = planar_deviation(z)[0], planar_deviation(z, mode="fast")[0]
    assert abs(np.mean(fast / exact) - 1) < 0.02
    z[40, 40] += 5.0
    assert planar_deviation(z, mode="fast")[0][40, 40] > 1.5 * planar_deviation(z)[0][40, 40]


def test_medians_are_those_of_the_valid_neighbours():
    rng = np.random.default_rng(2)
    z = rng.normal(0, 1, (15, 19))
    z[rng.random(z.shape) < 0.4] = np.nan
    np.testing.assert_array_equal(median_filter(z), naive.median(z))


def test_filter_smooths_flat_ground_like_a_gaussian_and_keeps_the_flank_of_a_hump():
    rng = np.random.default_rng(3)
    flank = math.tan(math.radians(70.0))
    truth = depth_of(lambda x, y: np.clip((0.2 - np.abs(y)) * flank, 0.0, 0.15))
    q = CAMERA.disparity_px(truth) + rng.normal(0, 0.1, truth.shape)
    y = CAMERA.points_m(truth)[..., 1]
    inner = np.pad(np.ones((100, 140), bool), 10)  # at the image's edge a Gaussian is biased on slopes
    flat, edge = inner & (np.abs(y) > 0.27), (np.abs(y) > 0.12) & (np.abs(y) < 0.22)

    def rms(depth, where):
        return float(np.sqrt(np.nanmean((depth - truth)[where] ** 2)))

    cpf = conditional_planar_filter(q, CAMERA, kind="disparity")
    gauss, median = (
        CAMERA.depth_m(gaussian_filter(q, sigma_px=2.25)),
        CAMERA.depth_m(median_filter(q)),
    )
    assert rms(cpf.depth_m, flat) < 1.25 * rms(gauss, flat)  # 1.04 over a large image
    assert rms(cpf.depth_m, flat) < 0.6 * rms(median, flat)
    assert rms(cpf.depth_m, edge) < 0.7 * rms(gauss, edge)
    assert (cpf.label[flat & np.isfinite(truth)] == PLANAR).mean() > 0.9
    assert (cpf.label[edge] == ROUGH).mean() > 0.3


def test_filter_keeps_a_slope_with_holes_in_place():
    rng = np.random.default_rng(4)
    true = 20 + 0.2 * np.arange(90)[None, :] + 0.1 * np.arange(70)[:, None]
    q = np.where(rng.random(true.shape) < 0.3, np.nan, true)
    q[20:30, 40:45] = np.nan
    made = conditional_planar_filter(q, CAMERA, kind="disparity")
    known = np.isfinite(q)
    assert np.abs(made.disparity_px - true)[known].max() < 0.15  # medians of windows with holes
    assert np.abs(np.nanmean((made.disparity_px - true)[known])) < 2e-3
    assert (np.isnan(made.depth_m) == ~known).all()
    assert (made.label[~known] == NO_DATA).all()


def test_strength_follows_the_curve():
    q = 20 + np.random.default_rng(5).normal(0, 0.1, (60, 60))
    off = conditional_planar_filter(q, CAMERA, kind="disparity", curve=((0.0, 0.0), (1.0, 0.0)))
    np.testing.assert_allclose(off.disparity_px, median_filter(q), atol=1e-12)
    on = conditional_planar_filter(q, CAMERA, kind="disparity", curve=((0.0, 1.0), (1.0, 1.0)))
    assert np.std(on.disparity_px) < 0.5 * np.std(off.disparity_px)
    with pytest.raises(ScanInputError, match="ascending"):
        conditional_planar_filter(q, CAMERA, kind="disparity", curve=((2.0, 1.0), (1.0, 0.0)))


def test_labels_are_those_of_growing_patch_by_patch():
    rng = np.random.default_rng(6)
    for _ in range(10):
        z = rng.normal(0, 1, (18, 23))
        z[rng.random(z.shape) < 0.2] = np.nan
        jump = rng.uniform(0, 2, z.shape)
        got = np.empty(z.shape, np.int32)
        label_patches(z, jump, np.empty(z.size, np.int32), got)
        np.testing.assert_array_equal(got, naive.labels(z, jump))


def test_patches_that_cannot_be_terrain_are_dropped_by_name():
    depth = depth_of(lambda x, y: 0.0 * x)
    depth[10:40, 10:40] -= 0.6  # a board far above the ground
    depth[60:63, 60:63] -= 0.4  # a speck
    got = coherent_patches(depth, CAMERA, min_pixels=50)
    dropped = {"too_small": 1, "overhanging": 0, "outside": 0, "floating": 1}
    assert got.counts() == {"kept": 1, **dropped, "raised": 0}
    assert got.pixel_counts()["floating"] == 900
    assert not got.terrain[10:40, 10:40].any()
    assert got.terrain[80:, 80:].all()


def test_a_step_that_the_ground_carries_does_not_float():
    depth = depth_of(lambda x, y: 0.08 * (x > 0.1))
    got = coherent_patches(depth, CAMERA, support_m=0.1, jump_px=0.5)
    assert got.counts()["kept"] >= 2
    assert got.counts()["floating"] == 0


def test_a_wall_seen_from_the_side_overhangs_and_places_beside_the_work_space_are_outside():
    side = Camera(300.0, 300.0, 79.5, 59.5, looking_down(0, 0, 1, tilt_rad=math.pi / 2), baseline_m=0.12)
    wall = np.full((120, 160), 2.0)
    assert coherent_patches(wall, side).counts()["overhanging"] == 1
    flat = np.full((120, 160), 1.5)
    got = coherent_patches(flat, CAMERA, region=(5.0, 5.0, 6.0, 6.0))
    assert got.counts()["outside"] == 1
    assert not got.terrain.any()


def test_jumps_grow_with_the_square_of_the_range():
    rows = np.full((40, 40), 1.0)
    rows[:, 20:] += 0.8 * 1.0 / (300 * 0.12)
    assert coherent_patches(rows, CAMERA, min_pixels=1).counts()["kept"] == 1
    far = np.full((40, 40), 4.0)
    far[:, 20:] += 0.8 * 16.0 / (300 * 0.12)
    assert coherent_patches(far, CAMERA, min_pixels=1, support_m=9.0).outcome.size == 1
    far[:, 20:] += 0.8 * 16.0 / (300 * 0.12)
    assert coherent_patches(far, CAMERA, min_pixels=1, support_m=9.0).outcome.size == 2


def test_pixels_beside_a_jump_can_be_left_out():
    depth = depth_of(lambda x, y: 0.3 * (x > 0.0))
    wide, narrow = (coherent_patches(depth, CAMERA, border_px=b, support_m=1.0).terrain for b in (0, 4))
    assert narrow.sum() < wide.sum()
    assert not (narrow & ~wide).any()


def test_a_roof_in_a_cloud_is_no_ground():
    rng = np.random.default_rng(7)
    p = rng.uniform(0, 60, (6000, 3))
    roof = (np.abs(p[:, 0] - 30) < 8) & (np.abs(p[:, 1] - 30) < 8)
    p[:, 2] = 0.1 * p[:, 0] + rng.normal(0, 0.05, len(p)) + np.where(roof, 6.0, 0.0)
    got = cloud_patches(p, cell_m=2.0).ground
    assert not got[roof].any()
    assert got[~roof].mean() > 0.97


@pytest.mark.parametrize("slope", [0.05, 1.2])
def test_neighbours_may_differ_as_the_cloud_itself_slopes(slope):
    rng = np.random.default_rng(7)
    p = rng.uniform(0, 60, (6000, 3))
    roof = (np.abs(p[:, 0] - 30) < 8) & (np.abs(p[:, 1] - 30) < 8)
    p[:, 2] = slope * p[:, 0] + rng.normal(0, 0.05, len(p)) + np.where(roof, 8.0, 0.0)
    own = cloud_patches(p, cell_m=2.0)
    assert own.ground[~roof].mean() > 0.9
    assert own.ground[roof].mean() < 0.1
    # a slope that is not the cloud's own breaks the hillside into pieces
    assert cloud_patches(p, cell_m=2.0, slope=0.2).ground[~roof].mean() > 0.9 or slope > 1.0
    if slope > 1.0:
        assert cloud_patches(p, cell_m=2.0, slope=0.2).ground[~roof].mean() < 0.9


def test_the_general_slope_passes_over_what_is_unknown_and_what_is_too_small():
    y, x = np.mgrid[0:6, 0:8] * 10.0
    z = 0.3 * x + 0.4 * y
    z[2, 3] += 5.0
    assert general_slope(z, 10.0) == pytest.approx(0.5, abs=1e-9)
    z[0, 0] = np.nan
    assert general_slope(z, 10.0) == pytest.approx(0.5, abs=0.02)
    assert general_slope(np.zeros((1, 5)), 10.0) == 0.0
    assert general_slope(np.full((3, 3), np.nan), 10.0) == 0.0


@pytest.mark.parametrize("values", [np.empty((0, 0)), np.empty((0, 5)), np.zeros(4)])
def test_images_without_pixels_are_refused(values):
    for call in (
        lambda: coherent_patches(values, CAMERA),
        lambda: conditional_planar_filter(values, CAMERA),
        lambda: planar_deviation(values),
    ):
        with pytest.raises(ScanInputError, match="shape"):
            call()


def test_one_pixel_and_nothing_but_holes_give_an_answer():
    for z in (np.full((1, 1), 1.5), np.full((5, 7), np.nan), np.full((5, 7), np.inf)):
        got = conditional_planar_filter(z, CAMERA)
        assert got.depth_m.shape == z.shape
        assert coherent_patches(z, CAMERA).terrain.shape == z.shape
    assert conditional_planar_filter(np.full((1, 1), 1.5), CAMERA).depth_m[0, 0] == pytest.approx(1.5)


def test_millimetres_and_cameras_without_pose_are_refused():
    with pytest.raises(ScanInputError, match="millimetres"):
        conditional_planar_filter(np.full((8, 8), 1500.0), CAMERA)
    with pytest.raises(ScanInputError, match="no pose"):
        coherent_patches(np.full((8, 8), 1.5), Camera(300, 300, 4, 4))
    with pytest.raises(ScanInputError, match="baseline"):
        conditional_planar_filter(np.full((8, 8), 9.0), Camera(300, 300, 4, 4), kind="disparity")
    with pytest.raises(ScanInputError, match="no rotation"):
        Camera(300, 300, 4, 4, np.diag([1.0, 1.0, 2.0, 1.0]))
