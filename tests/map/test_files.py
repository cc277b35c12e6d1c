"""Map files: lossless where promised, read by others, atomic, refused when damaged."""

from __future__ import annotations

import json
import re
import struct
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from map.sampled_maps import sampled
from surffollow.cli.map import map_group
from surffollow.errors import MapCancelledError, MapFileError, UsageError
from surffollow.map import HeightMap
from surffollow.map.files import EXPORTS, export
from surffollow.map.formats.raster import read_esri_ascii

STATE = {
    "capacity_grids",
    "scratch_bytes",
    "generation",
    "dirty",
    "resets",
    "refocuses",
    "installs",
    "rejected",
}


def same(one, other):
    np.testing.assert_array_equal(one.heights_m, other.heights_m)
    np.testing.assert_array_equal(one.counts, other.counts)
    for name in one.header.dtype.names:
        if name not in STATE and not name.startswith(("journal", "overlap")):
            np.testing.assert_array_equal(one.header[name], other.header[name], err_msg=name)


def test_the_heights_in_an_archive_are_those_of_the_map_to_the_last_bit(tmp_path):
    m = HeightMap.over((0, 0, 1, 1), grids=100)
    m.add(np.c_[np.random.default_rng(2).random((300, 2)), np.linspace(1500.0, 1500.7, 300)])
    m.save(tmp_path / "m.npz")
    with np.load(tmp_path / "m.npz") as archive:
        np.testing.assert_array_equal(archive["heights_m"], m.heights_m)


@pytest.mark.parametrize("suffix", [".txt", ".npz", ".anything", ""])
def test_saving_and_loading_gives_the_same_map_and_the_same_future(tmp_path, suffix):
    m = sampled(gate_m=0.004)
    m.refocus((-0.2, 0.2, 0.5, 0.7))
    m.add(np.random.default_rng(0).uniform((-0.3, 0.2, 1.49), (0.5, 0.6, 1.51), (999, 3)))
    path = tmp_path / f"map{suffix}"
    m.save(path)
    again = HeightMap.load(path)
    same(m, again)
    future = np.random.default_rng(1).uniform((-0.3, 0.2, 1.49), (0.5, 0.6, 1.51), (5000, 3))
    m.add(future)
    again.add(future)
    same(m, again)


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_any_map_survives_the_text_file(tmp_path_factory, data):
    nx, ny = data.draw(st.integers(1, 30)), data.draw(st.integers(1, 12))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    heights = rng.integers(-3, 4, (ny, nx)) * data.draw(st.sampled_from([0.0, 1e-4, 0.2]))
    heights = np.where(rng.random((ny, nx)) < data.draw(st.floats(0, 1)), np.nan, heights)
    m = HeightMap.from_heights(
        heights,
        origin_m=(data.draw(st.floats(-1e6, 1e6)), 0.1),
        grid_m=data.draw(st.floats(1e-6, 1e3)),
        counts=rng.integers(0, 256, (ny, nx)),
    )
    path = tmp_path_factory.mktemp("map") / "m.txt"
    m.save(path)
    same(m, HeightMap.load(path))


def test_the_text_file_can_be_read_without_our_code(tmp_path):
    m = sampled()
    path = tmp_path / "m.txt"
    m.save(path)
    head, rows, block = {}, {"heights": [], "counts": []}, None
    for line in path.read_text().splitlines()[1:]:
        if line in rows:
            block = line
        elif line.startswith("end"):
            break
        elif block is None and not line.startswith("#"):
            head[line.split()[0]] = line.split()[1:]
        elif block:
            numbers = []
            for token in line.split():
                value, _, times = token.partition("*")
                numbers += [int(value)] * int(times or 1)
            rows[block].append(numbers)
    quanta = np.array(rows["heights"])
    heights = float(head["datum_m"][0]) + float(head["quantum_m"][0]) * quanta
    heights[quanta == -32768] = np.nan
    np.testing.assert_allclose(heights, m.heights_m, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(rows["counts"], m.counts)
    assert float(head["x0_m"][0]) == m.origin_m[0]


def test_a_damaged_text_file_is_refused_with_its_line(tmp_path):
    path = tmp_path / "m.txt"
    m = sampled(grids=100)
    m.save(path)
    good = re.sub(r"(?m)^head_crc .*\n", "", path.read_text())  # or that would tell of each
    lines = good.splitlines(keepends=True)
    row = next(i for i, text in enumerate(lines) if text == "heights\n") + 1
    damaged = {
        "cut short": good[: len(good) // 2],
        "first line": good.replace("surffollow-map 1", "surffollow-map 7"),
        "checksum": good.replace(lines[-1], "end 00000000\n"),
        "nx is": "".join([*lines[:row], lines[row].rsplit(" ", 1)[0] + "\n", *lines[row + 1 :]]),
        "whole number": "".join([*lines[:row], lines[row].replace(" ", " x", 1), *lines[row + 1 :]]),
        "outside": "".join([*lines[:row], "99999 " + lines[row].split(" ", 1)[1], *lines[row + 1 :]]),
        "lacks quantum_m": good.replace("quantum_m", "other_m"),
        "grid_m": good.replace("\ngrid_m ", "\ngrid_m -"),
        "value for nx": good.replace("\nnx ", "\nnx a"),
        "1e9 grids": good.replace("\nnx ", "\nnx 9999999999"),
        "runs": "".join([*lines[:row], "1*999999999999\n", *lines[row + 1 :]]),
        "not ASCII": good.replace("heights", "hèights"),
    }
    for word, text in damaged.items():
        path.write_text(text, encoding="utf-8")
        with pytest.raises(MapFileError, match=word):
            HeightMap.load(path)
    with pytest.raises(MapFileError, match="cannot read"):
        HeightMap.load(tmp_path / "absent.txt")
    (tmp_path / "m.npz").write_bytes(b"PK\x03\x04 no archive")
    with pytest.raises(MapFileError, match="is damaged"):
        HeightMap.load(tmp_path / "m.npz")


def test_a_header_that_was_damaged_is_refused_and_one_changed_by_hand_read_without_its_checksum(tmp_path):
    path = tmp_path / "m.txt"
    m = sampled(grids=100)
    m.save(path)
    good = path.read_text()
    head, tail = good.split("head_crc ")
    values = [i for i, c in enumerate(head) if c.isdigit() and i > head.index("\nnx ")]
    for i in values:
        other = "0123456789"[(int(head[i]) + 1) % 10]
        path.write_text(f"{head[:i]}{other}{head[i + 1 :]}head_crc {tail}")
        with pytest.raises(MapFileError, match=r"m\.txt"):
            HeightMap.load(path)
    path.write_text(good.replace("\nsamples ", "\nsamples 1"))
    with pytest.raises(MapFileError, match="delete the line head_crc"):
        HeightMap.load(path)
    path.write_text(good.replace("\nheights\n", "\nx0_m 3.0\nheights\n"))
    with pytest.raises(MapFileError, match="follows the header's checksum"):
        HeightMap.load(path)
    path.write_text(re.sub(r"(?m)^x0_m .*$", "x0_m 3.0", head) + tail.split("\n", 1)[1])
    assert HeightMap.load(path).origin_m[0] == 3.0
    path.write_bytes(good.replace("\n", "\r\n").encode())
    same(m, HeightMap.load(path))


@pytest.mark.parametrize("suffix", EXPORTS)
def test_a_cancelled_export_leaves_the_old_file_and_no_debris(tmp_path, suffix):
    m = sampled(grids=400)
    path = tmp_path / f"m{suffix}"
    path.write_text("old")
    with pytest.raises(MapCancelledError):
        export(path, m.header, m.pairs, progress=lambda fraction: False)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    seen = []
    export(path, m.header, m.pairs, progress=seen.append)
    assert path.read_bytes() != b"old"
    assert seen == sorted(seen)
    assert seen[-1] == 1.0
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_an_unwritable_place_is_named(tmp_path):
    with pytest.raises(MapFileError, match="cannot write"):
        sampled(grids=10).save(tmp_path / "no" / "m.txt")
    with pytest.raises(UsageError, match=r"\.docx"):
        export(tmp_path / "m.docx", *(lambda m: (m.header, m.pairs))(sampled(grids=10)))


@pytest.mark.parametrize("suffix", [".asc", ".tif"])
def test_rasters_come_back_as_priors_in_the_same_place(tmp_path, suffix):
    m = sampled()
    path = tmp_path / f"m{suffix}"
    export(path, m.header, m.pairs)
    prior = HeightMap.load(path)
    assert prior.shape == m.shape
    np.testing.assert_allclose(prior.extent_m, m.extent_m, rtol=0, atol=1e-12)
    np.testing.assert_allclose(prior.heights_m, m.heights_m, rtol=0, atol=prior.quantum_m)
    assert not prior.counts.any()


def test_geotiff_is_what_rasterio_expects(tmp_path):
    rasterio = pytest.importorskip("rasterio", reason="extra geo is not installed")
    m = sampled()
    export(tmp_path / "m.tif", m.header, m.pairs)
    x, y = m.origin_m[0] + 10.5 * m.grid_m, m.origin_m[1] + 3.5 * m.grid_m
    with rasterio.open(tmp_path / "m.tif") as raster:
        row, column = raster.index(x, y)
        assert raster.read(1)[row, column] == pytest.approx(m.heights_m[3, 10])
        assert raster.read(2)[row, column] == m.counts[3, 10]


@pytest.mark.parametrize("share", [0.05, 0.5, 0.9, 0.999])
def test_a_geotiff_that_a_full_disk_cuts_short_does_not_replace_a_good_one(tmp_path, share):
    pytest.importorskip("rasterio", reason="extra geo is not installed")
    heights = np.random.default_rng(3).random((200, 200))
    m = HeightMap.from_heights(heights, origin_m=(0, 0), grid_m=0.01)
    path = tmp_path / "m.tif"
    export(path, m.header, m.pairs)
    good = path.read_bytes()
    m.save(tmp_path / "m.npz")
    limit = int(share * len(good))
    code = (
        "import resource, sys\n"
        "from surffollow.cli.main import main\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, resource.RLIM_INFINITY))\n"
        f"main(['map', 'export', {str(tmp_path / 'm.npz')!r}, {str(path)!r}])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1, done.stderr
    assert f"cannot write {path}" in done.stderr
    assert "Traceback" not in done.stderr
    assert path.read_bytes() == good
    assert sorted(p.name for p in tmp_path.iterdir()) == ["m.npz", "m.tif"]


def test_esri_grids_of_others_are_read(tmp_path):
    path = tmp_path / "dem.asc"
    path.write_text(
        "NCOLS 3\nNROWS 2\nXLLCENTER 10\nYLLCENTER 20\nCELLSIZE 2\nNODATA_VALUE -1\n1 2 3\n4 -1 6\n"
    )
    z, origin, grid = read_esri_ascii(path)
    assert (origin, grid) == ((9.0, 19.0), 2.0)
    np.testing.assert_array_equal(z, [[4, np.nan, 6], [1, 2, 3]])
    path.write_text("ncols 3\nnrows 2\ncellsize 1\nxllcorner 0\nyllcorner 0\n1 2 3\n")
    with pytest.raises(MapFileError, match=r"3 values for 3 × 2 cells .* m; the file is cut off"):
        HeightMap.load(path)


def test_an_esri_grid_with_decimal_commas_or_in_degrees_is_refused_with_a_remedy(tmp_path):
    path = tmp_path / "dem.asc"
    path.write_text("ncols 2\nnrows 1\ncellsize 1\nxllcorner 0\nyllcorner 0\n1,5 2,5\n")
    with pytest.raises(MapFileError, match="'1,5'; write numbers with a decimal point"):
        HeightMap.load(path)
    heights = "\n".join(" ".join(str(200 + 5 * i + j) for j in range(10)) for i in range(10))
    path.write_text(f"ncols 10\nnrows 10\ncellsize 0.0002\nxllcorner 8.3\nyllcorner 48.8\n{heights}\n")
    with pytest.raises(MapFileError, match="seem to be degrees; project it to metres"):
        HeightMap.load(path)
    path.write_text(f"ncols 10\nnrows 10\ncellsize 2\nxllcorner 8.3\nyllcorner 48.8\n{heights}\n")
    assert HeightMap.load(path).shape == (10, 10)


def test_a_range_too_large_for_the_quantum_is_refused_or_gets_a_coarser_one():
    z = np.array([[0.0, 1000.0]])
    m = HeightMap.from_heights(z, origin_m=(0, 0), grid_m=30.0)
    np.testing.assert_allclose(m.heights_m, z, atol=m.quantum_m)
    with pytest.raises(UsageError, match="coarser quantum_m"):
        HeightMap.from_heights(z, origin_m=(0, 0), grid_m=30.0, quantum_m=1e-3)


def test_the_mesh_has_a_vertex_per_known_grid_and_two_triangles_per_square(tmp_path):
    heights = [[1.0, 2.0, np.nan], [3.0, 4.0, 5.0]]
    m = HeightMap.from_heights(heights, origin_m=(10, 20), grid_m=2.0, counts=np.full((2, 3), 9))
    export(tmp_path / "m.ply", m.header, m.pairs)
    head, _, body = (tmp_path / "m.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 5\n" in head
    assert b"element face 2\n" in head
    assert struct.unpack_from("<dddB", body, 0) == (11.0, 21.0, pytest.approx(1.0, abs=1e-3), 9)
    assert struct.unpack_from("<B3i", body, 5 * 25) == (3, 0, 1, 3)
    assert len(body) == 5 * 25 + 2 * 13


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    m = sampled(grids=10)
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(MapFileError, match="geo"):
        export(tmp_path / "m.tif", m.header, m.pairs)
    monkeypatch.setitem(sys.modules, "matplotlib.backends.backend_agg", None)
    with pytest.raises(MapFileError, match="plot"):
        export(tmp_path / "m.png", m.header, m.pairs)


def test_reading_and_writing_text_loads_no_numba():
    code = "import sys, surffollow.map.formats.text_file; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("more", [[], ["--counts"]])
def test_show_says_that_a_map_knows_nothing(tmp_path, more):
    m = HeightMap.over((0.0, 0.0, 0.5, 0.5), grids=1000)
    m.save(tmp_path / "m.txt")
    shown = CliRunner().invoke(map_group, ["show", str(tmp_path / "m.txt"), *more])
    ny, nx = m.shape
    assert (shown.exit_code, shown.output) == (
        0,
        f"nothing is known: none of {nx} × {ny} grids has a height\n",
    )


def test_map_commands_work_on_files(tmp_path):
    run = CliRunner()
    m = sampled()
    m.save(tmp_path / "m.txt")
    source = str(tmp_path / "m.txt")
    info = json.loads(run.invoke(map_group, ["info", source, "--json"]).output)
    assert (info["ny"], info["nx"]) == m.shape
    assert info["samples"] == m.samples
    shown = run.invoke(map_group, ["show", source, "--width", "40"])
    assert shown.exit_code == 0
    assert "?" in shown.output
    for suffix in EXPORTS:
        out = tmp_path / f"out{suffix}"
        done = run.invoke(map_group, ["export", source, str(out), "--json"])
        assert json.loads(done.stdout)["nx"] == info["nx"]
        assert out.stat().st_size > 100
    new = str(tmp_path / "new.npz")
    args = ["refocus", source, "-o", new, "--finest", "5 mm", "--json", "--", "-0.1", "0.25", "0.1", "0.4"]
    result = run.invoke(map_group, args)
    assert result.exit_code == 0, result.output
    facts = json.loads(result.output)
    assert facts["grid_m"] == pytest.approx(0.005)
    assert facts["sampled"] == 0
    result = run.invoke(map_group, ["diff", source, new, "--limit", "1mm", "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.output)["compared"] > 100
    assert run.invoke(map_group, ["diff", source, new, "--limit", "1um"]).exit_code == 1
    both = str(tmp_path / "both.txt")
    assert run.invoke(map_group, ["compose", source, new, "-o", both]).exit_code == 0
    assert HeightMap.load(both).shape[0] > 10
