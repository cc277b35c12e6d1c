"""A few wild cells do not make the heights of a whole map coarse."""

from __future__ import annotations

import numpy as np
import pytest

from surffollow.errors import MapFileError, UsageError
from surffollow.map import HeightMap
from surffollow.map.compose import compose
from surffollow.map.files import load_raster

Y, X = np.mgrid[:60, :60] * 0.02
GROUND = 0.15 * np.sin(4.0 * X) * np.cos(3.0 * Y)


def write_asc(path, z, nodata=None):
    declared = "" if nodata is None else f"NODATA_value {nodata:g}\n"
    rows = "\n".join(" ".join(repr(float(v)) for v in row) for row in z[::-1])
    head = f"ncols {z.shape[1]}\nnrows {z.shape[0]}\nxllcorner 0\nyllcorner 0\ncellsize 0.02\n"
    path.write_text(head + declared + rows + "\n")


@pytest.mark.parametrize(
    ("value", "nodata", "why"),
    [
        (-99999.0, None, "-99999 surely stands for unknown: declare it as NODATA"),
        (-32768.0, None, "-32768 surely stands for unknown"),
        (-99999.0, -9999.0, "-99999 surely stands for unknown"),
        (-9999.0, -1.0, "-9999 surely stands for unknown"),
        (5000.0, None, "with them a map stores heights in steps of 100 mm"),
        (-31.5, None, "with them a map stores heights in steps of 0.5 mm"),
    ],
)
def test_a_raster_with_a_wild_cell_is_refused_with_its_place_and_the_remedy(tmp_path, value, nodata, why):
    """GIVEN ground of ±15 cm with one wild cell WHEN it is read THEN no coarse map is made of it."""
    z = GROUND.copy()
    z[2, 3] = value
    write_asc(tmp_path / "spike.asc", z, nodata)
    for read in (HeightMap.load, load_raster):
        with pytest.raises(MapFileError) as refused:
            read(tmp_path / "spike.asc")
        text = str(refused.value)
        assert "spike.asc: 1 of 3600 heights lie far from all others" in text
        assert f"{value:g} m at x 0.07, y 0.05 m (row 2, column 3)" in text
        assert why in text
    # declared as what it is, it is an unknown cell, and the steps are those of the ground
    write_asc(tmp_path / "spike.asc", z, value)
    m = HeightMap.load(tmp_path / "spike.asc")
    assert np.isnan(m.heights_m[2, 3])
    assert m.quantum_m < 3e-5


def test_usual_values_for_unknown_are_found_however_many_they_are():
    z = GROUND.copy()
    z[:20] = -9999.0
    with pytest.raises(UsageError, match=r"1200 of 3600 .* and 1197 more; -9999 surely stands for unknown"):
        HeightMap.from_heights(z, origin_m=(0.0, 0.0), grid_m=0.02)
    # a number that is a height among others is one
    z = GROUND - 9999.0
    z[2, 3] = -9999.0
    assert HeightMap.from_heights(z, origin_m=(0.0, 0.0), grid_m=0.02).quantum_m < 3e-5


def test_honest_relief_is_no_fault():
    pole = np.zeros((60, 60))
    pole[3, 3] = 10.0  # steps of 0.15 mm in cells of 20 mm
    for z in (
        GROUND + 2000.0 * X,  # a mountain
        np.where(X > 0.6, 50.0, 0.0),  # a cliff
        pole,
    ):
        assert HeightMap.from_heights(z, origin_m=(0.0, 0.0), grid_m=0.02).shape == (60, 60)
    # who names the quantum has chosen
    z = GROUND.copy()
    z[2, 3] = 5000.0
    chosen = HeightMap.from_heights(z, origin_m=(0.0, 0.0), grid_m=0.02, quantum_m=0.2)
    assert chosen.quantum_m == 0.2


def test_a_raster_is_read_in_full_precision(tmp_path):
    z = GROUND + 2000.0 * X
    write_asc(tmp_path / "dem.asc", z)
    heights, origin, grid = load_raster(tmp_path / "dem.asc")
    np.testing.assert_array_equal(heights, z)
    assert (origin, grid) == ((0.0, 0.0), 0.02)
    m = HeightMap.load(tmp_path / "dem.asc")
    assert np.abs(m.heights_m - z).max() > 1e-3
    m.save(tmp_path / "dem.npz")
    assert load_raster(tmp_path / "dem.npz") is None


def test_composing_refuses_a_wild_cell_of_one_map():
    good = HeightMap.from_heights(GROUND, origin_m=(0.0, 0.0), grid_m=0.02)
    z = GROUND.copy()
    z[2, 3] = 5000.0
    wild = HeightMap.from_heights(z, origin_m=(1.2, 0.0), grid_m=0.02, quantum_m=0.2)
    with pytest.raises(UsageError, match=r"5000 m at x 1.27, y 0.05 m"):
        compose([good, wild])
