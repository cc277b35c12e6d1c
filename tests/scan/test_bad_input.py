"""The issue's list of bad input, one by one: a clear error or a flagged part of the path."""

from __future__ import annotations

import os
import re

import numpy as np
import pytest

from surffollow.errors import ScanFileError, ScanInputError
from surffollow.scan.arm import Arm
from surffollow.scan.body import disc
from surffollow.scan.calibration import CalibrationMatrix
from surffollow.scan.camera import Camera, looking_down
from surffollow.scan.check_file import read_rows
from surffollow.scan.cloud_files import read_cloud
from surffollow.scan.deviation import planar_deviation
from surffollow.scan.envelope import ball_envelope
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.image_files import DepthImage, read_images
from surffollow.scan.limits import Annulus, WristLimits
from surffollow.scan.modes import identify_mode
from surffollow.scan.patches import coherent_patches
from surffollow.scan.path import OUT_OF_REACH, UNKNOWN_BENEATH, WRIST_LIMIT
from surffollow.scan.path_file import read_path
from surffollow.scan.plan import PlanSettings, plan_scan
from surffollow.scan.planar_filter import conditional_planar_filter
from surffollow.scan.polar import PolarCorrection
from surffollow.scan.shaping import Shaper
from surffollow.scan.signals import signal_map
from surffollow.scan.spot_files import read_spots
from surffollow.scan.stations import read_stations
from surffollow.scan.surveying import SurveySettings, survey
from surffollow.scan.terrain import terrain_map

CAMERA = Camera(150.0, 150.0, 4.5, 4.5, looking_down(0.0, 0.0, 1.5), baseline_m=0.12, max_range_m=10.0)
FLAT = TerrainGrid.of(np.zeros((80, 80)), grid_m=0.01)
NAN, INF = float("nan"), float("inf")


def settings(**change):
    error = {"region": (0.2, 0.2, 0.6, 0.6), "gap_m": 0.05, "body_m": disc(0.05)} | change
    return PlanSettings(**error)


def survey_of(depth_m, camera=CAMERA):
    return survey([DepthImage(np.asarray(depth_m, float), "depth", camera)], [], SurveySettings(grid_m=0.01))


def ring(frequency_hz, rate_hz=100.0):
    t = np.arange(0.0, 4.0, 1.0 / rate_hz)
    return np.exp(-0.3 * t) * np.cos(2.0 * np.pi * frequency_hz * t)


@pytest.mark.parametrize(
    ("name", "call", "words"),
    [
        ("an empty image", lambda: coherent_patches(np.empty((0, 0)), CAMERA), "0"),
        ("an empty image to filter", lambda: conditional_planar_filter(np.empty((0, 5)), CAMERA), "0"),
        ("an empty image's deviation", lambda: planar_deviation(np.empty((0, 0))), "0"),
        ("an image of no depth", lambda: survey_of(np.full((20, 20), NAN)), "no|none"),
        ("an image of infinite depth", lambda: survey_of(np.full((20, 20), INF)), "no|none"),
        ("depths in millimetres", lambda: survey_of(np.full((20, 20), 1500.0)), "millimetres|range"),
        ("no image at all", lambda: survey([], [], SurveySettings(grid_m=0.01)), "at least one"),
        (
            "a camera without pose",
            lambda: survey_of(np.ones((20, 20)), Camera(150.0, 150.0, 4.5, 4.5)),
            "pose",
        ),
        (
            "a pose that is no rotation",
            lambda: Camera(1.0, 1.0, 0.0, 0.0, np.ones((4, 4))),
            "0 0 0 1|rotation",
        ),
        ("points that are no numbers", lambda: terrain_map(np.full((9, 3), NAN), 0.01), "finite"),
        ("a cell of no size", lambda: terrain_map(np.zeros((9, 3)), 0.0), "grid_m"),
        ("infinite heights", lambda: TerrainGrid.of(np.full((3, 3), INF), grid_m=0.1), "infinite"),
        ("a gap that is no length", lambda: ball_envelope(np.zeros((9, 9)), 0.01, NAN), "gap_m"),
        ("a negative gap", lambda: plan_scan(FLAT, settings(gap_m=-0.05)), "gap_m"),
        ("a gap in millimetres", lambda: plan_scan(FLAT, settings(gap_m=50.0)), "metres"),
        ("a gap larger than the region", lambda: plan_scan(FLAT, settings(gap_m=0.5)), "larger"),
        ("a region beside the map", lambda: plan_scan(FLAT, settings(region=(5.0, 5.0, 6.0, 6.0))), "beside"),
        (
            "a region that is none",
            lambda: plan_scan(FLAT, settings(region=(0.6, 0.2, 0.2, 0.6))),
            "region|x_min",
        ),
        (
            "a region with NaN",
            lambda: plan_scan(FLAT, settings(region=(0.2, NAN, 0.6, 0.6))),
            "finite|region",
        ),
        (
            "a region without data",
            lambda: plan_scan(TerrainGrid.of(np.full((80, 80), NAN), grid_m=0.01), settings()),
            "known",
        ),
        ("a scheme that is none", lambda: plan_scan(FLAT, settings(scheme="spiral")), "spiral"),
        ("arcs without a base", lambda: plan_scan(FLAT, settings(scheme="arcs")), "base"),
        ("no width between passes", lambda: plan_scan(FLAT, settings(body_m=[[0.0, 0.0, 0.0]])), "swath_m"),
        ("body points with NaN", lambda: plan_scan(FLAT, settings(body_m=[[NAN, 0.0, 0.0]])), "finite|body"),
        (
            "a mode above half the rate",
            lambda: identify_mode(ring(2.0), 100.0, band_hz=(60.0, 80.0)),
            "rate|band|Hz",
        ),
        (
            "a mode below the trace",
            lambda: identify_mode(ring(2.0)[:20], 100.0, band_hz=(0.5, 1.0)),
            "Hz|trace|short",
        ),
        ("a trace of NaN", lambda: identify_mode(np.full(400, NAN), 100.0), "finite"),
        (
            "a trace that does not ring",
            lambda: identify_mode(np.zeros(400), 100.0),
            "ring|swing|mode|peak|none|no ",
        ),
        ("a shaper above half the rate", lambda: Shaper.zvd(60.0).shape(np.ones(100), 100.0), "rate|Hz"),
        ("a shaper of no frequency", lambda: Shaper.zv(0.0), "frequency"),
        ("a shaper of infinite frequency", lambda: Shaper.ei(INF), "frequency"),
        ("damping of 1", lambda: Shaper.zv(2.0, 1.0), "damping"),
        ("no signal", lambda: signal_map(np.full((5, 3), NAN), np.ones(5), 0.01), "finite"),
    ],
    ids=lambda v: v if isinstance(v, str) and " " in v else "",
)
def test_what_cannot_be_is_refused(name, call, words):
    with pytest.raises(ScanInputError) as error:
        call()
    assert re.search(words, str(error.value)), f"{name}: {error.value}"


def test_one_pixel_is_no_terrain():
    depth = np.full((1, 1), 1.5)
    assert not coherent_patches(depth, CAMERA).terrain.any()
    with pytest.raises(ScanInputError):
        survey_of(depth)


def test_ground_that_is_unknown_in_part_is_flagged():
    z = np.zeros((80, 80))
    z[30:50, 30:50] = NAN
    plan = plan_scan(TerrainGrid.of(z, grid_m=0.01), settings())
    x, y = plan.position_m[:, 0], plan.position_m[:, 1]
    beneath = (np.abs(x - 0.4) < 0.1) & (np.abs(y - 0.4) < 0.1)
    assert beneath.any()
    assert plan.has(UNKNOWN_BENEATH)[beneath].all()
    away = (plan.passes >= 0) & (np.hypot(x - 0.4, y - 0.4) > 0.245)
    assert away.any()
    assert not plan.has(UNKNOWN_BENEATH)[away].any()


def test_an_attitude_that_the_wrist_cannot_reach_is_clamped_and_flagged():
    x = np.arange(80) * 0.01
    steep = TerrainGrid.of(np.tile(0.8 * x, (80, 1)), grid_m=0.01)
    limit = np.radians(10.0)
    plan = plan_scan(steep, settings(wrist=WristLimits.symmetric(limit)))
    on = plan.passes >= 0
    assert plan.has(WRIST_LIMIT)[on].all()
    assert np.degrees(np.arccos(plan.normal[on, 2])).max() <= 10.0 + 1e-6
    assert np.nanmin(plan.clearance_m[on]) >= 0.05 - 1e-9


def test_places_out_of_the_arms_reach_are_flagged():
    plan = plan_scan(FLAT, settings(work_space=Annulus((0.0, 0.0, 0.3), radius_max_m=0.5)))
    far = np.hypot(plan.position_m[:, 0], plan.position_m[:, 1]) > 0.55
    near = np.hypot(plan.position_m[:, 0], plan.position_m[:, 1]) < 0.4
    assert plan.has(OUT_OF_REACH)[far].all()
    assert not plan.has(OUT_OF_REACH)[near].any()


def test_an_arm_says_which_places_it_cannot_reach():
    joints = Arm().inverse(np.array([[1.5, 0.0, 0.2], [9.0, 0.0, 0.2]]), np.tile([0.0, 0.0, 1.0], (2, 1)))
    assert np.isfinite(joints[0]).all()
    assert np.isnan(joints[1]).any()


T_S = np.arange(500) / 100.0


@pytest.mark.parametrize("trace", [T_S, np.exp(-T_S), 1.0 - np.exp(-2.0 * T_S)])
def test_a_trace_that_drifts_or_decays_has_no_mode(trace):
    with pytest.raises(ScanInputError, match="without swinging"):
        identify_mode(trace, 100.0)


@pytest.mark.parametrize(
    ("commanded", "measured"),
    [
        ([[1.0, 0.0], [2.0, 0.5], [1.5, -0.5]], [[1000.0, 0.0], [2000.0, 500.0], [1500.0, -500.0]]),
        ([[1.0, 0.0], [2.0, 0.0]], [[2.0, 0.0], [1.0, 0.0]]),
    ],
)
def test_spots_in_another_unit_or_order_make_no_polar_correction(commanded, measured):
    with pytest.raises(ScanInputError, match="metres"):
        PolarCorrection.fit(commanded, measured, (0.0, 0.0))


@pytest.mark.parametrize(("side_m", "grid_m"), [(1.0, 1e-6), (5000.0, 0.1)])
def test_a_matrix_of_too_many_nodes_is_refused(side_m, grid_m):
    spots = [[0.0, 0.0, 0.005], [side_m, 0.0, 0.006], [0.0, side_m, 0.01]]
    with pytest.raises(ScanInputError, match="nodes; at most"):
        CalibrationMatrix.fit(spots, grid_m=grid_m)


@pytest.mark.parametrize(
    "head",
    [
        "ply\nformat ascii 1.0\nelement\nend_header\n",
        "ply\nend_header",
        "ply\nformat ascii 1.0\nelement vertex x\nproperty float x\nend_header\n",
        "ply\nformat\nelement vertex 3\nproperty float\nend_header\n",
        *(
            f"ply\nformat {layout} 1.0\nelement vertex {count}\nproperty float x\nproperty float y\n"
            "property float z\nend_header\n"
            for layout in ("ascii", "binary_little_endian")
            for count in (-1, 10**30)
        ),
    ],
)
def test_a_damaged_header_of_a_cloud_is_reported(head, tmp_path):
    cloud = tmp_path / "a.ply"
    cloud.write_text(head)
    with pytest.raises(ScanFileError, match="is damaged"):
        read_cloud(cloud)


@pytest.mark.parametrize("read", [read_cloud, read_spots, read_stations, CalibrationMatrix.load])
def test_a_pipe_is_no_file(read, tmp_path):
    pipe = tmp_path / "a.ply"
    os.mkfifo(pipe)
    with pytest.raises(ScanFileError, match="no plain file"):
        read(pipe)


@pytest.mark.parametrize(
    ("read", "before"),
    [(read_path, "# x = "), (read_rows, "# x = "), (CalibrationMatrix.load, "")],
)
def test_json_that_is_nested_too_deeply_is_refused(read, before, tmp_path):
    (tmp_path / "a").write_text(before + "[" * 100_000 + "\nt_s\n")
    with pytest.raises(ScanFileError, match=r"no JSON|cannot read"):
        read(tmp_path / "a")


def test_the_map_of_a_station_is_no_pipe(tmp_path):
    os.mkfifo(tmp_path / "a.npz")
    (tmp_path / "s.toml").write_text('[stations."a.npz"]\nx_m = 0.0\ny_m = 0.0\n')
    with pytest.raises(ScanFileError, match="no plain file"):
        read_stations(tmp_path / "s.toml")


@pytest.mark.parametrize(("text", "says"), [
    ("\ufeff# from Notepad\n", "has no "),
    ("a = " + 5000 * "[", "is not TOML: its values are nested too deeply"),
    ("a = ]", "is not TOML: Invalid value"),
])  # fmt: skip
def test_files_of_cameras_and_stations_are_read_as_configurations_are(text, says, tmp_path):
    """GIVEN a byte order mark THEN it is no fault; GIVEN what is no TOML THEN the file is named."""
    np.savez(tmp_path / "a.npz", depth_m=np.ones((3, 3)))
    file = tmp_path / "a.toml"
    file.write_text(text, encoding="utf-8")
    for read in (read_stations, lambda cameras: read_images([tmp_path / "a.npz"], cameras)):
        with pytest.raises(ScanFileError, match=rf"(a\.toml|a\.npz) {says}"):
            read(file)


@pytest.mark.parametrize("far_m", [1.1e9, 1e308])
def test_places_beyond_those_of_a_pose_are_refused_by_name(far_m, tmp_path):
    """Sums of them are infinite: they ended in tracebacks, and in warnings of NumPy."""
    cloud, spots, stations = tmp_path / "a.ply", tmp_path / "spots.csv", tmp_path / "stations.toml"
    axes = "".join(f"property float64 {a}\n" for a in "xyz")
    cloud.write_text(f"ply\nformat ascii 1.0\nelement vertex 2\n{axes}end_header\n0 0 0\n0 {-far_m} 0\n")
    with pytest.raises(ScanFileError, match=rf"a\.ply has a coordinate of -{far_m:g} m".replace("+", r"\+")):
        read_cloud(cloud)
    spots.write_text(f"x_m,y_m,correction_m\n0,0,0.001\n{far_m},0,0.001\n0,1,0.001\n")
    with pytest.raises(ScanInputError, match="the list of spots has a coordinate"):
        CalibrationMatrix.fit(read_spots(spots), grid_m=0.1)
    stations.write_text(f'[stations."a.npz"]\nx_m = {far_m}\ny_m = 0.0\n')
    with pytest.raises(ScanInputError, match=r"station a\.npz, has a coordinate"):
        read_stations(stations)
    matrix = np.eye(4)
    matrix[0, 3] = far_m
    with pytest.raises(ScanInputError, match="ground_from_camera has a coordinate"):
        Camera(500.0, 500.0, 20.0, 20.0, ground_from_camera=matrix)
    with pytest.raises(ScanInputError, match="none of the 2 points is finite and at most 1e"):
        terrain_map([[far_m, 0.0, 0.0], [0.0, 0.0, far_m]], 0.1)
    near = [[x, y, 0.0] for x in (0.0, 0.1, 0.2) for y in (0.0, 0.1, 0.2)]
    assert terrain_map([*near, [far_m, 0.0, 0.0]], 0.1).shape == terrain_map(near, 0.1).shape
