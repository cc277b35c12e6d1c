"""MapRefocus in place: equal to the same sums out of place, exact where it must be, cut off without harm."""

from __future__ import annotations

import mmap
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from naive_map import UNKNOWN, refocused, refocused_quanta
from surffollow.errors import RegionError
from surffollow.map import HeightMap, access
from surffollow.map.header import header_fault, init_header
from surffollow.map.kernels.geometry import reset_begin, reset_step
from surffollow.map.kernels.refocus import refocus_step
from surffollow.map.kernels.refocus_plan import refocus_begin
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import numpy_dtype


def geometry(m):
    ny, nx = m.shape
    return nx, ny, *m.origin_m, m.grid_m


def fill(m, quanta, counts=7):
    m.header["datum_set"] = 1
    access.store(m.pairs, 0, quanta.astype(np.int16).reshape(-1), np.full(quanta.size, counts, np.uint8))


def quanta_of(m):
    ny, nx = m.shape
    return access.quanta(m.pairs, 0, ny * nx).reshape(ny, nx)


def random_region(rng, like=None):
    """A region of any size and place, or one near another's, on or off its lattice."""
    if like is None:
        sides, centre = 10 ** rng.uniform(-1, 1, 2), rng.uniform(-1, 1, 2)
    else:
        x0, y0, x1, y1 = like
        sides = np.array([x1 - x0, y1 - y0]) * 9 ** rng.uniform(-1, 1) * 2 ** rng.uniform(-1, 1, 2)
        centre = np.array([x0 + x1, y0 + y1]) / 2 + rng.uniform(-0.7, 0.7, 2) * sides
    if rng.random() < 0.3:
        sides, centre = np.round(sides, 1) + 0.1, np.round(centre, 1)
    return (*(centre - sides / 2), *(centre + sides / 2))


def random_map(rng, grids):
    m = HeightMap.over(random_region(rng), grids=grids, finest_m=10 ** rng.uniform(-2.5, -0.5))
    quanta = rng.integers(-32767, 32768, m.shape)
    kind = rng.integers(4)
    if kind == 1:
        quanta[rng.random(m.shape) < rng.uniform(0.05, 0.95)] = UNKNOWN
    elif kind == 2:
        quanta[m.shape[0] // 3 :, : m.shape[1] // 2] = UNKNOWN
    fill(m, quanta)
    return m


def test_500_random_refocus_pairs_equal_both_slow_twins():
    rng = np.random.default_rng(2024)
    ratios, worst, overlapping = [], 0.0, 0
    for trial in range(500):
        capacity = int(rng.integers(1, 900))
        m = random_map(rng, capacity)
        old, before = geometry(m), quanta_of(m)
        finest_m = old[4] * 2.0 ** rng.uniform(-6, 3)
        m.refocus(random_region(rng, m.extent_m), finest_m=finest_m)
        new, after = geometry(m), quanta_of(m)
        assert new[0] * new[1] <= capacity
        ratios.append(new[4] / old[4])
        np.testing.assert_array_equal(after, refocused_quanta(before, old, new), err_msg=f"trial {trial}")
        exact = refocused(np.where(before == UNKNOWN, np.nan, before.astype(float)), old, new)
        np.testing.assert_array_equal(after == UNKNOWN, np.isnan(exact), err_msg=f"trial {trial}")
        if (after != UNKNOWN).any():
            overlapping += 1
            worst = max(worst, np.nanmax(np.abs(exact - after)))
        assert not m.counts.any()
    # half a quantum of rounding, and what float32 errs in a mean of nine
    assert worst <= 0.5 + 0.01
    assert min(ratios) < 1 / 7
    assert max(ratios) > 7
    assert overlapping > 350


def test_one_two_one_onto_two_grids_gives_four_thirds_each():
    m = HeightMap.over((0, 0, 3, 1), grids=3, finest_m=1.0, quantum_m=1e-3, datum_m=0.0)
    m.add([[0.5, 0.5, 3.0], [1.5, 0.5, 6.0], [2.5, 0.5, 3.0]])
    m.refocus((0, 0, 3, 1.5), finest_m=1.5)
    assert m.shape == (1, 2)
    np.testing.assert_allclose(m.heights_m, [[4.0, 4.0]])
    assert not m.counts.any()


@pytest.mark.parametrize("height", [-32767, -1, 0, 12345, 32767])
def test_a_constant_map_stays_constant(height):
    rng = np.random.default_rng(3)
    for _ in range(40):
        m = random_map(rng, 400)
        fill(m, np.full(m.shape, height))
        finest_m = m.grid_m * 2.0 ** rng.uniform(-3, 3)
        m.refocus(random_region(rng, m.extent_m), finest_m=finest_m)
        after = quanta_of(m)
        assert set(np.unique(after)) <= {UNKNOWN, height}


def test_a_plane_is_exact_at_the_centroid_of_each_interior_overlap():
    rng = np.random.default_rng(5)
    for _ in range(40):
        m = HeightMap.over((0, 0, 4, 4), grids=1600, finest_m=0.1)
        x, y = (np.arange(40) + 0.5) * 0.1, (np.arange(40) + 0.5) * 0.1
        slope_x, slope_y = rng.uniform(-3000, 3000, 2)
        plane = np.rint(slope_x * (x[None, :] - 2) + slope_y * (y[:, None] - 2))
        fill(m, plane)
        finest_m = 0.1 * 2.0 ** rng.uniform(-3, 3)
        m.refocus(tuple(rng.uniform((0.5, 0.5, 2.5, 2.5), (1.5, 1.5, 3.5, 3.5))), finest_m=finest_m)
        ny, nx = m.shape
        # old grids are boxes: the height at a new grid's centroid is that of the area mean of boxes
        px = m.origin_m[0] + (np.arange(nx) + 0.5) * m.grid_m
        py = m.origin_m[1] + (np.arange(ny) + 0.5) * m.grid_m
        ix = np.flatnonzero((px > m.grid_m) & (px < 4 - m.grid_m))
        iy = np.flatnonzero((py > m.grid_m) & (py < 4 - m.grid_m))
        box_x, box_y = _box_centroid(px[ix], m.grid_m), _box_centroid(py[iy], m.grid_m)
        expected = slope_x * (box_x[None, :] - 2) + slope_y * (box_y[:, None] - 2)
        # half a quantum of the old map's own rounding, half of the new one's
        assert np.abs(quanta_of(m)[np.ix_(iy, ix)] - expected).max() <= 1.0 + 1e-6


def _box_centroid(centres, side):
    """Mean of the old grids' centres under [c − side/2, c + side/2], weighted by overlap (grids of 0.1)."""
    low, high = (centres - side / 2) / 0.1, (centres + side / 2) / 0.1
    whole = np.floor(low)
    total = np.zeros(centres.size)
    for k in range(int(np.ceil(side / 0.1)) + 2):
        overlap = np.clip(np.minimum(high, whole + k + 1) - np.maximum(low, whole + k), 0, None)
        total += overlap * (whole + k + 0.5)
    return total / (high - low) * 0.1


def test_a_region_beside_the_map_gives_an_empty_map():
    m = HeightMap.over((0, 0, 1, 1), grids=100, finest_m=0.1)
    fill(m, np.ones(m.shape))
    m.refocus((5, 5, 6, 6))
    assert np.isnan(m.heights_m).all()
    m.refocus((1e5, -1e5, 1e6, 1))
    assert np.isnan(m.heights_m).all()


def test_bad_regions_change_nothing():
    m = HeightMap.over((0, 0, 1, 1), grids=100, finest_m=0.1)
    fill(m, np.ones(m.shape))
    before = m.pairs.tobytes()
    for region in (
        (0, 0, 0, 1),
        (0, 0, 1, -1),
        (0, 0, float("nan"), 1),
        (0, 0, 2e6, 1),
        (float("-inf"), 0, 1, 1),
    ):
        with pytest.raises(RegionError):
            m.refocus(region)
        with pytest.raises(RegionError):
            m.reset(region)
    assert m.pairs.tobytes() == before


def test_rows_too_long_for_the_scratch_are_refused_before_anything_changed():
    m = HeightMap.over((0, 0, 100, 1), grids=10_000, finest_m=0.1)
    before = m.pairs.tobytes(), m.header[0]["generation"]
    answer = refocus_begin(m.header, np.zeros(ml.scratch_bytes(100) // 8), 0.0, 0.0, 90.0, 1.0)
    assert answer == ml.NO_SCRATCH
    assert (m.pairs.tobytes(), m.header[0]["generation"]) == before
    m.refocus((0, 0, 90, 1))
    assert m.shape[1] >= 900


def test_any_slicing_gives_the_same_map():
    results = []
    for budget in (1, 37, 5000, 10**9):
        rng = np.random.default_rng(11)
        m = random_map(rng, 2000)
        region = random_region(rng, m.extent_m)
        scratch = np.zeros(ml.scratch_bytes(2000) // 8)
        assert refocus_begin(m.header, scratch, *region) == ml.OK
        while not refocus_step(m.header, m.pairs, scratch, budget):
            assert m.header[0]["generation"] % 2 == 1
        results.append(quanta_of(m).tobytes() + m.counts.tobytes())
        assert m.header[0]["state"] == ml.READY
    assert len(set(results)) == 1


def test_a_slice_whose_progress_was_not_stored_may_be_run_again():
    """The worst cut: all of a slice's data reached memory, the journal's last word did not."""
    rng = np.random.default_rng(17)
    repeated, mark = 0, 1000
    for _ in range(60):
        m = random_map(rng, 700)
        finest_m = m.grid_m * 2.0 ** rng.uniform(-2, 2)
        region = random_region(rng, m.extent_m)
        whole = m.copy()
        whole.refocus(region, finest_m=finest_m)
        scratch = np.zeros(ml.scratch_bytes(700) // 8)
        assert refocus_begin(m.header, scratch, *region, finest_m) == ml.OK
        done = 0
        while not done:
            before = int(m.header[0]["journal_progress"])
            overlap = m.header[0]["overlap_new"], m.header[0]["overlap_old"]
            columns = max(int(side[1] - side[0]) for side in overlap)
            slot = (before & 0xFFFFFFFFFF) % 8 * columns
            ring = scratch[: 2 * columns].view(np.int16)[slot : slot + columns]
            if before >> 40 & 0xFF < 8:
                ring[:] = mark
            done = refocus_step(m.header, m.pairs, scratch, 1)
            after = int(m.header[0]["journal_progress"])
            computed = before + (1 << 40) + 1
            if not done and after == computed and rng.random() < 0.5:
                m.header["journal_progress"] = before
                repeated += 1
            elif not done and after == before + 1 and after >> 48 in (0, 2) and rng.random() < 0.5:
                # by way of the ring, and stored; or straight into its place
                by_ring = not (ring == mark).all()
                m.header["journal_progress"] = computed if by_ring else before
                mark += 1
                repeated += 1
        assert quanta_of(m).tobytes() == quanta_of(whole).tobytes()
    assert repeated > 100


VICTIM = """
import mmap, sys
import numpy as np
from surffollow.shm import map_layout as ml
from surffollow.shm.dtypes import numpy_dtype
from surffollow.map.kernels.refocus import refocus_step
from surffollow.map.kernels.refocus_plan import refocus_begin
from surffollow.map.kernels.geometry import reset_begin, reset_step

grids = int(sys.argv[2])
with open(sys.argv[1], "r+b") as f:
    memory = mmap.mmap(f.fileno(), 0)
whole = np.frombuffer(memory, np.uint8)
header = whole[: ml.MapHeader.SIZE].view(numpy_dtype(ml.MapHeader))
at = ml.pairs_offset()
pairs = whole[at : at + 6 * ml.pairs_of(grids)].view(numpy_dtype(ml.GridPair))
at = ml.scratch_offset(grids)
scratch = whole[at : at + int(header[0]["scratch_bytes"]) // 8 * 8].view(np.float64)
regions = [(0.4, 0.3, 1.5, 1.7), (0.0, 0.0, 2.0, 2.0), (0.31, 0.2, 1.93, 1.1), (-0.7, -0.1, 2.2, 2.3)]
if int(header[0]["journal_op"]):
    while not refocus_step(header, pairs, scratch, 1 << 20):
        pass
n = start = int(header[0]["refocuses"])
while n < 10**6:
    if n == start + 1:
        print("go", flush=True)
    assert refocus_begin(header, scratch, *regions[n % 4]) == 0
    while not refocus_step(header, pairs, scratch, 2000):
        pass
    n = int(header[0]["refocuses"])
"""


def test_sigkill_at_any_moment_of_a_refocus_loses_nothing(tmp_path):
    """A process refocuses a mapped file on and on and is killed; the next completes what it finds."""
    grids, path = 60_000, tmp_path / "map"
    path.write_bytes(bytes(ml.map_object_size(grids)))
    with open(path, "r+b") as f:
        memory = mmap.mmap(f.fileno(), 0)
    whole = np.frombuffer(memory, np.uint8)
    header = whole[: ml.MapHeader.SIZE].view(numpy_dtype(ml.MapHeader))
    pairs = whole[ml.pairs_offset() :][: 6 * ml.pairs_of(grids)].view(numpy_dtype(ml.GridPair))
    init_header(header, capacity_grids=grids, finest_grid_m=1e-4)
    assert reset_begin(header, 0.0, 0.0, 2.0, 2.0) == ml.OK
    while not reset_step(header, pairs, grids):
        pass
    rng = np.random.default_rng(23)
    live = HeightMap(header, pairs)
    fill(live, rng.integers(-3000, 3000, live.shape))
    regions = [(0.4, 0.3, 1.5, 1.7), (0.0, 0.0, 2.0, 2.0), (0.31, 0.2, 1.93, 1.1), (-0.7, -0.1, 2.2, 2.3)]
    twin = live.copy()
    cut = 0
    for k in range(40):
        if k >= 5 and cut > 0:
            break
        child = subprocess.Popen(
            [sys.executable, "-c", VICTIM, str(path), str(grids)], stdout=subprocess.PIPE, env=os.environ
        )
        assert child.stdout is not None
        assert child.stdout.readline() == b"go\n"
        wait_ns = int(rng.integers(1_000_000, 30_000_000))
        start = time.perf_counter_ns()
        while time.perf_counter_ns() - start < wait_ns:
            pass
        child.send_signal(signal.SIGKILL)
        child.wait()
        child.stdout.close()
        assert header_fault(header, len(pairs)) == ""
        cut += int(header[0]["journal_op"] != 0)
        done = int(header[0]["refocuses"])
        finished = live.copy()
        scratch = whole[ml.scratch_offset(grids) :][: int(header[0]["scratch_bytes"]) // 8 * 8]
        while not refocus_step(finished.header, finished.pairs, scratch.copy().view(np.float64), 1 << 30):
            pass
        while int(twin.header[0]["refocuses"]) < int(finished.header[0]["refocuses"]):
            twin.refocus(regions[int(twin.header[0]["refocuses"]) % 4])
        assert quanta_of(finished).tobytes() == quanta_of(twin).tobytes(), f"after {done} refocuses"
    assert cut > 0
    del live, header, pairs, whole
