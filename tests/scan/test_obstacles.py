"""Patches above the ground are obstacles, unless something was seen beneath them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from surffollow.cli.main import cli
from surffollow.scan.camera import Camera, looking_down
from surffollow.scan.composing import compose_stations
from surffollow.scan.grid import FILLED, MEASURED, UNKNOWN, TerrainGrid
from surffollow.scan.image_files import DepthImage
from surffollow.scan.patches import coherent_patches
from surffollow.scan.path import FILLED_BENEATH
from surffollow.scan.plan import PlanSettings, plan_scan
from surffollow.scan.surveying import SurveySettings, survey
from surffollow.scan.terrain import terrain_map

FX, SIDE = 400.0, 300
REGION = (0.2, 0.2, 0.8, 0.8)
TALL_M = 0.2


def camera_at(x=0.5, y=0.5, tilt=0.0, heading=0.0):
    pose = looking_down(x, y, 1.5, tilt_rad=tilt, heading_rad=heading)
    return Camera(FX, FX, (SIDE - 1) / 2, (SIDE - 1) / 2, pose)


def seen_from(camera, *boxes):
    """Exact depths [m] of flat ground at z = 0 with boxes (x0, y0, z0, x1, y1, z1)."""
    pose = camera.pose()
    rays, eye = camera.rays((SIDE, SIDE)) @ pose[:3, :3].T, pose[:3, 3]
    depth = -eye[2] / rays[..., 2]
    for box in boxes:
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = (np.array(box[:3]) - eye) / rays, (np.array(box[3:]) - eye) / rays
        first = np.minimum(one, other).max(axis=-1)
        hit = (first < np.maximum(one, other).min(axis=-1)) & (first > 0.0)
        depth = np.where(hit & (first < depth), first, depth)
    return DepthImage(depth, "depth", camera)


def post(side, x=0.5, y=0.55):
    return (x - side / 2, y - side / 2, 0.0, x + side / 2, y + side / 2, TALL_M)


def mapped(images, **settings):
    return survey(images, [], SurveySettings(grid_m=0.005, region=REGION, **settings))


def footprint(ground, side, x=0.5, y=0.55):
    """Heights and cells within a post, but for the cells of its rim."""
    col, row = (round((v - 0.2) / 0.005) for v in (x, y))
    half = round(side / 2 / 0.005) - 1
    part = np.s_[row - half : row + half, col - half : col + half]
    return ground.heights_m[part], ground.cells[part]


@pytest.mark.parametrize("side", [0.04, 0.1])
@pytest.mark.parametrize("views", [[{}], [{}, {"y": 0.2, "tilt": 0.25}], [{"x": 0.1}, {"x": 0.9}]])
def test_a_post_seen_from_above_stays_as_an_obstacle(side, views):
    ground, report = mapped([seen_from(camera_at(**v), post(side)) for v in views])
    heights, _ = footprint(ground, side)
    assert sum(one["patches"]["floating"] for one in report["images"]) == 0
    assert np.nanmin(heights) > 0.9 * TALL_M
    assert np.isfinite(heights).all()


def test_a_board_floats_when_the_ground_beneath_it_was_seen_by_another_view():
    board = (0.44, 0.44, 0.45, 0.56, 0.56, 0.5)
    above = seen_from(camera_at(), board)
    alone, report = mapped([above])
    assert report["images"][0]["patches"]["raised"] == 1
    assert np.nanmax(alone.heights_m) > 0.45  # nothing shows that nothing carries it
    others = [seen_from(camera_at(x=x), board) for x in (0.2, 0.8)]
    ground, report = mapped([above, *others])
    assert [one["patches"]["floating"] for one in report["images"]] == [1, 1, 1]
    assert np.nanmax(ground.heights_m) < 0.01


def test_the_ground_beside_an_obstacle_does_not_lower_it():
    ground, _ = mapped([seen_from(camera_at(), post(0.056, y=0.6))], filter="none")
    measured = ground.heights_m[ground.cells == MEASURED]
    between = (measured > 0.03) & (measured < TALL_M - 0.03)
    assert between.sum() <= 0.01 * (measured > 0.03).sum()


def test_beneath_a_patch_that_is_too_small_the_ground_stays_unknown_and_the_command_says_so(tmp_path):
    camera = camera_at()
    image = seen_from(camera, post(0.02))
    ground, report = mapped([image])
    _, cells = footprint(ground, 0.02)
    assert report["images"][0]["patches"]["raised"] == 0
    assert (cells == UNKNOWN).all()
    assert report["covered"] >= cells.size
    np.savez(tmp_path / "v.npz", depth_m=image.values)
    (tmp_path / "cameras.toml").write_text(
        f'[images."v.npz"]\nfx_px = {FX}\nfy_px = {FX}\ncx_px = {camera.cx_px}\ncy_px = {camera.cy_px}\n'
        f'kind = "depth"\nground_from_camera = {camera.pose().tolist()}\n'
    )
    words = ["scan", "map", str(tmp_path / "v.npz"), "--cameras", str(tmp_path / "cameras.toml"), "--json"]
    words += ["--region", ",".join(map(str, REGION)), "-o", str(tmp_path / "g.npz")]
    done = CliRunner().invoke(cli, words, catch_exceptions=False)
    assert json.loads(done.stdout)["covered"] == report["covered"]
    assert f"{report['covered']} cells stay unknown" in done.stderr


def test_a_speck_costs_no_ground_that_another_view_measured():
    camera = camera_at()
    speck = seen_from(camera)
    speck.values[150:154, 150:154] = 1.0
    ground, report = mapped([speck, seen_from(camera_at(x=0.45)), seen_from(camera_at(y=0.45))])
    assert report["images"][0]["patches"]["too_small"] == 1
    assert report["covered"] == 0
    assert np.isfinite(ground.heights_m).all()


def test_a_border_does_not_remove_a_whole_obstacle():
    image = seen_from(camera_at(), post(0.03))
    patches = coherent_patches(image.values, image.camera, border_px=6)
    ground, _ = mapped([image], border_px=6)
    assert patches.counts()["raised"] == 1
    assert np.nanmax(footprint(ground, 0.03)[0]) > 0.9 * TALL_M


def test_points_above_keep_wide_holes_unknown_and_narrow_ones_filled():
    x, y = np.meshgrid(np.arange(0.05, 2.0, 0.1), np.arange(0.05, 2.0, 0.1))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    wide = (np.abs(points[:, :2] - 0.55) < 0.26).all(axis=1)  # 5 by 5 cells
    narrow = (np.abs(points[:, :2] - 1.45) < 0.01).all(axis=1)  # one cell
    above = points[wide | narrow] + [0.0, 0.0, 1.0]
    ground = terrain_map(points[~wide & ~narrow], 0.1, region=(0, 0, 2, 2), above_m=above)
    assert (ground.cells[3:8, 4:7] == UNKNOWN).all()
    assert ground.cells[14, 14] == FILLED
    low = terrain_map(points[~wide & ~narrow], 0.1, region=(0, 0, 2, 2), above_m=above - [0.0, 0.0, 0.95])
    assert (low.cells[3:8, 3:8] == FILLED).all()  # no higher than a cell above: it is the ground itself


def test_composed_maps_keep_what_a_station_left_unknown():
    heights = np.zeros((20, 20))
    heights[8:13, 8:13] = np.nan
    holed = TerrainGrid.of(heights, grid_m=0.1)
    assert (compose_stations([(holed, np.eye(4))], 0.1).cells[8:13, 9:12] == UNKNOWN).all()
    whole = TerrainGrid.of(np.zeros((20, 20)), grid_m=0.1)
    assert (compose_stations([(holed, np.eye(4)), (whole, np.eye(4))], 0.1).cells == MEASURED).all()


def test_filled_ground_beneath_any_part_of_the_tool_is_flagged():
    cells = np.full((40, 40), MEASURED, np.uint8)
    cells[:, 24:26] = FILLED
    ground = TerrainGrid.of(np.zeros((40, 40)), grid_m=0.02, cells=cells)
    body = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]])
    plan = plan_scan(ground, PlanSettings(region=(0.2, 0.3, 0.6, 0.5), gap_m=0.05, body_m=body, swath_m=0.1))
    flagged = plan.has(FILLED_BENEATH)
    x = plan.position_m[:, 0]
    parts = plan.position_m[:, None] + 0.1 * np.array([-1, 0, 1])[None, :, None] * [1.0, 0.0, 0.0]
    level = plan.lift_m == 0.0
    beneath = ((parts[..., 0] > 0.481) & (parts[..., 0] < 0.519)).any(axis=1)
    assert flagged[level & beneath & (np.abs(plan.azimuth_rad) < 1e-9)].all()
    assert flagged.any()
    assert not flagged[x < 0.37].any()
