"""Left-out spots, location of a source, and composition of stations."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from surffollow.cli.scan import scan_group
from surffollow.errors import ScanInputError
from surffollow.map import HeightMap
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.held_out import GAIN, MODELS, choose_matrix, choose_polar
from surffollow.scan.polar import PolarCorrection
from surffollow.scan.sources import locate_source
from surffollow.scan.stations import overlaps, read_stations


def spots(rng, correction, sigma_m=1e-3):
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(1.1, 2.1, 5), np.linspace(-0.8, 0.8, 5)))
    return np.column_stack([x, y, correction(x, y) + rng.normal(0.0, sigma_m, len(x))])


@pytest.mark.parametrize(
    ("correction", "model"),
    [
        (lambda x, y: 0.0 * x, "none"),
        (lambda x, y: 0.0 * x + 0.004, "constant"),
        (lambda x, y: 0.01 * (x - 1.5) + 0.006 * y, "plane"),
        (lambda x, y: 0.06 * (x - 1.6) ** 2 + 0.04 * y * y, "triangles"),
    ],
)
def test_the_simplest_model_that_left_out_spots_confirm_is_taken(correction, model):
    taken = []
    for seed in range(12):
        given = spots(np.random.default_rng(seed), correction)
        chosen = choose_matrix(given)
        taken.append(chosen.model)
        error = chosen.matrix.at(given[:, :2]) - correction(given[:, 0], given[:, 1])
        if chosen.model in ("none", "constant"):
            assert np.ptp(chosen.matrix.values_m) < 1e-12
        if chosen.model == model != "triangles":
            assert np.sqrt((error**2).mean()) < 1e-3
    assert taken.count(model) >= 10, taken


def test_held_out_residuals_are_those_of_fits_without_the_spot():
    given = spots(np.random.default_rng(3), lambda x, y: 0.01 * x - 0.004 * y)
    chosen = choose_matrix(given, model="plane")
    slow = []
    for k in range(len(given)):
        rest = np.delete(given, k, axis=0)
        basis = np.column_stack([np.ones(len(rest)), rest[:, :2]])
        a = np.linalg.lstsq(basis, rest[:, 2], rcond=None)[0]
        slow.append(given[k, 2] - (a[0] + a[1] * given[k, 0] + a[2] * given[k, 1]))
    assert chosen.matrix.left_out_m == pytest.approx(slow, abs=1e-12)
    assert list(chosen.held_out_rms_m) == list(MODELS)


def test_a_noisy_calibration_is_never_worse_on_the_ground_than_the_spots_say():
    """Over many seeds the choice is better than the triangles where nothing is to be corrected."""
    none, full = [], []
    for seed in range(20):
        given = spots(np.random.default_rng(seed), lambda x, y: 0.0 * x, 2e-3)
        none.append(np.abs(choose_matrix(given).matrix.values_m).max())
        full.append(np.abs(choose_matrix(given, model="triangles").matrix.values_m).max())
    assert np.mean(none) < 0.3 * np.mean(full)


def test_polar_corrections_need_the_spots_too():
    rng = np.random.default_rng(5)
    measured = spots(rng, lambda x, y: 0.0 * x)[:, :2]
    truth = PolarCorrection((0.0, 0.0), 1.01, 0.01, 0.01)
    fit, rms = choose_polar(truth.apply(measured) + rng.normal(0, 5e-4, measured.shape), measured, (0.0, 0.0))
    assert fit.scale == pytest.approx(1.01, abs=2e-3)
    assert rms["polar"] < GAIN * rms["none"]
    kept, rms = choose_polar(measured + rng.normal(0, 5e-4, measured.shape), measured, (0.0, 0.0))
    assert (kept.scale, kept.offset_m, kept.offset_rad) == (1.0, 0.0, 0.0)
    assert rms["polar"] >= GAIN * rms["none"]


def test_an_unknown_model_is_refused():
    with pytest.raises(ScanInputError, match="spline"):
        choose_matrix(spots(np.random.default_rng(0), lambda x, y: x), model="spline")


def test_calibrate_says_when_nothing_is_confirmed(tmp_path):
    given = spots(np.random.default_rng(1), lambda x, y: 0.0 * x)
    rows = "\n".join(",".join(f"{v:.6f}" for v in row) for row in given)
    (tmp_path / "s.csv").write_text("x_m,y_m,correction_m\n" + rows + "\n")
    words = ["calibrate", str(tmp_path / "s.csv"), "-o", str(tmp_path / "arm.json")]
    done = CliRunner().invoke(scan_group, words)
    assert done.exit_code == 0, done.output
    assert "confirm no correction" in done.output
    (residuals,) = (line for line in done.output.splitlines() if line.startswith("held_out_rms_m"))
    assert "mm" not in residuals  # the key names metres
    assert "none 0.000637" in residuals
    saved = json.loads((tmp_path / "arm.json").read_text())
    assert not np.any(saved["values_m"])


def readings(rng, target_m, tip_m, sigma=0.01):
    square = ((tip_m - target_m) ** 2).sum(axis=1)
    return (1.0 + square / 0.1**2) ** -3 + rng.normal(0.0, sigma, len(tip_m))


def test_a_source_beside_a_steep_flank_is_placed_though_the_strongest_reading_is_elsewhere():
    grid = 0.01
    x = np.tile(np.arange(0.0, 1.2, grid), (100, 1))
    ground = TerrainGrid.of(0.3 / (1.0 + np.exp(-(x - 0.6) / 0.03)), origin_m=(0.0, -0.5), grid_m=grid)
    # a tip that keeps 0.12 m from the flank: it passes the target from the side
    px, py = (v.ravel() for v in np.meshgrid(np.linspace(0.1, 1.1, 800), np.linspace(-0.4, 0.4, 9)))
    centre = np.column_stack([px, py, 0.3 / (1.0 + np.exp(-(px + 0.08 - 0.6) / 0.03)) + 0.12])
    target = np.array([0.62, 0.05, 0.3 / (1.0 + np.exp(-0.02 / 0.03)) - 0.05])
    for seed in range(5):
        felt = readings(np.random.default_rng(seed), target, centre)
        found = locate_source(centre, felt, ground, size_m=0.1)
        assert np.hypot(*(np.array(found.place_m[:2]) - target[:2])) < 0.02, seed
        best = centre[np.argmax(felt)]
        assert np.hypot(*(best[:2] - target[:2])) > 0.03


@pytest.mark.parametrize(
    ("values", "words"),
    [([0.0] * 8, "nowhere|source"), ([0.0] * 3, "at least 5"), ([float("nan")] * 8, "at least 5")],
)
def test_readings_without_a_source_are_refused(values, words):
    ground = TerrainGrid.of(np.zeros((20, 20)), grid_m=0.05)
    place = np.column_stack([np.linspace(0.1, 0.8, len(values))] * 2 + [np.full(len(values), 0.1)])
    with pytest.raises(ScanInputError, match=words):
        locate_source(place, values, ground, size_m=0.1)


def surface(x, y):
    return 0.05 * np.sin(4.0 * x) + 0.03 * np.cos(5.0 * y)


def station_file(folder, poses, lift=0.0):
    text = ""
    for k, (x0, y0, heading) in enumerate(poses):
        c, s = np.cos(np.radians(heading)), np.sin(np.radians(heading))
        y, x = np.mgrid[-0.5:0.5:0.01, -0.5:0.5:0.01] + 0.005
        z = surface(c * x - s * y + x0, s * x + c * y + y0) + lift * k - 0.1 * k
        HeightMap.from_heights(z, origin_m=(-0.5, -0.5), grid_m=0.01).save(folder / f"s{k}.npz")
        text += f'[stations."s{k}.npz"]\nx_m = {x0}\ny_m = {y0}\nz_m = {0.1 * k}\nheading_deg = {heading}\n'
    (folder / "stations.toml").write_text(text)
    return folder / "stations.toml"


def test_maps_of_several_stations_compose_to_the_ground(tmp_path):
    file = station_file(tmp_path, [(0.0, 0.0, 0.0), (0.6, 0.1, 30.0), (0.2, 0.7, -75.0)])
    done = CliRunner().invoke(scan_group, ["compose", str(file), "-o", str(tmp_path / "all.npz"), "--json"])
    assert done.exit_code == 0, done.output
    facts = json.loads(done.output)
    assert facts["stations"] == 3
    assert len(facts["overlaps"]) == 3
    assert max(abs(o["median_m"]) for o in facts["overlaps"]) < 2e-4
    m = HeightMap.load(tmp_path / "all.npz")
    x = m.origin_m[0] + (np.arange(m.shape[1]) + 0.5) * m.grid_m
    y = m.origin_m[1] + (np.arange(m.shape[0]) + 0.5) * m.grid_m
    error = (m.heights_m - surface(x[None], y[:, None]))[m.counts > 0]
    assert len(error) > 15_000
    assert np.quantile(np.abs(error), 0.99) < 2e-3


def test_a_wrong_station_pose_shows_in_the_overlap(tmp_path):
    stations = read_stations(station_file(tmp_path, [(0.0, 0.0, 0.0), (0.5, 0.0, 10.0)], lift=0.02))
    (one,) = overlaps(stations)
    assert one["median_m"] == pytest.approx(0.02, abs=1e-3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no stations"),
        ('[stations."s0.npz"]\n', "no pose"),
        ('[stations."s0.npz"]\nx_m = 0.0\ny_m = 0.0\nyaw = 3\n', "unknown yaw"),
        ('[stations."s0.npz"]\nx_m = nan\ny_m = 0.0\n', "not finite"),
        ('[stations."s0.npz"]\ncommon_from_station = [[1, 0], [0, 1]]\n', "s0.npz"),
        ('[stations."away.npz"]\nx_m = 0.0\ny_m = 0.0\n', "away.npz"),
        ("[stations", "is not TOML"),
    ],
)
def test_stations_that_cannot_be_are_refused(tmp_path, text, words):
    station_file(tmp_path, [(0.0, 0.0, 0.0)])
    (tmp_path / "bad.toml").write_text(text)
    done = CliRunner().invoke(
        scan_group, ["compose", str(tmp_path / "bad.toml"), "-o", str(tmp_path / "m.npz")]
    )
    assert done.exit_code != 0
    assert words in str(done.exception) + done.output
    assert not (tmp_path / "m.npz").exists()
