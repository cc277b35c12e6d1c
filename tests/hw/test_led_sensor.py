"""The simulated sensor against the figures of its data sheet."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow.errors import ConfigError
from surffollow.hw.simulation.adc import COUNTS, calibration, convert, quantise
from surffollow.hw.simulation.beam import NO_HIT, cast_ray, compose
from surffollow.hw.simulation.counter_noise import hashed_normal, hashed_uniform
from surffollow.hw.simulation.led_config import ACCURACY_M, FAR_M, INCH_M, NEAR_M, RAIL_V, LedConfig, physics
from surffollow.hw.simulation.led_sensor import characteristic, output_volts, refresh_at, spot_range
from surffollow.sim.surfaces import HeightField, flat_field, ramp_field, sine_field, step_field

CLEAN = LedConfig(noise_m=0.0, nonlinearity_m=0.0)
REGION = (0.0, 0.0, 1.0, 1.0)
FLAT = flat_field(REGION)


def frame_of(field: HeightField) -> np.ndarray:
    return np.array([field.x0_m, field.y0_m, field.grid_m])


def turned(axis: tuple[float, float, float], angle_rad: float) -> list[float]:
    s = math.sin(0.5 * angle_rad)
    return [axis[0] * s, axis[1] * s, axis[2] * s, math.cos(0.5 * angle_rad)]


def sensor_at(x: float, y: float, z: float, q: list[float] | None = None) -> np.ndarray:
    return np.array([x, y, z, *(q or [0.0, 0.0, 0.0, 1.0])])


def shown_m(
    height_m: float, config: LedConfig = CLEAN, refresh: int = 0, seed: int = 1, field: HeightField = FLAT
) -> float:
    """Distance that the voltage stands for; NaN: rail."""
    sensor = sensor_at(0.5, 0.5, height_m)
    volts = output_volts(physics(config, seed), field.heights_m, frame_of(field), sensor, 0, refresh)
    return math.nan if volts == RAIL_V else NEAR_M + volts / 10.0 * (FAR_M - NEAR_M)


@pytest.mark.parametrize("inches", [2.0, 2.5, 4.0, 5.99])
def test_sensor_shows_the_distance_inside_its_window_of_2_to_6_in(inches: float) -> None:
    assert shown_m(inches * INCH_M) == pytest.approx(inches * INCH_M, abs=1e-9)


def test_beyond_6_in_and_in_contact_the_output_is_a_rail_that_no_distance_gives() -> None:
    for inches in (6.01, 9.0, 20.0, 0.0, -1.0):
        assert math.isnan(shown_m(inches * INCH_M))
    assert quantise(RAIL_V) == COUNTS - 1


@pytest.mark.parametrize("inches", [0.5, 1.0, 1.9])
def test_nearer_than_2_in_a_closer_target_reads_like_a_farther_one(inches: float) -> None:
    closer, farther = shown_m((inches - 0.2) * INCH_M), shown_m(inches * INCH_M)
    assert closer > farther >= NEAR_M
    assert farther == pytest.approx((4.0 - inches) * INCH_M, abs=1e-9)


def test_error_of_the_characteristic_stays_within_the_data_sheet_and_is_not_nothing() -> None:
    ranges = np.linspace(NEAR_M, FAR_M, 500)
    for seed in range(5):
        p = physics(LedConfig(noise_m=0.0, nonlinearity_m=ACCURACY_M), seed)
        error = np.array([characteristic(p, r) - r for r in ranges])
        assert 0.9 * ACCURACY_M < abs(error).max() <= ACCURACY_M


def test_default_error_in_all_is_better_than_the_data_sheet_and_noise_is_its_quarter_millimetre() -> None:
    refreshes = range(4000)
    heights = np.array([shown_m(4 * INCH_M, LedConfig(), k) for k in refreshes])
    assert heights.std() == pytest.approx(0.25e-3, rel=0.05)
    assert heights.std() < 0.01 * INCH_M
    assert abs(heights.mean() - 4 * INCH_M) < ACCURACY_M


def test_glitches_are_off_by_default_and_come_at_their_rate_within_their_bounds() -> None:
    quiet = LedConfig(noise_m=0.0, nonlinearity_m=0.0)
    assert {shown_m(0.1, quiet, k) for k in range(500)} == {shown_m(0.1)}
    wild = LedConfig(noise_m=0.0, nonlinearity_m=0.0, glitch_rate=0.01)
    off = np.array([shown_m(0.1, wild, k) - 0.1 for k in range(20_000)])
    hit = abs(off) > 1e-6
    assert 0.008 < hit.mean() < 0.012
    assert 0.02 < abs(off[hit]).max() <= 0.03


def test_output_is_refreshed_250_times_a_second_with_what_was_true_30_ms_before() -> None:
    p = physics(LedConfig(), 3)
    times = np.arange(10**12, 10**12 + 10**9, 40_000)
    numbers = np.array([refresh_at(p, 0, t)[0] for t in times])
    assert len(np.unique(numbers)) in (250, 251)
    assert set(np.diff(numbers)) == {0, 1}
    assert all(0 <= t - refresh_at(p, 0, t)[1] < 4_000_000 for t in times[:500])
    assert p["latency_ns"][0] == 30_000_000
    assert refresh_at(p, 0, 10**12)[1] != refresh_at(p, 1, 10**12)[1]


@pytest.mark.parametrize(
    ("degrees", "seen"), [(-11.0, False), (-9.0, True), (0.0, True), (19.0, True), (21.0, False)]
)
def test_glossy_black_is_seen_from_minus_10_to_plus_20_degrees_only(degrees: float, seen: bool) -> None:
    slope = math.tan(math.radians(degrees))
    field = ramp_field(REGION, slope_x=-slope)  # leans toward +x when positive
    sensor = sensor_at(0.5, 0.5, field.height_m(0.5, 0.5) + 0.1)
    gloss, matte = (
        output_volts(physics(LedConfig(gloss_share=share), 0), field.heights_m, frame_of(field), sensor, 0, 0)
        for share in (1.0, 0.0)
    )
    assert (gloss != RAIL_V) == seen
    assert matte != RAIL_V


@pytest.mark.parametrize(("degrees", "seen"), [(-12.0, False), (15.0, True), (25.0, False)])
def test_gloss_limits_follow_a_tilted_tool_on_level_ground(degrees: float, seen: bool) -> None:
    sensor = sensor_at(0.5, 0.5, 0.1, turned((0.0, 1.0, 0.0), -math.radians(degrees)))
    p = physics(LedConfig(gloss_share=1.0), 0)
    assert (output_volts(p, FLAT.heights_m, frame_of(FLAT), sensor, 0, 0) != RAIL_V) == seen


def test_a_share_of_gloss_hides_about_that_share_of_steep_ground() -> None:
    field = ramp_field(REGION, slope_x=0.5)
    p = physics(LedConfig(gloss_share=0.3), 0)
    spots = [(x, y) for x in np.arange(0.02, 1.0, 0.05) for y in np.arange(0.02, 1.0, 0.05)]
    hidden = [
        output_volts(p, field.heights_m, frame_of(field), sensor_at(x, y, field.height_m(x, y) + 0.1), 0, 0)
        == RAIL_V
        for x, y in spots
    ]
    assert 0.2 < np.mean(hidden) < 0.4


def test_spot_averages_over_its_hundredth_of_an_inch() -> None:
    field = step_field((0.49, 0.0, 0.51, 0.02), 0.5, 0.01, grid_m=2e-5)
    p, wide = physics(CLEAN, 0), physics(LedConfig(noise_m=0.0, footprint_m=0.004), 0)
    at_edge = sensor_at(0.5 - 3e-5, 0.01, 0.1)
    away = sensor_at(0.499, 0.01, 0.1)
    z, frame = field.heights_m, frame_of(field)
    assert 0.09 < spot_range(p, z, frame, at_edge) < 0.1
    assert spot_range(p, z, frame, away) == pytest.approx(0.1, abs=1e-12)
    assert spot_range(wide, z, frame, away) < 0.1


def test_ray_meets_a_plane_where_geometry_says_at_any_attitude() -> None:
    rng = np.random.default_rng(5)
    field = ramp_field(REGION, slope_x=0.1, slope_y=-0.2)
    normal = np.array([-0.1, 0.2, 1.0])
    for _ in range(200):
        origin = np.array([*rng.uniform(0.4, 0.6, 2), 0.0])
        origin[2] = field.height_m(origin[0], origin[1]) + rng.uniform(0.03, 0.1)
        direction = rng.normal(size=3) * [0.4, 0.4, 0.1] - [0.0, 0.0, 1.0]
        direction /= np.linalg.norm(direction)
        plane = (origin[2] - field.height_m(origin[0], origin[1])) / -(direction @ normal)
        got = cast_ray(field.heights_m, frame_of(field), tuple(origin), tuple(direction), 0.3)
        assert got == pytest.approx(plane, abs=1e-8)


def test_ray_finds_the_first_of_several_crossings() -> None:
    field = sine_field(REGION, wavelength_m=0.1, amplitude_m=0.02)
    direction = np.array([0.97, 0.0, -math.sqrt(1 - 0.97**2)])
    origin = np.array([0.2, 0.5, 0.06])
    s = np.linspace(0.0, 0.4, 400_001)
    below = origin[2] + s * direction[2] <= [field.height_m(0.2 + a * direction[0], 0.5) for a in s]
    first = s[np.argmax(below)]
    got = cast_ray(field.heights_m, frame_of(field), tuple(origin), tuple(direction), 0.4)
    assert got == pytest.approx(first, abs=2e-6)


def test_ray_that_looks_away_or_falls_short_hits_nothing() -> None:
    up, down = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
    slanted = (math.sin(1.0), 0.0, math.cos(1.0))
    for direction, height in ((up, 0.1), (slanted, 0.1), (down, 0.5)):
        assert cast_ray(FLAT.heights_m, frame_of(FLAT), (0.5, 0.5, height), direction, 0.3) == NO_HIT


def test_composing_poses_agrees_with_rotation_matrices() -> None:
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(2)
    out = np.zeros(7)
    for _ in range(50):
        a, b = (np.r_[rng.normal(size=3), Rotation.random(random_state=rng).as_quat()] for _ in range(2))
        compose(a, b, out)
        turn = Rotation.from_quat(a[3:]) * Rotation.from_quat(b[3:])
        np.testing.assert_allclose(out[:3], a[:3] + Rotation.from_quat(a[3:]).apply(b[:3]), atol=1e-12)
        np.testing.assert_allclose(Rotation.from_quat(out[3:]).as_matrix(), turn.as_matrix(), atol=1e-12)


def test_converter_has_4096_steps_over_the_window_and_saturates() -> None:
    scale_m, zero_m = calibration(NEAR_M, FAR_M)
    assert scale_m == pytest.approx(4 * INCH_M / 4096)
    volts = np.linspace(-1.0, 11.0, 200_001)
    counts = np.array([quantise(v) for v in volts])
    assert (counts.min(), counts.max()) == (0, 4095)
    assert set(np.diff(counts)) == {0, 1}
    inside = (volts >= 0.0) & (volts < 10.0)
    truth = NEAR_M + volts[inside] / 10.0 * (FAR_M - NEAR_M)
    assert abs(zero_m + scale_m * counts[inside] - truth).max() <= 0.5001 * scale_m
    assert quantise(math.nan) == 4095


def test_converters_own_noise_is_spread_as_asked() -> None:
    counts = np.array([convert(5.0, 2.0, 0, n) for n in range(20_000)])
    assert counts.std() == pytest.approx(2.02, rel=0.03)


def test_hashed_numbers_are_uniform_normal_reproducible_and_unrelated() -> None:
    u = np.array([hashed_uniform(1, 2, k) for k in range(50_000)])
    assert abs(u.mean() - 0.5) < 0.005
    assert abs(np.histogram(u, 20, (0, 1))[0] / 2500 - 1).max() < 0.1
    n = np.array([hashed_normal(1, 9, k) for k in range(50_000)])
    assert abs(n.mean()) < 0.02
    assert n.std() == pytest.approx(1.0, rel=0.02)
    assert abs(np.corrcoef(n[:-1], n[1:])[0, 1]) < 0.02
    other = np.array([hashed_uniform(1, 3, k) for k in range(50_000)])
    assert abs(np.corrcoef(u, other)[0, 1]) < 0.02
    assert hashed_uniform(1, 2, 77) == u[77]


@pytest.mark.parametrize(
    "wrong", [{"noise_m": -1.0}, {"nonlinearity_m": 0.01}, {"hold_hz": 0.0}, {"latency_s": math.nan}]
)
def test_sensor_configuration_out_of_range_is_refused_by_name(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        LedConfig(**wrong)


def naive_hash(seed: int, stream: int, index: int) -> float:
    """The same number with Python's integers."""
    bits, golden = (1 << 64) - 1, 0x9E3779B97F4A7C15
    x = 0
    for key in (seed, stream * golden, index * golden):
        x = (x + key + golden) & bits
        x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & bits
        x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & bits
        x ^= x >> 31
    return ((x >> 11) + 0.5) / (1 << 53)


def test_hashed_numbers_equal_those_of_plain_integers() -> None:
    rng = np.random.default_rng(8)
    for seed, stream, index in rng.integers(0, 1 << 62, (50, 3)).tolist():
        assert hashed_uniform(seed, stream, index) == naive_hash(seed, stream, index)
