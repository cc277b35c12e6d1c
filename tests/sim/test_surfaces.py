"""Properties of the profiles and height fields."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow.errors import InputFileError, RegionError, UsageError
from surffollow.sim import profiles as pr
from surffollow.sim import profiles_measured as pm
from surffollow.sim import profiles_random as rnd
from surffollow.sim import surfaces as sf
from surffollow.sim.surface_fy91 import fy91_field

ALL = {**pr.SHAPES, **rnd.RANDOM}


@pytest.mark.parametrize("name", sorted(ALL))
def test_profile_covers_its_path_and_repeats_with_its_seed(name: str) -> None:
    one, again, other = ALL[name](4), ALL[name](4), ALL[name](5)
    assert one.name == name
    assert one.x_m[0] <= one.start_m - 0.1
    assert one.x_m[-1] >= one.start_m + one.length_m + 0.1
    assert one.length_m >= 6.0
    assert np.array_equal(one.heights_m, again.heights_m)
    assert name == "flat" or not np.array_equal(one.heights_m, other.heights_m)


@pytest.mark.parametrize("road_class", "ABCD")
def test_iso_profile_has_the_displacement_psd_of_its_class(road_class: str) -> None:
    n_lines = 1000
    periods = []
    for seed in range(20):  # a whole period is 10 m; the path's 6.4 m are enough with an average over seeds
        p = rnd.iso8608(seed, road_class)
        h = p.heights_m * np.hanning(len(p.heights_m))
        periods.append(np.abs(np.fft.rfft(h)) ** 2 * 2 * p.dx_m / np.sum(np.hanning(len(h)) ** 2))
    psd = np.mean(periods, axis=0)
    n = np.fft.rfftfreq(len(p.heights_m), p.dx_m)
    for low, high in ((1.0, 3.0), (3.0, 10.0), (10.0, 30.0), (30.0, 90.0)):
        band = (n >= low) & (n < high)
        expected = rnd.ISO_DISPLACEMENT_PSD[road_class] * (n[band] / rnd.ISO_N0) ** -2.0
        assert np.sum(psd[band]) == pytest.approx(np.sum(expected), rel=0.15), (
            road_class,
            low,
            high,
            n_lines,
        )
    assert np.sum(psd[n > 105.0]) < 1e-3 * np.sum(psd[n > 50.0])


def test_profile_look_up_equals_numpy_interp() -> None:
    p = rnd.fy91_profile(2)
    x = np.random.default_rng(0).uniform(-1.0, 8.0, 2000)
    got = [pr.profile_height(p.heights_m, p.x0_m, p.dx_m, v) for v in x]
    assert np.allclose(got, np.interp(x, p.x_m, p.heights_m), atol=1e-12)


def test_slot_is_two_millimetres_wide_and_shapes_have_their_sizes() -> None:
    slot = pr.slot(1)
    runs = np.diff(np.flatnonzero(np.diff(slot.heights_m < -5e-3)))[::2] * slot.dx_m
    assert 1.0e-3 <= runs.min() <= runs.max() <= 2.0e-3
    assert np.ptp(pr.sine(0).heights_m) == pytest.approx(0.02, rel=0.01)
    assert np.abs(np.gradient(pr.ramp(0, 0.2, 0.1).heights_m, 0.5e-3)).max() == pytest.approx(0.2)
    assert set(np.unique(pr.step(0).heights_m)) == {0.0, 0.01}


def test_fy91_profile_has_its_boxes_and_ramps_per_metre() -> None:
    p = rnd.fy91_profile(91)
    for part, per_m in ((pr.PART_BOX, 5), (pr.PART_RAMP, 2)):
        inside = p.parts == part
        starts = np.count_nonzero(np.diff(inside.astype(int)) == 1)
        assert starts == pytest.approx(per_m * 6.4, abs=per_m)
    assert 0.2 < np.mean(~p.near_parts()) < 0.7


def test_fy91_field_rolls_by_thirty_millimetres_and_labels_its_objects() -> None:
    region = (0.0, 0.0, 2.0, 0.4)
    bare = fy91_field(7, region, 2e-3, objects=False)
    full = fy91_field(7, region, 2e-3)
    assert np.ptp(bare.heights_m) == pytest.approx(0.03, abs=0.004)
    assert not bare.parts.any()
    on = full.parts > 0
    assert np.allclose(full.heights_m[~on], bare.heights_m[~on])
    tops = (full.heights_m - bare.heights_m)[full.parts == pr.PART_BOX]
    assert tops.min() >= 5e-3 - 1e-12
    assert tops.max() <= 20e-3 + 1e-12
    rise = np.diff((full.heights_m - bare.heights_m)[50])
    ramp = (full.parts[50, 1:] == pr.PART_RAMP) & (full.parts[50, :-1] == pr.PART_RAMP)
    assert np.abs(rise[ramp]).max() / 2e-3 == pytest.approx(0.2, rel=0.02)
    for row in (10, 150):
        boxes = np.count_nonzero(np.diff((full.parts[row] == pr.PART_BOX).astype(int)) == 1)
        assert boxes == pytest.approx(10, abs=1)


def test_rolling_mask_keeps_its_distance_from_objects() -> None:
    f = fy91_field(7, (0.0, 0.0, 1.0, 0.2), 2e-3)
    mask = f.rolling_mask(0.02)
    rows, columns = np.nonzero(f.parts)
    for r, c in list(zip(rows, columns))[::997]:
        assert not mask[r, max(0, c - 10) : c + 11].any()
    assert 0.1 < mask.mean() < 0.8
    assert sf.flat_field((0, 0, 1, 1), grid_m=0.1).rolling_mask().all()


def test_field_look_up_equals_its_slow_twin_and_goes_on_at_the_edges() -> None:
    rng = np.random.default_rng(11)
    z = rng.standard_normal((7, 9))
    f = sf.HeightField(z, -0.3, 0.2, 0.1)
    for x, y in rng.uniform(-1.0, 2.0, (500, 2)):
        cx, cy = np.clip(x, -0.3, 0.5), np.clip(y, 0.2, 0.8)
        rows = [np.interp(cx, -0.3 + 0.1 * np.arange(9), row) for row in z]
        assert f.height_m(x, y) == pytest.approx(np.interp(cy, 0.2 + 0.1 * np.arange(7), rows), abs=1e-9)
    assert sf.field_part(f.parts, f.x0_m, f.y0_m, f.grid_m, 9.0, -9.0) == 0


def test_made_fields_have_the_slopes_they_say() -> None:
    region = (0.0, -0.2, 1.0, 0.2)
    ramp = sf.ramp_field(region, 0.2, -0.1, 2e-3)
    n = ramp.normal(0.5, 0.0)
    assert np.allclose(n, np.array([-0.2, 0.1, 1.0]) / np.sqrt(1.05))
    shell = sf.shell_field(region, grid_m=2e-3)
    assert shell.height_m(0.5, 0.0) == pytest.approx(0.0, abs=1e-9)
    assert shell.height_m(0.0, 0.0) == pytest.approx(-(1.5 - np.sqrt(1.5**2 - 0.25)), abs=1e-9)
    assert sf.step_field(region, 0.5, grid_m=2e-3).height_m(0.6, 0.0) == 0.01
    assert sf.sine_field(region, 0.2, grid_m=2e-3).height_m(0.05, 0.1) == pytest.approx(0.01, rel=1e-3)
    strip = sf.profile_field(np.array([0.0, 1.0, 2.0]), 0.0, 0.1, (0.0, 0.3))
    assert strip.height_m(0.15, 0.2) == pytest.approx(1.5)
    wide = ((0, 0, 1e6, 1e6), (-1e308, 0, 1e308, 1), (-1e308, 0, 1, 1))
    for bad in ((0, 0, 0, 1), (0, 0, 1, float("nan")), *wide):
        with pytest.raises(RegionError):
            sf.flat_field(bad)
    with pytest.raises(RegionError, match="choose a smaller one"):
        sf.shell_field((0, 0, 9, 1))


def test_csv_surface_is_read_and_a_broken_one_refused(tmp_path) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "hill.csv"
    path.write_text("x_m,height_m\n1.0,0.0\n2.0,0.01\n4.0,0.03\n")
    p = pm.read_csv(path)
    assert (p.name, p.start_m, p.length_m) == ("hill", 1.0, 3.0)
    assert p.height_m(np.array([0.0, 1.5, 3.0, 9.0])) == pytest.approx([0.0, 0.005, 0.02, 0.03], abs=1e-9)
    path.write_text("height_m, x_m\n0.5,0.0\n0.6,1.0\n")
    assert pm.read_csv(path).height_m(np.array([1.0])) == pytest.approx([0.6])
    for text in (
        "",
        "x_m,height_m\n",
        "a,b\n1,2\n2,3\n",
        "1,2\n1,3\n",
        "1,2\nx,3\n",
        "1,nan\n2,3\n",
        "1\n2\n",
    ):
        path.write_text(text)
        with pytest.raises(UsageError):
            pm.read_csv(path)
    with pytest.raises(InputFileError, match=r"absent\.csv': No such file"):
        pm.read_csv(tmp_path / "absent.csv")


@pytest.mark.parametrize("name", sorted(pm.MEASURED))
def test_measured_profile_is_scaled_to_the_path(name: str) -> None:
    if pm.data_dir() is None:
        pytest.skip("the shared data folder is not here (SURFFOLLOW_DATA)")
    p = pm.MEASURED[name](0)
    assert np.ptp(p.heights_m) == pytest.approx(0.03)
    assert p.length_m == 6.0
