"""`surffollow scan` on files: depth images to a map, a plan, a check; what is refused; no half files."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import warnings

import numpy as np
import pytest
from click.testing import CliRunner

import naive_scan as naive
from running_service import run_command
from surffollow.cli.main import cli
from surffollow.cli.scan import scan_group
from surffollow.errors import ScanFileError, SurffollowError
from surffollow.map import HeightMap
from surffollow.scan.camera import Camera, looking_down
from surffollow.scan.cloud_files import read_cloud
from surffollow.scan.image_files import read_images

CAMERAS = """
[default]
fx_px = 150.0
fy_px = 150.0
cx_px = 79.5
cy_px = 59.5
baseline_m = 0.12
"""


def hill(x, y):
    return 0.12 * np.exp(-((x - 0.1) ** 2 + y**2) / 0.08)


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    """Two noisy disparity images of a hill, their cameras, and the folder that they are in."""
    folder = tmp_path_factory.mktemp("survey")
    rng = np.random.default_rng(1)
    text = CAMERAS
    for k, x in enumerate((-0.3, 0.4)):
        pose = looking_down(x, 0.0, 1.5, tilt_rad=0.1)
        camera = Camera(150.0, 150.0, 79.5, 59.5, pose, baseline_m=0.12)
        depth = naive.render_depth(hill, camera, (120, 160), far=3.0, steps=300)
        q = camera.disparity_px(depth) + rng.normal(0, 0.05, depth.shape)
        np.savez(folder / f"view{k}.npz", disparity_px=q)
        text += f'[images."view{k}.npz"]\nground_from_camera = {pose.tolist()}\n'
    (folder / "cameras.toml").write_text(text)
    return folder


def run(*arguments):
    return CliRunner().invoke(scan_group, [str(a) for a in arguments])


def test_images_become_a_map_a_plan_and_an_accepted_check(survey, tmp_path):
    ground, path = tmp_path / "ground.npz", tmp_path / "path.csv"
    images = [survey / "view0.npz", survey / "view1.npz"]
    made = run("map", *images, "--cameras", survey / "cameras.toml", "--grid", "1cm", "-o", ground, "--json")
    assert made.exit_code == 0, made.output
    report = json.loads(made.output)
    assert [i["patches"]["kept"] for i in report["images"]] == [1, 1]
    m = HeightMap.load(ground)
    x = m.origin_m[0] + (np.arange(m.shape[1]) + 0.5) * m.grid_m
    y = m.origin_m[1] + (np.arange(m.shape[0]) + 0.5) * m.grid_m
    error = m.heights_m - hill(x[None], y[:, None])
    assert np.sqrt(np.nanmean(error**2)) < 0.004
    picture = tmp_path / "plan.png"
    arguments = ["--region=-0.3,-0.2,0.4,0.2", "--gap", "5cm", "--body", "disc:0.05", "-o", path]
    planned = run("plan", ground, *arguments, "--picture", picture, "--json")
    assert planned.exit_code == 0, planned.output
    assert json.loads(planned.output)["clearance_min_m"] >= 0.05
    assert picture.read_bytes()[:4] == b"\x89PNG"
    checked = run("check", ground, path, "--json")
    assert checked.exit_code == 0, checked.output
    assert json.loads(checked.output)["accepted"]


def test_check_ends_with_1_over_other_ground(survey, tmp_path):
    low, high = np.zeros((160, 160)), np.full((160, 160), 0.03)
    for name, z in (("low", low), ("high", high)):
        HeightMap.from_heights(z, origin_m=(-0.4, -0.4), grid_m=0.01).save(tmp_path / f"{name}.npz")
    path = tmp_path / "p.csv"
    made = run("plan", tmp_path / "low.npz", "--region", "0.2,0.2,0.6,0.6", "--gap", "0.05", "-o", path)
    assert made.exit_code == 0, made.output
    assert run("check", tmp_path / "low.npz", path).exit_code == 0
    got = run("check", tmp_path / "high.npz", path)
    assert got.exit_code == 1
    assert "FAIL  clearance" in got.output


def test_the_live_map_of_a_service_is_planned_over_and_checked(service, tmp_path):
    from surffollow.client import attach

    with attach(service.name) as client:
        z = 0.02 * np.sin(np.arange(100) / 9.0)[None, :] * np.ones((100, 1))
        HeightMap.from_heights(z, origin_m=(0.0, 0.0), grid_m=0.01).save(tmp_path / "prior.npz")
        client.map_install(str(tmp_path / "prior.npz"), timeout_s=30)
    path = tmp_path / "live.csv"
    arguments = ["--live", service.name, "--region", "0.3,0.3,0.7,0.7", "--gap", "0.05", "-o", path]
    made = run("plan", *arguments)
    assert made.exit_code == 0, made.output
    assert run("check", path, "--live", service.name).exit_code == 0


def test_a_plan_over_filled_holes_says_that_the_check_needs_the_filled_map(tmp_path):
    # GIVEN a map with a hole amid the region
    z = np.zeros((100, 100))
    z[48:52, 48:52] = np.nan
    ground, path, filled = tmp_path / "ground.npz", tmp_path / "path.csv", tmp_path / "filled.npz"
    HeightMap.from_heights(z, origin_m=(0.0, 0.0), grid_m=0.01).save(ground)
    words = ["--region", "0.3,0.3,0.7,0.7", "--gap", "0.05", "-o", path]
    # WHEN it is filled for the plan alone, THEN a note names the command that writes it
    made = run("plan", ground, *words, "--fill", "5cm")
    assert made.exit_code == 0, made.output
    assert f"surffollow map fill {ground} --width 0.05 -o FILLED.npz" in made.output
    assert run("check", ground, path).exit_code == 1
    # WHEN that is followed, THEN the check accepts the path
    done = CliRunner().invoke(cli, ["map", "fill", str(ground), "--width", "0.05", "-o", str(filled)])
    assert done.exit_code == 0, done.output
    made = run("plan", filled, *words, "--fill", "5cm")
    assert "note" not in made.output
    assert run("check", filled, path).exit_code == 0


def message(*arguments):
    """The one line that the command line ends with."""
    got = run(*arguments)
    assert got.exit_code != 0
    return str(got.exception) if isinstance(got.exception, SurffollowError) else got.output


def test_what_cannot_be_is_said_and_leaves_no_file(survey, tmp_path):
    view, cameras, out = survey / "view0.npz", survey / "cameras.toml", tmp_path / "g.npz"
    assert "has no camera" in message("map", view, "-o", out)
    other = tmp_path / "other.npz"
    np.savez(other, depth_m=np.full((5, 5), 1.0))
    assert "has no camera" in message("map", other, "--cameras", cameras, "-o", out)
    bare = tmp_path / "bare.toml"
    bare.write_text(CAMERAS + '[images."view0.npz"]\n')
    assert "has no pose" in message("map", view, "--cameras", bare, "-o", out)
    bare.write_text(CAMERAS + '[images."view0.npz"]\nfocal = 3\n')
    assert "unknown keys focal" in message("map", view, "--cameras", bare, "-o", out)
    np.savez(other, depth_m=np.full((120, 160), 1500.0))
    bare.write_text(cameras.read_text().replace("view0.npz", "other.npz"))
    assert "millimetres" in message("map", other, "--cameras", bare, "-o", out)
    assert not out.exists()
    ground = tmp_path / "flat.npz"
    HeightMap.from_heights(np.zeros((40, 40)), origin_m=(0, 0), grid_m=0.01).save(ground)
    path = tmp_path / "p.csv"
    plan = ["plan", ground, "-o", path, "--gap", "0.05"]
    assert "beside the map" in message(*plan, "--region", "5,5,6,6")
    assert "expected 4" in message(*plan, "--region", "5,5,6")
    assert "unknown body" in message(*plan, "--body", "cube:1")
    assert "base" in message(*plan, "--scheme", "arcs")
    assert "give a MAP file or --live" in message("plan", "-o", path, "--gap", "0.05")
    assert not path.exists()


def test_a_grid_in_another_unit_makes_no_map(survey, tmp_path):
    image, cameras = survey / "view0.npz", survey / "cameras.toml"
    made = run("map", image, "--cameras", cameras, "--grid", "5", "-o", tmp_path / "x.npz")
    assert isinstance(made.exception, SurffollowError)
    assert "is the unit metres?" in str(made.exception)
    assert not list(tmp_path.iterdir())


def test_a_damaged_image_is_refused_wherever_the_damage_is(survey, tmp_path):
    # GIVEN a compressed image, WHEN any part of it is damaged
    image = tmp_path / "view0.npz"
    np.savez_compressed(image, depth_m=np.linspace(1.0, 2.0, 600).reshape(20, 30))
    sound = image.read_bytes()
    refused = 0
    for at in range(0, len(sound), 7):
        image.write_bytes(sound[:at] + bytes(b ^ 0x5A for b in sound[at : at + 3]) + sound[at + 3 :])
        # THEN it is refused in words, or read
        try:
            read_images([image], survey / "cameras.toml")
        except ScanFileError as error:
            refused += str(image) in str(error)
    assert refused > 100
    # AND NumPy's advice to load foreign bytes unsafely is not passed on
    image.write_bytes(bytes(range(128, 256)))
    with pytest.raises(ScanFileError, match=r"it is damaged, or no NPZ file of numbers; write it again$"):
        read_images([image], survey / "cameras.toml")
    # AND the command ends with an error that is one JSON object
    middle = len(sound) // 2
    image.write_bytes(sound[:middle] + b"damaged" + sound[middle + 7 :])
    words = ["scan", "map", image, "--cameras", survey / "cameras.toml", "-o", tmp_path / "g.npz", "--json"]
    done = CliRunner().invoke(cli, [str(w) for w in words])
    assert json.loads(done.stdout) == {
        "error": str(done.exception),
        "kind": "ScanFileError",
        "exit_code": 1,
    }
    assert "it is damaged" in str(done.exception)


@pytest.mark.parametrize("values", [np.ones((4, 4), complex), np.full((4, 4), "1.0"), np.zeros(4, "f8,f8")])
def test_an_image_of_other_than_real_numbers_is_refused_without_a_warning(survey, tmp_path, values):
    np.savez(tmp_path / "view0.npz", depth_m=values)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ScanFileError, match=r"depth_m of .* expected real numbers"):
            read_images([tmp_path / "view0.npz"], survey / "cameras.toml")


def test_an_interrupt_leaves_the_old_map(survey, tmp_path):
    out = tmp_path / "g.npz"
    out.write_bytes(b"old")
    code = (
        "import sys, surffollow.scan.surveying as s\n"
        "def stop(*_, **__): raise KeyboardInterrupt\n"
        "s.terrain_map = stop\n"
        "from surffollow.cli.main import main\nmain(sys.argv[1:])"
    )
    arguments = ["scan", "map", survey / "view0.npz", "--cameras", survey / "cameras.toml", "-o", out]
    got = subprocess.run([sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True)
    assert got.returncode in (1, 130)
    assert "Traceback" not in got.stderr
    assert out.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [out]


def test_clouds_are_read_from_ply_and_las(tmp_path):
    points = np.random.default_rng(2).uniform(-5, 5, (50, 3))
    head = "ply\nformat {}\nelement vertex 50\nproperty {} x\nproperty {} y\nproperty {} z\nend_header\n"
    text = tmp_path / "a.ply"
    rows = "\n".join(" ".join(map(repr, row)) for row in points.tolist())
    text.write_text(head.format("ascii 1.0", *["double"] * 3) + rows + "\n")
    np.testing.assert_allclose(read_cloud(text), points)
    binary = tmp_path / "b.ply"
    head_bytes = head.format("binary_little_endian 1.0", *["float"] * 3).encode()
    binary.write_bytes(head_bytes + points.astype("<f4").tobytes())
    np.testing.assert_allclose(read_cloud(binary), points, atol=1e-6)
    las = tmp_path / "c.las"
    header = bytearray(227)
    header[:4], header[24], header[25] = b"LASF", 1, 2
    struct.pack_into("<HI", header, 94, 227, 227)
    struct.pack_into("<BHI", header, 104, 0, 20, 50)
    struct.pack_into("<6d", header, 131, 0.001, 0.001, 0.001, 100.0, 200.0, 0.0)
    quanta = np.round((points - (100.0, 200.0, 0.0)) / 0.001).astype("<i4")
    body = b"".join(row.tobytes() + bytes(8) for row in quanta)
    las.write_bytes(bytes(header) + body)
    np.testing.assert_allclose(read_cloud(las), points, atol=6e-4)
    for damaged in (las.read_bytes()[:400], b"LASF", b"ply\n"):
        for suffix in (".las", ".ply"):
            bad = tmp_path / f"bad{suffix}"
            bad.write_bytes(damaged)
            with pytest.raises(ScanFileError):
                read_cloud(bad)
    assert run("map", text, "--grid", "0.5", "-o", tmp_path / "m.npz").exit_code == 0


@pytest.mark.parametrize("verb", ["map", "plan", "check", "calibrate", "compose", "run"])
def test_a_pipe_is_refused_as_an_input(verb, tmp_path):
    pipe = tmp_path / "pipe.npz"
    os.mkfifo(pipe)
    output = [] if verb in ("check", "run") else ["-o", tmp_path / "made.npz"]
    more = {"plan": ["--gap", "5cm"], "check": [pipe], "run": ["--yes", "--wait", "0"]}.get(verb, [])
    words = ["scan", verb, pipe, *more, *output]
    done = run_command([sys.executable, "-m", "surffollow", *map(str, words)])
    assert done.returncode == 1
    assert "no plain file" in done.stderr


def test_a_pipe_is_refused_as_the_map_of_a_station(tmp_path):
    os.mkfifo(tmp_path / "pipe.npz")
    (tmp_path / "stations.toml").write_text('[stations."pipe.npz"]\nx_m = 0.0\ny_m = 0.0\n')
    words = ["scan", "compose", tmp_path / "stations.toml", "-o", tmp_path / "made.npz"]
    done = run_command([sys.executable, "-m", "surffollow", *map(str, words)])
    assert done.returncode == 1
    assert "no plain file" in done.stderr


def test_no_command_writes_over_what_it_reads(survey, tmp_path):
    ground, spots = tmp_path / "ground.npz", tmp_path / "spots.csv"
    images = [survey / "view0.npz", survey / "view1.npz"]
    cameras = ["--cameras", survey / "cameras.toml", "--grid", "1cm"]
    assert run("map", *images, *cameras, "-o", ground).exit_code == 0
    spots.write_text("x_m,y_m,correction_m\n0,0,0.01\n1,0,0.01\n0,1,0.01\n1,1,0.01\n")
    stations = tmp_path / "stations.toml"
    stations.write_text('[stations."ground.npz"]\nx_m = 0.0\ny_m = 0.0\n')
    other = tmp_path / "other.npz"
    other.symlink_to(ground)
    plan = ["plan", ground, "--gap", "5cm", "--region=-0.1,-0.1,0.1,0.1"]
    kept = [*images, survey / "cameras.toml", ground, spots, stations]
    before = [f.read_bytes() for f in kept]
    for words in (
        ["map", *images, *cameras, "-o", images[1]],
        ["map", *images, *cameras, "-o", survey / "cameras.toml"],
        [*plan, "-o", ground],
        [*plan, "-o", other],
        ["calibrate", spots, "-o", spots],
        ["compose", stations, "-o", ground],
        ["compose", stations, "-o", stations],
    ):
        done = run(*words)
        assert done.exit_code == 2, (words, done.output)
        assert "choose another name" in done.output
    assert [f.read_bytes() for f in kept] == before


def test_what_an_image_file_says_of_itself_counts(survey, tmp_path):
    """Cameras of a stereo pair say `kind = "disparity"` for all; one image comes as depths."""
    q = np.load(survey / "view0.npz")["disparity_px"]
    np.savez(tmp_path / "view0.npz", depth_m=150.0 * 0.12 / q)
    text = (survey / "cameras.toml").read_text()
    (tmp_path / "cameras.toml").write_text(text.replace("[default]", '[default]\nkind = "disparity"'))
    maps = []
    for folder in (survey, tmp_path):
        file = tmp_path / f"{folder.name}.npz"
        done = run(
            *("map", folder / "view0.npz", "--cameras", folder / "cameras.toml", "--filter", "none"),
            *("--grid", "1cm", "-o", file),
        )
        assert done.exit_code == 0, done.output
        maps.append(HeightMap.load(file))
    np.testing.assert_allclose(maps[1].heights_m, maps[0].heights_m, atol=1e-9)
    own = text.replace('[images."view0.npz"]', '[images."view0.npz"]\nkind = "disparity"')
    (tmp_path / "cameras.toml").write_text(own)
    done = run(
        "map", tmp_path / "view0.npz", "--cameras", tmp_path / "cameras.toml", "-o", tmp_path / "x.npz"
    )
    assert isinstance(done.exception, ScanFileError)
    assert "holds a depth image" in str(done.exception)


def test_spots_in_millimetres_are_refused(tmp_path):
    spots = tmp_path / "spots.csv"
    spots.write_text("x_m,y_m,correction_m\n0,0,0.01\n1000,0,0.01\n0,1000,0.01\n1000,1000,0.02\n")
    done = run("calibrate", spots, "-o", tmp_path / "arm.json")
    assert isinstance(done.exception, SurffollowError)
    assert "in metres?" in str(done.exception)
