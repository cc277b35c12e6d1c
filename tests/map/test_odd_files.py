"""Map files that are damaged, crafted or in the way: refused, and nothing is lost."""

from __future__ import annotations

import os
import re
import resource
import signal
import stat

import numpy as np
import pytest

from map.small_maps import scattered, small
from second_user import NOBODY, needs_root
from surffollow.errors import MapFileError, ScanFileError
from surffollow.map import HeightMap
from surffollow.map.files import export
from surffollow.map.formats import atomic_file
from surffollow.scan import read_images
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import numpy_dtype


@pytest.fixture
def text(tmp_path):
    m = small()
    m.add(scattered())
    m.save(tmp_path / "good.txt")
    return (tmp_path / "good.txt").read_text()


def changed(text, key, value):
    """A header that was changed manually, without its checksum."""
    new, n = re.subn(rf"(?m)^{key} .*$", f"{key} {value}", text)
    assert n == 1
    return re.sub(r"(?m)^head_crc .*\n", "", new)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("nx", "99999999999999999999"),
        ("nx", "1000000000"),
        ("grid_m", "1e308"),
        ("grid_m", "1e-320"),
        ("quantum_m", "1e308"),
        ("x0_m", "1e308"),
        ("datum_m", "nan"),
        ("finest_grid_m", "nan"),
        ("gate_m", "nan"),
        ("gate_min_count", "0"),
        ("region_m", "5"),
        ("region_m", "nan nan nan nan"),
        ("rounding", "up"),
    ],
)
def test_a_header_with_impossible_numbers_is_refused(tmp_path, text, key, value):
    path = tmp_path / "odd.txt"
    path.write_text(changed(text, key, value))
    with pytest.raises(MapFileError, match=r"odd\.txt"):
        HeightMap.load(path)


def test_a_small_file_that_claims_a_billion_grids_is_refused_before_memory_is_taken(tmp_path, text):
    path = tmp_path / "huge.txt"
    path.write_text(changed(changed(text, "nx", 31622), "ny", 31622))
    with pytest.raises(MapFileError, match="cut short"):
        HeightMap.load(path)


def test_an_endless_line_is_refused(tmp_path):
    path = tmp_path / "endless.txt"
    path.write_text("surffollow-map 1\n" + "# " + "x" * 10_000_000 + "\n")
    with pytest.raises(MapFileError, match="longer than"):
        HeightMap.load(path)
    for suffix in ("", ".asc", ".npz"):
        link = tmp_path / f"zero{suffix}"
        link.symlink_to("/dev/zero")
        with pytest.raises(MapFileError, match="no plain file"):
            HeightMap.load(link)


def test_a_pipe_is_no_map_and_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "a.txt")
    with pytest.raises(MapFileError, match="no plain file"):
        HeightMap.load(tmp_path / "a.txt")


def test_counts_of_unknown_grids_and_an_unset_datum_in_a_file_do_not_poison_the_map(tmp_path):
    m = small(datum_m=0.0)
    m.add([[0.05, 0.05, 0.5]])
    m.save(tmp_path / "a.txt")
    whole = changed((tmp_path / "a.txt").read_text(), "datum_set", 0)
    head, counts = whole.split("\ncounts\n")
    rows = counts.splitlines()[:-1]
    import zlib

    samples = np.full((10, 10), 9, np.uint8)
    quanta = np.full((10, 10), ml.UNKNOWN, np.int16)
    quanta[0, 0] = round(0.5 / ml.DEFAULT_QUANTUM_M)
    crc = zlib.crc32(samples.tobytes(), zlib.crc32(quanta.tobytes()))
    (tmp_path / "b.txt").write_text("\n".join([head, "counts", *["9*10"] * len(rows), f"end {crc:08x}", ""]))
    loaded = HeightMap.load(tmp_path / "b.txt")
    assert loaded.counts.sum() == 9
    loaded.add([[0.95, 0.95, 0.3]])
    assert loaded.heights_m[0, 0] == pytest.approx(0.5, abs=1e-4)
    assert loaded.heights_m[9, 9] == pytest.approx(0.3, abs=1e-4)


def test_a_crafted_archive_cannot_make_the_kernels_leave_their_memory(tmp_path):
    m = small()
    m.add(scattered())
    m.save(tmp_path / "good.npz")
    arrays = dict(np.load(tmp_path / "good.npz"))
    header = arrays["header"].copy()
    w = header.view(numpy_dtype(ml.MapHeader))
    w["tile_shift"], w["tiles_x"], w["inv_grid_per_m"], w["journal_op"] = 0, 10**12, 1e12, ml.REFOCUSING
    np.savez(tmp_path / "odd.npz", **{**arrays, "header": header})
    loaded = HeightMap.load(tmp_path / "odd.npz")
    assert loaded.add(scattered(1)) == 300
    m.add(scattered(1))
    np.testing.assert_array_equal(loaded.heights_m, m.heights_m)
    loaded.refocus((0, 0, 0.5, 0.5))


@pytest.mark.parametrize(
    "change",
    [
        {"header": lambda a: a.astype(np.float64)},
        {"header": lambda a: a[:100]},
        {"quanta": lambda a: a.reshape(-1)},
        {"counts": lambda a: a.astype(str)},
        {"quanta": lambda a: a[:0, :0], "counts": lambda a: a[:0, :0]},
        {"format": lambda a: np.array([1, 2])},
    ],
)
def test_archives_whose_arrays_do_not_fit_are_refused(tmp_path, change):
    small().save(tmp_path / "good.npz")
    arrays = dict(np.load(tmp_path / "good.npz"))
    for name, of in change.items():
        arrays[name] = of(arrays[name])
    np.savez(tmp_path / "odd.npz", **arrays)
    with pytest.raises(MapFileError, match=r"odd\.npz"):
        HeightMap.load(tmp_path / "odd.npz")


def test_a_foreign_or_damaged_archive_is_refused_without_advice_to_load_it_unsafely(tmp_path):
    path = tmp_path / "odd.npz"
    small().save(path)
    cut = path.read_bytes()[:150]
    np.savez(path, format=np.array([{}], dtype=object))
    for content in (bytes(range(128, 256)), b"", cut, path.read_bytes()):
        path.write_bytes(content)
        with pytest.raises(MapFileError, match="or is damaged; write the map again") as refused:
            HeightMap.load(path)
        assert "pickle" not in str(refused.value)
    with pytest.raises(MapFileError, match="No such file"):
        HeightMap.load(tmp_path / "none.npz")


def test_an_array_file_named_as_an_archive_is_refused(tmp_path):
    with open(tmp_path / "array.npz", "wb") as f:
        np.save(f, np.zeros(3))
    with pytest.raises(MapFileError, match=r"array\.npz"):
        HeightMap.load(tmp_path / "array.npz")


def test_unknown_cells_of_a_raster_may_be_written_with_other_digits_than_its_nodata(tmp_path):
    path = tmp_path / "dem.asc"
    head = "ncols 2\nnrows 1\nxllcorner 0\nyllcorner 0\ncellsize 0.1\n"
    for declared, written in (
        ("-3.40282346639e+38", "-3.4028234663852886e+38"),
        ("-3.40282e+38", "-3.402823466e+38"),
        ("-9999", "-9999.000"),
    ):
        path.write_text(f"{head}NODATA_value {declared}\n{written} 2\n")
        np.testing.assert_allclose(HeightMap.load(path).heights_m, [[np.nan, 2.0]], atol=1e-5)
    path.write_text(f"{head}NODATA_value -9999\n-3.4028234663852886e+38 2\n")
    with pytest.raises(MapFileError, match=r"dem\.asc.*finite.*NODATA"):
        HeightMap.load(path)


@pytest.mark.parametrize(
    "head", ["ncols inf", "ncols nan", "ncols 1e30", "cellsize inf", "cellsize 1e-320", "xllcorner 1e308"]
)
def test_a_raster_with_impossible_numbers_is_refused(tmp_path, head):
    lines = {"ncols": "2", "nrows": "1", "xllcorner": "0", "yllcorner": "0", "cellsize": "0.1"}
    lines.update([head.split()])
    path = tmp_path / "odd.asc"
    path.write_text("".join(f"{k} {v}\n" for k, v in lines.items()) + "1 2\n")
    with pytest.raises(MapFileError, match=r"odd\.asc"):
        HeightMap.load(path)


@pytest.mark.parametrize("size", ["-1", "0", "nan", "inf"])
def test_a_raster_whose_cell_size_is_not_positive_is_refused_for_it(tmp_path, size):
    path = tmp_path / "odd.asc"
    path.write_text(f"ncols 2\nnrows 1\nxllcorner 0\nyllcorner 0\ncellsize {size}\n1 2\n")
    with pytest.raises(MapFileError, match=f"cellsize {size}; correct it: a cell size is positive"):
        HeightMap.load(path)


@pytest.mark.parametrize("suffix", ["txt", "npz", "asc", "ply", "tif"])
def test_a_full_disk_leaves_the_old_file_and_no_debris(tmp_path, suffix):
    m = HeightMap.over((0, 0, 1, 1), grids=20_000, finest_m=1e-6)
    m.add(scattered(n=5000))
    path = tmp_path / f"map.{suffix}"
    path.write_text("old")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, limits[1]))
    try:
        with pytest.raises(MapFileError, match="cannot write") as refused:
            export(path, m.header, m.pairs)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    assert "previous exception" not in str(refused.value)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    assert path.read_text() == "old"


@pytest.mark.parametrize("suffix", ["tif", "TIFF", "asc", "ply", "png"])
def test_saving_under_the_suffix_of_another_format_is_refused(tmp_path, suffix):
    path = tmp_path / f"map.{suffix}"
    path.write_text("old")
    with pytest.raises(MapFileError, match="export"):
        small().save(path)
    assert path.read_text() == "old"


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o666])
def test_a_file_that_is_replaced_keeps_its_mode(tmp_path, mode):
    path = tmp_path / "map.txt"
    path.write_text("old")
    path.chmod(mode)
    small().save(path)
    assert stat.S_IMODE(path.stat().st_mode) == mode
    assert path.read_text() != "old"


def test_a_new_file_gets_the_mode_of_the_umask_once_it_is_whole(tmp_path):
    before = os.umask(0o027)
    try:
        with atomic_file.replacing(tmp_path / "map.txt") as temporary:
            temporary.write_text("new")
            assert stat.S_IMODE(temporary.stat().st_mode) == 0o600
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "map.txt").stat().st_mode) == 0o640


def test_the_directory_is_synced_after_the_file_took_its_name(tmp_path, monkeypatch):
    path, synced = tmp_path / "map.txt", []

    def sync(handle):
        synced.append((stat.S_ISDIR(os.fstat(handle).st_mode), path.exists()))

    monkeypatch.setattr(atomic_file.os, "fsync", sync)
    small().save(path)
    assert synced == [(False, False), (True, True)]


def geotiff(path, crs=None, **tags):
    rasterio = pytest.importorskip("rasterio", reason="extra geo is not installed")
    where = rasterio.transform.from_origin(0, 2, 1, 1)
    size = {"width": 2, "height": 2, "count": 1, "dtype": "int16", "nodata": -1}
    with rasterio.open(path, "w", driver="GTiff", transform=where, crs=crs, **size) as out:
        out.write(np.array([[294, -1], [100, 200]], np.int16), 1)
        for name, value in tags.items():
            setattr(out, name, (value,))
    return path


@pytest.mark.parametrize(
    ("tags", "highest_m"),
    [
        ({"scales": 0.01, "offsets": 1.0}, 3.94),
        ({"units": "ft"}, 294 * 0.3048),
        ({"units": "US survey foot"}, 294 * 1200 / 3937),
        ({"units": "mm", "scales": 2.0}, 0.588),
        ({"units": "metre"}, 294.0),
        ({"crs": "EPSG:32632"}, 294.0),
        ({"crs": "EPSG:32618+6360"}, 294 * 1200 / 3937),
        ({"crs": 'LOCAL_CS["wall",UNIT["metre",1]]'}, 294.0),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_scale_offset_and_unit_of_a_geotiff_are_applied(tmp_path, tags, highest_m):
    m = HeightMap.load(geotiff(tmp_path / "dem.tif", **tags))
    assert np.nanmax(m.heights_m) == pytest.approx(highest_m, abs=m.quantum_m)
    assert np.isnan(m.heights_m).sum() == 1


@pytest.mark.parametrize(
    ("tags", "why"),
    [
        ({"crs": "EPSG:2263"}, "units of 0.3048"),
        ({"crs": "EPSG:4326"}, "degrees"),
        ({"crs": 'LOCAL_CS["wall",UNIT["foot",0.3048]]'}, "units of 0.3048"),
        ({"units": "parsec"}, "parsec"),
        ({"units": "s"}, "unit"),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_a_geotiff_that_is_not_in_metres_is_refused(tmp_path, tags, why):
    with pytest.raises(MapFileError, match=why):
        HeightMap.load(geotiff(tmp_path / "dem.tif", **tags))


@pytest.mark.filterwarnings("ignore")
def test_a_file_that_names_others_to_read_is_no_geotiff(tmp_path):
    # GIVEN a virtual dataset of GDAL, which reads another file, under the name of a GeoTIFF
    geotiff(tmp_path / "other.tif")
    band = '<SimpleSource><SourceFilename relativeToVRT="1">other.tif</SourceFilename></SimpleSource>'
    (tmp_path / "dem.tif").write_text(
        '<VRTDataset rasterXSize="2" rasterYSize="2"><GeoTransform>0, 1, 0, 2, 0, -1</GeoTransform>'
        f'<VRTRasterBand dataType="Int16" band="1">{band}</VRTRasterBand></VRTDataset>'
    )
    (tmp_path / "cameras.toml").write_text('images."dem.tif" = {}')
    # WHEN it is read as a map or as an image, THEN it is refused
    with pytest.raises(MapFileError, match="not recognized"):
        HeightMap.load(tmp_path / "dem.tif")
    with pytest.raises(ScanFileError, match="not recognized"):
        read_images([tmp_path / "dem.tif"], tmp_path / "cameras.toml")


@pytest.mark.filterwarnings("ignore")
def test_a_small_geotiff_that_announces_more_grids_than_a_map_has_is_not_read(tmp_path):
    rasterio = pytest.importorskip("rasterio", reason="extra geo is not installed")
    tiles = {"tiled": True, "blockxsize": 16384, "blockysize": 16384}
    size = {"width": 200_000, "height": 200_000, "count": 1, "dtype": "uint8", "SPARSE_OK": True}
    where = rasterio.transform.from_origin(0, 2, 1, 1)
    rasterio.open(tmp_path / "dem.tif", "w", driver="GTiff", transform=where, **size, **tiles).close()
    assert (tmp_path / "dem.tif").stat().st_size < 10_000
    with pytest.raises(MapFileError, match=r"200000 × 200000 cells; a map has at most 1e\+09"):
        HeightMap.load(tmp_path / "dem.tif")


@needs_root
def test_a_link_of_another_user_in_a_shared_folder_replaces_no_file(tmp_path):
    (tmp_path / "own.npz").write_text("kept")
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o1777)
    for name, leads_to in (("map.npz", tmp_path / "own.npz"), ("new.npz", tmp_path / "new.npz")):
        (shared / name).symlink_to(leads_to)
        os.chown(shared / name, NOBODY, NOBODY, follow_symlinks=False)
        (tmp_path / name).symlink_to(shared / name)  # one's own, which leads to it
        for link in (shared / name, tmp_path / name):
            with pytest.raises(MapFileError, match="is a link of user 65534; choose"):
                small().save(link)
    assert (tmp_path / "own.npz").read_text() == "kept"
    assert not (shared / "new.npz").exists()


def test_ones_own_links_are_followed_also_where_they_are_relative(tmp_path):
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o1777)
    (shared / "a.npz").symlink_to("../b.npz")
    (tmp_path / "b.npz").symlink_to("c.npz")
    small().save(shared / "a.npz")
    assert [(shared / "a.npz").is_symlink(), (tmp_path / "b.npz").is_symlink()] == [True, True]
    assert HeightMap.load(tmp_path / "c.npz").shape == small().shape


def test_links_that_go_round_are_refused(tmp_path):
    (tmp_path / "a.npz").symlink_to("b.npz")
    (tmp_path / "b.npz").symlink_to("a.npz")
    with pytest.raises(MapFileError, match=r"cannot write .*a\.npz"):
        small().save(tmp_path / "a.npz")
