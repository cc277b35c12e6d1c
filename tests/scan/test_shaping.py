"""Shapers against responses added up and stepped oscillators; identification; motion profiles; signal map."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import naive_field as naive
from surffollow.errors import ScanInputError
from surffollow.scan import Shaper, identify_mode, jerk_limited, signal_map, trapezoid
from surffollow.scan.body import disc
from surffollow.scan.check import check_path
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.path import ScanPath
from surffollow.scan.path_file import write_path
from surffollow.scan.plan import PlanSettings, plan_scan
from surffollow.scan.shaped_motion import shaped_planar
from surffollow.scan.timing import MotionLimits, timed
from surffollow.sim.flexible_tip import Compliance, tip_deflection

KINDS = {"zv": Shaper.zv, "zvd": Shaper.zvd, "ei": Shaper.ei}


def test_zvd_amplitudes_are_those_of_the_specification():
    made = Shaper.zvd(1.0, 0.05)
    assert made.amplitudes == pytest.approx([0.2908, 0.4969, 0.2123], abs=5e-5)
    assert made.times_s == pytest.approx(np.array([0.0, 0.5, 1.0]) / math.sqrt(1 - 0.05**2))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("zeta", [0.0, 0.03, 0.2])
def test_residual_is_that_of_the_responses_added_up(kind, zeta):
    shaper = KINDS[kind](1.7, zeta)
    for f in np.linspace(0.8, 2.6, 13):
        twin = naive.impulse_residual(shaper.times_s, shaper.amplitudes, f, zeta)
        assert float(shaper.residual(f, zeta)) == pytest.approx(twin, abs=1e-9)


@pytest.mark.parametrize(("kind", "most"), [("zv", 0.32), ("zvd", 0.10), ("ei", 0.10)])
@pytest.mark.parametrize("zeta", [0.0, 0.02, 0.05])
def test_residual_within_twenty_percent_of_the_frequency(kind, most, zeta):
    shaper = KINDS[kind](2.0, zeta)
    worst = shaper.residual(2.0 * np.linspace(0.8, 1.2, 81), zeta).max()
    assert worst <= most
    if kind == "zv":
        assert worst > 0.25  # purpose of ZVD
    assert float(shaper.residual(2.0, zeta)) <= (0.051 if kind == "ei" else 1e-12)


def test_product_of_two_shapers_stills_both_modes():
    both = Shaper.zvd(1.3, 0.02) * Shaper.zv(3.1, 0.05)
    assert both.amplitudes.sum() == pytest.approx(1.0)
    assert len(both.times_s) == 6
    assert float(both.residual(1.3, 0.02)) < 1e-12
    assert float(both.residual(3.1, 0.05)) < 1e-12
    assert both.duration_s == pytest.approx(
        Shaper.zvd(1.3, 0.02).duration_s + Shaper.zv(3.1, 0.05).duration_s
    )


def test_a_shaped_motion_leaves_a_tenth_of_the_vibration_even_when_the_frequency_is_wrong():
    position, seconds = trapezoid(2.4, 0.8, 2.66)
    dt = 1e-4
    t = np.arange(0.0, seconds + 2.5, dt)
    raw = naive.stepped_mode(position(t), dt, 1.8, 0.03)[t > seconds + 1.2]
    for design in (1.8, 1.8 / 0.85):
        shaped = Shaper.zvd(design, 0.03).function(position)(t)
        left = naive.stepped_mode(shaped, dt, 1.8, 0.03)[t > seconds + 1.2]
        assert np.ptp(left) < 0.1 * np.ptp(raw)
        assert shaped[-1] == pytest.approx(2.4)


def test_a_sampled_command_is_shaped_at_shifted_times_not_at_rounded_ones():
    position, seconds = trapezoid(1.0, 0.5, 1.0)
    rate = 37.0  # half a period of the shaper is no whole number of samples
    t = np.arange(0.0, seconds + 0.1, 1.0 / rate)
    shaper = Shaper.zvd(1.9, 0.02)
    made = shaper.shape(np.column_stack([position(t), 2.0 * position(t)]), rate)
    long = np.arange(len(made)) / rate
    exact = shaper.function(position)(long)
    assert np.abs(made[:, 0] - exact).max() < 0.25 * 1.0 / rate**2  # chords of a parabola
    assert np.allclose(made[:, 1], 2.0 * made[:, 0])
    assert made[-1, 0] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("do", "message"),
    [
        (lambda: Shaper.zvd(0.2).shape(np.zeros(100), 50.0), "outside the trace"),
        (lambda: Shaper.zv(30.0).shape(np.zeros(100), 50.0), "below half"),
        (lambda: Shaper.zv(2.0).shape([0.0, math.nan] * 50, 50.0), "not finite"),
        (lambda: Shaper.zv(0.0), "frequency_hz"),
        (lambda: Shaper.zv(2.0, 1.0), "damping"),
        (lambda: Shaper.ei(2.0, tolerance=1.5), "tolerance"),
        (lambda: Shaper.zv(2.0).shape(np.zeros(0), 50.0), "outside the trace"),
    ],
)
def test_a_shaper_that_cannot_be_is_an_error(do, message):
    with pytest.raises(ScanInputError, match=message):
        do()


@pytest.mark.parametrize("seed", range(4))
def test_mode_of_a_noisy_ring_down_is_found_within_a_percent(seed):
    rng = np.random.default_rng(seed)
    f, zeta, rate = rng.uniform(0.8, 4.0), rng.uniform(0.01, 0.08), 100.0
    t = np.arange(400) / rate
    omega = 2 * math.pi * f
    x = np.exp(-zeta * omega * t) * np.cos(omega * math.sqrt(1 - zeta**2) * t + 1.0)
    mode = identify_mode(x + 0.3 + rng.normal(0, 0.03, len(t)), rate)
    assert mode.frequency_hz == pytest.approx(f, rel=0.01), seed
    assert mode.damping == pytest.approx(zeta, abs=0.01), seed
    assert mode.explained > 0.9, seed
    assert mode.amplitude == pytest.approx(1.0, rel=0.1), seed


def test_the_band_chooses_between_two_modes():
    t = np.arange(600) / 100.0
    x = np.exp(-0.3 * t) * np.sin(2 * math.pi * 1.2 * t) + 0.8 * np.exp(-0.5 * t) * np.sin(
        2 * math.pi * 4.0 * t
    )
    assert identify_mode(x, 100.0).frequency_hz == pytest.approx(1.2, rel=0.02)
    with pytest.raises(ScanInputError, match="explains"):
        identify_mode(x, 100.0, band_hz=(3.0, 5.0))  # half of the trace is something else


@pytest.mark.parametrize(
    ("trace", "band", "message"),
    [
        (np.zeros(100), None, "constant"),
        (np.ones(4), None, "at least 8"),
        (np.random.default_rng(0).normal(size=400), None, "explains"),
        (np.sin(np.arange(100.0)), (0.1, 1.0), "outside the trace"),
        (np.sin(np.arange(100.0)), (10.0, 80.0), "outside the trace"),
    ],
)
def test_a_trace_without_a_mode_is_an_error(trace, band, message):
    with pytest.raises(ScanInputError, match=message):
        identify_mode(trace, 100.0, band_hz=band)


@pytest.mark.parametrize("distance", [0.1, 2.4])
def test_motion_profiles_keep_their_limits_and_arrive(distance):
    dt = 1e-4
    for limit, (position, seconds) in (
        (None, trapezoid(distance, 0.8, 2.66)),
        (20.0, jerk_limited(distance, 0.8, 2.66, 20.0)),
    ):
        x = position(np.arange(-0.1, seconds + 0.1, dt))
        v, a = np.diff(x) / dt, np.diff(x, 2) / dt**2
        assert x[0] == 0.0
        assert x[-1] == pytest.approx(distance, abs=1e-12)
        assert v.min() > -1e-9
        assert v.max() <= 0.8 + 1e-9
        assert np.abs(a).max() <= 2.66 + 1e-4
        if limit:
            assert np.abs(np.diff(a)).max() / dt <= limit * 1.05


@pytest.mark.parametrize("seed", range(3))
def test_signal_map_is_the_statistics_of_every_cell(seed):
    rng = np.random.default_rng(seed)
    xy, v = rng.uniform(0.0, 1.0, (3000, 2)), rng.normal(size=3000)
    made = signal_map(xy, v, 0.07, region=(0.1, 0.2, 0.94, 0.83))
    mean, top, count = naive.cell_statistics(xy, v, (0.1, 0.2), 0.07, made.count.shape)
    assert np.array_equal(made.count, count)
    assert np.array_equal(made.highest, top, equal_nan=True)
    assert np.allclose(made.mean, mean, equal_nan=True, atol=1e-12)


def test_peak_is_found_between_cells():
    rng = np.random.default_rng(1)
    xy = rng.uniform(0.0, 1.0, (20000, 2))
    v = 1.0 / (1.0 + ((xy - [0.613, 0.287]) ** 2).sum(1) / 0.05**2) + rng.normal(0, 0.02, len(xy)) + 3.0
    x, y, height = signal_map(xy, v, 0.02).peak_m()
    assert math.hypot(x - 0.613, y - 0.287) < 0.005
    assert height == pytest.approx(1.0, abs=0.15)


def test_signal_map_goes_to_a_geotiff_and_back(tmp_path):
    rasterio = pytest.importorskip("rasterio", reason="extra `geo`")
    xy = np.random.default_rng(2).uniform(0.0, 1.0, (500, 2))
    made = signal_map(xy, xy[:, 0], 0.1)
    made.save_geotiff(tmp_path / "signal.tif")
    with rasterio.open(tmp_path / "signal.tif") as f:
        assert f.descriptions == ("mean", "max", "count")
        assert f.bounds.left == pytest.approx(made.origin_m[0])
        assert np.allclose(f.read(1)[::-1], np.where(made.count > 0, made.mean, -9999.0), atol=1e-6)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (([[0.0, 0.0]], [math.nan], 0.1), "finite"),
        (([[0.0, 0.0], [1e9, 0.0], [0.0, 1e9]], [1.0, 2.0, 3.0], 0.01), "metres"),
        (([[0.0, 0.0]], [1.0, 2.0], 0.1), "values"),
    ],
)
def test_a_signal_that_cannot_be_mapped_is_refused(args, message):
    with pytest.raises(ScanInputError, match=message):
        signal_map(*args)


@pytest.mark.parametrize("scheme", ["lanes", "arcs"])
def test_a_shaped_plan_leaves_no_vibration_on_its_passes_and_stays_clear(scheme, tmp_path):
    y, x = np.mgrid[0:1.0:0.01, 0:1.4:0.01]
    ground = TerrainGrid.of(0.008 * np.sin(9.0 * x) + 0.006 * np.cos(7.0 * y), grid_m=0.01)
    base = (-1.0, 0.5, 0.5)
    settings = PlanSettings(
        (0.5, 0.35, 0.9, 0.65), 0.06, disc(0.05), scheme=scheme, base_m=base, shaper=Shaper.zvd(2.0, 0.03)
    )
    left = {}
    for name, chosen in (("shaped", settings), ("unshaped", replace(settings, shaper=None))):
        path = plan_scan(ground, chosen)
        t = np.arange(0.0, path.t_s[-1], 0.005)
        tip = np.column_stack([np.interp(t, path.t_s, c) for c in path.position_m.T])
        on = np.interp(t, path.t_s, path.passes >= 0) > 0.99
        moved = tip_deflection(
            tip, 200.0, np.array(base), Compliance(vertical_hz=100.0, sway_rad_per_mps2=0.0)
        )
        left[name] = float(np.abs(moved[on][:, :2]).max())
        write_path(tmp_path / "path.csv", path)
        findings = check_path(ground.heights_m, ground.origin_m, ground.grid_m, tmp_path / "path.csv")
        assert [f.text for f in findings if not f.ok] == []
    assert left["unshaped"] > 5e-3
    assert left["shaped"] < 0.05 * left["unshaped"]


def test_a_shaped_motion_starts_and_ends_at_rest_where_the_path_does():
    path = ScanPath.planar(
        np.column_stack([np.linspace(0.0, 1.0, 101), np.zeros(101)]), np.zeros(101, np.int32)
    )
    path = timed(path, MotionLimits(0.5, 1.0, 1.0))
    shaper = Shaper.zvd(2.0, 0.03)
    made = shaped_planar(path, shaper, 100.0)
    x, t = made.position_m[:, 0], made.t_s
    assert (x[0], x[-1]) == (0.0, pytest.approx(1.0))
    speed, hard = np.diff(x) / 0.01, np.diff(x, 2) / 1e-4
    assert speed[0] < 0.02
    assert speed[-1] < 0.02
    assert speed.max() <= 0.5 * 1.001
    assert np.abs(hard).max() < 1.05
    assert t[-1] >= path.t_s[-1] + shaper.duration_s
    assert made.passes[len(made) // 2] == 0
