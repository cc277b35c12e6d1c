"""Calibrations: what they find on simulated faults, what they refuse, and that a driver uses them."""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from click.testing import CliRunner, Result

from bench_calibrate import latency_error_s, measure, range_error_m
from running_service import until
from surffollow.apps.fit_latency import fit_latency
from surffollow.apps.fit_mount import beam_of, fit_mount
from surffollow.apps.fit_range import fit_range
from surffollow.cli import range_pairs
from surffollow.cli.calibrate import calibrate_group
from surffollow.errors import ConfigError, SurffollowError
from surffollow.hw.calibrated import NOTED_RUN, CalibratedDriver, Linearizer, linearize, tables_of
from surffollow.hw.calibration import Calibration, RangeTable, load_calibration, save_calibration
from surffollow.hw.contract import check_driver
from surffollow.hw.driver import ConversionQueue, notes_of
from surffollow.hw.ranges import metre_info, pack_range
from surffollow.hw.registry import make_driver
from surffollow.hw.replayed import save_conversions
from surffollow.shm.conversion import FLAG_INVALID, conversion_counts, conversion_flags, pack_conversion
from surffollow.shm.dtypes import zeros

MS = 1_000_000
SEEDS = 20


def test_all_three_find_simulated_faults_within_their_limits() -> None:
    found = measure(SEEDS)
    assert found["range_worst_mm"] <= 0.05
    assert found["latency_worst_ms"] <= 2.0
    assert found["mount_worst_mm"] <= 0.2
    assert found["mount_worst_deg"] <= 0.1
    assert 0.6 < found["latency_rms_sigmas"] < 1.5
    assert found["mount_chi2_p"] > 1e-3, "the covariance does not hold"


def test_fewer_pairs_and_more_noise_are_worse_as_the_residuals_say() -> None:
    assert range_error_m(1, pairs=6) > range_error_m(1)
    assert latency_error_s(1, noise_m=3e-3)[0] > 0


@pytest.mark.parametrize(
    ("indicated", "true", "says"),
    [
        ([1.0, 2.0, 3.0], [0.1, 0.2, 0.3], "too few"),
        ([1.0, 2.0, 3.0, 4.0], [0.1, 0.3, 0.2, 0.4], "not monotone: 2 → 0.3 m and 3 → 0.2 m"),
        ([1.0, 2.0, 3.0, 4.0], [0.1, 0.2, 0.2, 0.4], "not monotone: 2 → 0.2 m and 3 → 0.2 m"),
        ([1.0, 2.0, 3.0, 4.0], [0.4, 0.2, 0.2, 0.1], "not monotone: 2 → 0.2 m and 3 → 0.2 m"),
        ([1.0, 2.0, math.nan, 4.0], [0.1, 0.2, 0.3, 0.4], "finite.*pair 3"),
        ([1.0, 2.0, 3.0, 4.0], [-0.1, -0.2, -0.3, -0.4], "pair 4 has the distance -0.4 m"),
    ],
)
def test_pairs_that_make_no_table_are_refused(indicated: list, true: list, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        fit_range(np.array(indicated), np.array(true))


def test_a_curve_with_a_kink_stays_monotone_where_a_spline_would_not() -> None:
    x = np.arange(8.0)
    y = np.array([0.0, 0.001, 0.002, 0.003, 0.1, 0.101, 0.102, 0.103])
    fit = fit_range(x, y)
    assert fit.method == "monotone cubic"
    assert (np.diff(fit.table.range_m) > 0).all()
    falling = fit_range(x, y[::-1])
    assert (np.diff(falling.table.range_m) < 0).all()


def test_a_move_that_cannot_tell_the_latency_is_refused() -> None:
    t = np.arange(0.0, 5.0, 0.01)
    still = np.full_like(t, 0.1) + np.random.default_rng(0).normal(0.0, 1e-4, len(t))
    with pytest.raises(ConfigError, match="does not determine the latency"):
        fit_latency(t, np.full_like(t, 0.1), t, still)
    with pytest.raises(ConfigError, match="at least 30"):
        fit_latency(t[:60], t[:60], t[:60], t[:60])
    with pytest.raises(ConfigError, match="row 500 to the next; sort"):
        fit_latency(np.append(t, 1.0), np.append(t, 0.1), t, still)


def test_a_move_with_heights_downward_or_that_repeats_itself_is_refused() -> None:
    t = np.arange(0.0, 8.0, 0.01)

    def z(at: np.ndarray, hz: float = 1.0) -> np.ndarray:
        return 0.1 + 0.01 * np.sin(2 * np.pi * hz * at)

    noise = np.random.default_rng(3).normal(0.0, 1e-4, len(t))
    assert abs(fit_latency(t, z(t), t, z(t - 0.03) + noise).latency_s - 0.03) < 1e-3
    assert abs(fit_latency(t, z(t, 1.7), t, z(t - 0.03, 1.7) + noise).latency_s - 0.03) < 1e-3
    with pytest.raises(ConfigError, match="z_m must be upward"):  # else: 0.53 s later, upward
        fit_latency(t, z(t, 1.2), t, 0.2 - z(t - 0.03, 1.2) + noise)
    with pytest.raises(ConfigError, match=r"delays of .* fit alike"):
        fit_latency(t, z(t, 4.0), t, z(t - 0.03, 4.0) + noise)


@pytest.mark.parametrize("noise_m", [0.0, 1e-4])
def test_distances_that_lead_the_heights_are_refused_with_the_lead(noise_m: float) -> None:
    t = np.arange(0.0, 8.0, 0.01)

    def z(at: np.ndarray) -> np.ndarray:
        return 0.1 + 0.01 * np.sin(2 * np.pi * 0.7 * at)

    noise = np.random.default_rng(3).normal(0.0, 1.0, len(t)) * noise_m
    with pytest.raises(ConfigError, match=r"lead the heights by (29\.|30\.).* ms.*timestamps of the heights"):
        fit_latency(t, z(t), t, z(t + 0.03) + noise)
    for lead_s in (0.0, 0.005):  # within the time between rows
        assert fit_latency(t, z(t), t, z(t + lead_s) + noise).latency_s == pytest.approx(0.0, abs=1e-3)


MOVE_T_S = np.arange(0.0, 6.0, 0.01)
RANDOM = np.random.default_rng(5)
WAVES = [(RANDOM.uniform(0.1, 2.0), *RANDOM.normal(0.0, 1.0, 2)) for _ in range(12)]


def height_m(t_s: np.ndarray) -> np.ndarray:
    return 0.1 + 0.02 * np.sin(3.0 * t_s)


def irregular_m(t_s: np.ndarray) -> np.ndarray:
    return 0.1 + 0.004 * sum(a * np.sin(2.0 * np.pi * hz * t_s + p) for hz, a, p in WAVES)


def of_unit(range_unit_m: float, height_unit_m: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    return height_m(MOVE_T_S) / height_unit_m, height_m(MOVE_T_S - 0.03) / range_unit_m


STILL_M = np.full_like(MOVE_T_S, 0.1)
JITTER_M = STILL_M + np.random.default_rng(0).normal(0.0, 1e-5, len(MOVE_T_S))
NOISY_M = STILL_M + np.random.default_rng(1).normal(0.0, 1e-4, len(MOVE_T_S))


@pytest.mark.parametrize(
    ("z_m", "range_m", "says"),
    [
        (STILL_M, STILL_M, "all z_m are 0.1 m, a move of 0 mm; move up and down by some millimetres"),
        (STILL_M, NOISY_M, r"a move of 0 mm; .* at least by (1\.\d|2\.\d)\d* mm, 20 times the noise"),
        (JITTER_M, NOISY_M, r"do not follow z_m, which moves by 0\.0\d+ mm: .* at least by"),
        (height_m(MOVE_T_S), STILL_M, "distances are 0.1 m, while z_m moves by 40 mm: the sensor is stuck"),
        (height_m(MOVE_T_S), height_m(MOVE_T_S - 0.6), "latency is beyond 500 ms.*move the distances up"),
        (irregular_m(MOVE_T_S), irregular_m(MOVE_T_S - 1.0), "follow.*that the latency is below 500 ms"),
        (*of_unit(1e-3), "range_m changes 1000 times .* range_m in mm; convert both columns to metres"),
        (*of_unit(0.0254), "range_m changes 39.37 times .* range_m in inch"),
        (*of_unit(0.3048), "range_m changes 3.281 times .* range_m in ft"),
        (*of_unit(1.0, 0.0254), "range_m changes 0.0254 times .* z_m in inch"),
        (*of_unit(0.005), "range_m changes 200 times .* scale is wrong.*calibrate range"),
        (np.where(MOVE_T_S == 3.0, np.nan, height_m(MOVE_T_S)), STILL_M, "z_m of row 301 is nan"),
    ],
)
def test_a_move_without_a_latency_is_refused_with_the_fault_and_nothing_is_written(
    tmp_path: Path, z_m: np.ndarray, range_m: np.ndarray, says: str
) -> None:
    file, out = tmp_path / "move.csv", tmp_path / "laser.json"
    rows = "".join(f"{t},{z},{r}\n" for t, z, r in zip(MOVE_T_S, z_m, range_m))
    file.write_text(f"t_s,z_m,range_m\n{rows}")
    with pytest.raises(ConfigError, match=says):  # exit code 2
        run("latency", file, "--out", out)
    assert not out.exists()


def over_a_plate(tilt_x: float, tilt_y: float, n: int, apart_m: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """Poses over a level plate, tilted at random; what a sensor at (10, 20, 0) mm reads."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(3)
    tilts = np.column_stack([rng.uniform(-tilt_x, tilt_x, n), rng.uniform(-tilt_y, tilt_y, n), np.zeros(n)])
    turns = Rotation.from_euler("xyz", tilts)
    t = np.column_stack([rng.uniform(-apart_m, apart_m, (n, 2)), rng.uniform(0.15, 0.25, n)])
    ranges = (-(t + turns.apply([0.01, 0.02, 0.0]))[:, 2]) / turns.apply(beam_of(0, 0))[:, 2]
    return np.hstack([t, turns.as_quat()]), ranges + rng.normal(0.0, 1e-4, n)


@pytest.mark.parametrize(("tilt_x", "tilt_y"), [(0.0, 0.0), (0.4, 0.0), (0.0, 0.4)])
def test_moves_that_cannot_tell_the_mount_are_refused(tilt_x: float, tilt_y: float) -> None:
    with pytest.raises(ConfigError, match="do not determine"):
        fit_mount(*over_a_plate(tilt_x, tilt_y, 200))


def test_moves_at_one_place_of_the_plate_are_refused_with_the_remedy() -> None:
    def moves(apart_m: float) -> tuple[np.ndarray, ...]:  # tilts about one axis at a time
        about_x, about_y = (over_a_plate(*tilts, 60, apart_m) for tilts in ((0.4, 0.0), (0.0, 0.4)))
        return tuple(np.concatenate(both) for both in zip(about_x, about_y))

    with pytest.raises(ConfigError, match=r"do not determine .* places of the plate some 0\.2 m apart"):
        fit_mount(*moves(0.0))
    assert fit_mount(*moves(0.1)).mount[:2] == pytest.approx((0.01, 0.02), abs=2e-3)


def test_moves_far_from_the_origin_give_the_same_mount() -> None:
    poses, seen = over_a_plate(0.4, 0.4, 60)
    here, middle = fit_mount(poses, seen), (512345.6789, 5812345.6789, 1500.0)
    poses[:, :3] += middle
    there = fit_mount(poses, seen)
    assert there.mount == pytest.approx(here.mount, abs=1e-7)
    assert there.plate[3] == pytest.approx(np.dot(there.plate[:3], middle) + here.plate[3], abs=1e-5)


@pytest.mark.parametrize("norm", [0.0, 0.5, 1.1])
def test_a_quaternion_that_is_none_is_reported_with_its_move(norm: float) -> None:
    poses, seen = over_a_plate(0.4, 0.4, 40)
    poses[6, 3:] *= norm
    with pytest.raises(ConfigError, match="move 7: the quaternion"):
        fit_mount(poses, seen)


def test_stray_readings_are_reported_where_they_spoil_the_mount() -> None:
    poses, seen = over_a_plate(0.4, 0.4, 40)
    seen[11] += 0.2
    with pytest.raises(ConfigError, match=r"stray readings: .* move 12 is .* off"):
        fit_mount(poses, seen)


def test_moves_that_tell_the_mount_badly_are_refused_with_what_is_uncertain_by_how_much() -> None:
    with pytest.raises(ConfigError, match=r"do not determine the sensor's [xyz].*uncertain by [0-9.]+ mm"):
        fit_mount(*over_a_plate(0.01, 0.01, 24))


def test_the_fewest_readings_over_a_plate_are_enough_and_one_less_is_not() -> None:
    poses, ranges = over_a_plate(0.4, 0.4, 24)
    assert fit_mount(poses, ranges).mount[:2] == pytest.approx((0.01, 0.02), abs=2e-3)
    with pytest.raises(ConfigError, match="23 readings over the plate are too few; take at least 24"):
        fit_mount(poses[:23], ranges[:23])


def run(*words: object) -> Result:
    return CliRunner().invoke(calibrate_group, [str(w) for w in words], catch_exceptions=False)


def test_pairs_may_have_semicolons_and_a_decimal_comma(tmp_path: Path) -> None:
    rows = "".join(f"{v},5;{20 + 10 * v},0\n" for v in range(11))
    (tmp_path / "pairs.csv").write_text("indicated;true\n" + rows)
    run("range", tmp_path / "pairs.csv", "--unit", "mm", "--out", tmp_path / "laser.json")
    table = load_calibration(tmp_path / "laser.json").tables[0]
    assert (table.indicated[0], table.range_m[0]) == pytest.approx((0.5, 0.02))


def test_the_commands_write_one_file_that_keeps_what_others_found(tmp_path: Path) -> None:
    out = tmp_path / "laser.json"
    pairs = "indicated,true\n" + "".join(f"{v},{20 + 10 * v}\n" for v in range(11))
    (tmp_path / "pairs.csv").write_text(pairs)
    done = run("range", tmp_path / "pairs.csv", "--unit", "mm", "--out", out, "--json")
    assert json.loads(done.output)["rms_m"] == pytest.approx(0.0, abs=1e-12)
    t = np.arange(0.0, 4.0, 0.01)
    z, r = 0.1 + 0.005 * np.sin(6 * t), 0.1 + 0.005 * np.sin(6 * (t - 0.05))
    rows = "t_s,z_m,range_m\n" + "".join(f"{a},{b},{c}\n" for a, b, c in zip(t, z, r))
    (tmp_path / "move.csv").write_text(rows)
    assert "latency 50.0" in run("latency", tmp_path / "move.csv", "--out", out).output
    found = load_calibration(out)
    assert found.latency_s == pytest.approx(0.05, abs=1e-4)
    assert found.tables[0].range_m[-1] == pytest.approx(0.12)
    assert set(found.about) == {"range 0", "latency"}


def test_a_driver_with_a_calibration_delivers_linear_distances_latency_and_keeps_the_contract(
    tmp_path: Path,
) -> None:
    # volts in steps of a millivolt from 0 to 0.999; distance is the square of the voltage and 50 mm
    info = make_driver({"kind": "none"}, "x").info
    import msgspec

    info = msgspec.structs.replace(
        info, scale_m=(1e-3,) * 8, zero_m=(0.0,) * 8, range_min_m=0.0, range_max_m=1.0
    )
    words = np.array([pack_conversion(k % 1000, 0, 0, 0) for k in range(1000)])
    save_conversions(tmp_path / "volts.npz", np.arange(1000) * MS // 4, words, info)
    volts = np.linspace(0.1, 0.9, 401)
    table = RangeTable(0, tuple(volts.tolist()), tuple((0.05 + volts**2).tolist()))
    save_calibration(tmp_path / "laser.json", Calibration(tables=(table,), latency_s=0.012))
    settings = {
        "kind": "replay",
        "file": str(tmp_path / "volts.npz"),
        "calibration": str(tmp_path / "laser.json"),
    }
    driver = make_driver(settings, "x")
    assert isinstance(driver, CalibratedDriver)
    assert driver.info.latency_ns == 12 * MS
    assert (driver.info.range_min_m, driver.info.range_max_m) == (pytest.approx(0.06), pytest.approx(0.86))
    queue = ConversionQueue()
    driver.start(queue)
    end = time.monotonic() + 60.0
    while len(queue) < 1000 and time.monotonic() < end:
        time.sleep(0.001)
    driver.stop()
    got = queue.drain()[:, 1].tolist()
    assert len(got) == 1000
    for k, word in enumerate(got):
        inside = 84 <= k <= 916  # two per cent beyond the ends are carried on
        assert bool(conversion_flags(word) & FLAG_INVALID) != inside
        if 100 <= k <= 900:
            range_m = driver.info.zero_m[0] + driver.info.scale_m[0] * conversion_counts(word)
            assert range_m == pytest.approx(0.05 + (1e-3 * k) ** 2, abs=4e-6)
    assert len(check_driver(lambda: make_driver(settings, "x"))) == 4


def test_readings_outside_the_table_are_noted_with_its_ends(tmp_path: Path) -> None:
    # GIVEN a table of millimetres before a driver that gives metres
    table = RangeTable(0, (50.0, 150.0), (0.05, 0.15))
    save_calibration(tmp_path / "laser.json", Calibration(tables=(table,)))
    info = metre_info("laser", 0.02, 0.2)
    words = np.array([pack_range(info, 0, 0.1)] * NOTED_RUN)
    save_conversions(tmp_path / "ranges.npz", np.arange(NOTED_RUN) * MS, words, info)
    settings = {"kind": "replay", "file": str(tmp_path / "ranges.npz")}
    driver = make_driver(settings | {"calibration": str(tmp_path / "laser.json")}, "x")
    assert notes_of(driver) == []
    # WHEN it runs, THEN a note says why there is no measurement
    driver.start(ConversionQueue())
    try:
        (note,) = until(lambda: notes_of(driver), "a note")
    finally:
        driver.stop()
    assert "0.1 is not from 50 to 150" in note
    assert "--indicated-unit" in note


def test_one_reading_inside_the_table_ends_the_run_outside() -> None:
    inner = metre_info("laser", 0.02, 0.2)
    relay = zeros(Linearizer)
    relay["scale"], relay["zero"], relay["quantum_m"] = inner.scale_m, inner.zero_m, 1e-6
    indicated, range_m, relay["rows"] = tables_of(
        Calibration(tables=(RangeTable(0, (0.05, 0.15), (0.1, 0.9)),)), inner
    )
    for value, count in ((0.18, 1), (0.03, 2), (0.1, 0), (0.18, 1)):
        linearize(relay, indicated, range_m, pack_range(inner, 0, value))
        assert relay[0]["outside"][0] == count


@pytest.mark.parametrize(
    ("words", "note", "first"),
    [
        ((), "50 m to 152 m; is their --unit", 50.0),
        (("--unit", "mm"), "--indicated-unit mm", 50.0),
        (("--unit", "mm", "--indicated-unit", "mm"), "", 0.05),
    ],
)
def test_pairs_in_millimetres_are_noted_or_converted(
    tmp_path: Path, words: tuple[str, ...], note: str, first: float
) -> None:
    rows = "".join(f"{v},{1.02 * v - 1}\n" for v in range(50, 151, 10))
    (tmp_path / "pairs.csv").write_text(f"indicated,true\n{rows}")
    out = tmp_path / "laser.json"
    done = run("range", tmp_path / "pairs.csv", *words, "--out", out, "--json", "--plot", tmp_path / "a.svg")
    notes = json.loads(done.output)["notes"]
    assert len(notes) == bool(note)
    assert note in "".join(notes)
    assert load_calibration(out).tables[0].indicated[0] == pytest.approx(first)
    assert ("indicated [m]" if first < 1.0 else "indicated [m or V]") in (tmp_path / "a.svg").read_text()


def test_a_channel_without_a_table_keeps_its_own_window_beside_a_wider_one() -> None:
    inner = metre_info("two lasers", 0.05, 0.15, n_channels=2)
    table = RangeTable(0, (0.05, 0.15), (0.1, 0.9))
    relay = zeros(Linearizer)
    relay["scale"], relay["zero"], relay["quantum_m"] = inner.scale_m, inner.zero_m, 1e-6
    indicated, range_m, relay["rows"] = tables_of(Calibration(tables=(table,)), inner)
    for value in (0.049, 0.0501, 0.1, 0.1499, 0.151, 0.3):
        counts = round((value - inner.zero_m[1]) / inner.scale_m[1])
        word = linearize(relay, indicated, range_m, pack_conversion(counts, 1, 0, 0))
        assert bool(conversion_flags(word) & FLAG_INVALID) == (not 0.05 < value < 0.15), value
        assert conversion_counts(word) * 1e-6 == pytest.approx(value, abs=2e-6)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{}x", "no calibration"),
        ("{}", "no table, no latency and no mounts; write one"),
        ('{"version": 1, "mounts": [], "about": {"a": 1}}', "no table, no latency and no mounts"),
        ('{"version": 7}', "version 7"),
        ('{"latency_s": -1}', "latency_s"),
        ('{"tables": [{"channel": 0, "indicated": [1, 1], "range_m": [1, 2]}]}', "not monotone"),
        ('{"tables": [{"channel": 0, "indicated": [1, 2, 3], "range_m": [1, 2, 2]}]}', "not monotone"),
        ('{"tables": [{"channel": 0, "indicated": [1, 2, 3], "range_m": [2, 1, 1]}]}', "not monotone"),
        (
            '{"tables": [{"channel": 3, "indicated": [1, 2], "range_m": [1, 2]}]}',
            r"channels \[3\], the driver has channels 0 to 0",
        ),
        ('{"mounts": [[0, 0, 0, 0, 0, 0, 1], [0, 0, 0, 0, 0, 0, 1]]}', "2 mounts for 1"),
    ],
)
def test_a_file_that_is_no_calibration_of_this_driver_is_reported(
    text: str, says: str, tmp_path: Path
) -> None:
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(ConfigError, match=says):
        make_driver({"kind": "none", "calibration": str(tmp_path / "c.json")}, "x")


def test_a_device_is_no_calibration() -> None:
    with pytest.raises(ConfigError, match="calibration /dev/zero has more than 16 MiB"):
        load_calibration("/dev/zero")


@pytest.mark.parametrize("out", ["nowhere/laser.json", "damaged.json", "/dev/zero"])
def test_a_file_that_cannot_be_written_is_named_before_distances_are_asked_for(
    out: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "damaged.json").write_text("no JSON")
    monkeypatch.chdir(tmp_path)
    asked: list[str] = []
    monkeypatch.setattr(range_pairs, "observe", asked.append)
    with pytest.raises(SurffollowError, match=out):
        run("range", "--name", "surf", "--out", out)
    with pytest.raises(SurffollowError, match=out):
        run("latency", "--name", "surf", "--out", out)
    assert asked == []


def test_a_table_that_may_be_made_of_calibrated_distances_is_noted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    typed = np.linspace(0.1, 0.2, 12)
    monkeypatch.setattr(range_pairs, "typed_pairs", lambda *_: (typed, typed))
    words = ("range", "--name", "surf", "--out", tmp_path / "laser.json", "--json")
    # GIVEN no table of the channel yet, THEN nothing is to be noted
    assert json.loads(run(*words).output)["notes"] == []
    # WHEN one is replaced, THEN its readings may be those of a service that has it in force
    (note,) = json.loads(run(*words).output)["notes"]
    assert "start it without `calibration`" in note
    assert json.loads(run(*words, "--channel", 1).output)["notes"] == []
