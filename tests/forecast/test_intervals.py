"""Intervals and ranges: spacing, path interpolation, the ring's cap, two-point slope."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naive import NaiveIntervals
from surffollow.forecast.paper.intervals import add_point, cut_ranges, range_slope
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_follow import INTERVALS, PaperState

metres = st.floats(-1e3, 1e3, allow_nan=False)
sizes = st.floats(1e-4, 1e2)
walks = st.lists(st.tuples(metres, metres, metres), min_size=1, max_size=30)
# steps of a few interval sizes: where the three rules meet
short = st.floats(-3.0, 3.0)
short_walks = st.lists(st.tuples(short, short, st.floats(-1.0, 1.0)), min_size=1, max_size=60)


def newest(p):
    k = (int(p["interval_count"]) - 1) % INTERVALS
    return tuple(float(p[n][k]) for n in ("interval_x_m", "interval_y_m", "interval_h_m"))


def interval(p, number):
    k = number % INTERVALS
    return tuple(float(p[n][k]) for n in ("interval_x_m", "interval_y_m", "interval_h_m"))


def distance(a, b):
    return math.hypot(a[0] - b[0], a[1] - b[1])


def walk_with(points, size, check):
    p = zeros(PaperState)[0]
    for point in points:
        before, count = (newest(p) if p["interval_count"] else None), int(p["interval_count"])
        opened = add_point(p, *point, size)
        assert int(p["interval_count"]) == count + opened
        check(p, before, count, point, opened)
    return p


@settings(max_examples=150, deadline=None)
@given(walks, sizes)
def test_after_every_point_the_current_centre_is_within_interval_size_of_it(points, size):
    def check(p, before, count, point, opened):
        slack = size * 1e-9 + 1e-12
        assert distance(newest(p), point) <= size + slack

    walk_with(points, size, check)


@settings(max_examples=150, deadline=None)
@given(short_walks, st.floats(1e-4, 10.0))
def test_a_point_inside_joins_beyond_opens_and_far_beyond_fills_the_way(steps, size):
    x = y = 0.0
    points = []
    for dx, dy, h in steps:
        x, y = x + dx * size, y + dy * size
        points.append((x, y, h))

    def check(p, before, count, point, opened):
        if before is None:
            assert opened == 1
            return
        d = math.sqrt((point[0] - before[0]) ** 2 + (point[1] - before[1]) ** 2)
        if d <= size * (1 - 1e-12):
            assert opened == 0
            assert newest(p)[:2] == before[:2], "a centre moved"
        elif size * (1 + 1e-12) < d <= 2 * size * (1 - 1e-12):
            assert opened == 1
            assert newest(p) == point
        elif d > 2 * size * (1 + 1e-12):
            assert opened in (math.floor(d / size * (1 - 1e-12)), math.floor(d / size * (1 + 1e-12)))
            previous = before
            for k in range(count, count + opened):
                here = interval(p, k)
                assert distance(here, previous) == pytest.approx(size, rel=1e-6)
                if k < count + opened - 1:  # the newest also holds the point itself
                    part = distance(here, before) / d
                    assert here[2] == pytest.approx(before[2] + (point[2] - before[2]) * part, abs=1e-9)
                previous = here

    walk_with(points, size, check)


@settings(max_examples=60, deadline=None)
@given(walks, st.floats(1e-4, 1e-2))
def test_a_jump_opens_at_most_a_ring_full_and_those_are_the_last_of_the_way(points, size):
    def check(p, before, count, point, opened):
        assert opened <= INTERVALS
        if opened == INTERVALS:
            assert distance(newest(p), point) <= size * (1 + 1e-9) + 1e-12
            oldest = interval(p, count)
            assert distance(oldest, point) <= (INTERVALS + 1) * size * (1 + 1e-6)

    walk_with(points, size, check)


@settings(max_examples=100, deadline=None)
@given(short_walks, st.floats(1e-4, 10.0), st.integers(1, 6))
def test_intervals_and_slope_have_the_bits_of_the_twin(steps, size, range_size):
    p, twin, x, y = zeros(PaperState)[0], NaiveIntervals(), 0.0, 0.0
    for dx, dy, h in steps:
        x, y = x + dx * size, y + dy * size
        opened = add_point(p, x, y, h, size)
        if opened > 0:
            cut_ranges(p, range_size)
        assert opened == twin.add(x, y, h, size)
        current = twin.ring[-1]
        assert newest(p) == (current.x, current.y, current.height)
        assert range_slope(p, range_size) == twin.slope(range_size)


@settings(max_examples=100, deadline=None)
@given(short_walks, st.floats(1e-3, 10.0), st.integers(1, 6))
def test_ranges_are_disjoint_hold_the_newest_and_give_the_slope_between_their_means(steps, size, n):
    p, x, y = zeros(PaperState)[0], 0.0, 0.0
    for dx, dy, h in steps:
        x, y = x + dx * size, y + dy * size
        if add_point(p, x, y, h, size) > 0:
            cut_ranges(p, n)
        count = int(p["interval_count"])
        if count < 2 * n:
            assert range_slope(p, n) == 0.0
            continue
        both = np.array([interval(p, k) for k in range(count - 2 * n, count)])
        previous, current = both[:n].mean(axis=0), both[n:].mean(axis=0)
        along = np.concatenate([[0.0], np.hypot(*np.diff(both[:, :2], axis=0).T).cumsum()])
        gap = along[n:].mean() - along[:n].mean()
        if gap > 1e-6 * size:
            expected = (current[2] - previous[2]) / gap
            tolerance = 1e-11 * (1.0 + abs(both[:, :2]).max()) / gap
            assert range_slope(p, n) == pytest.approx(expected, rel=max(1e-9, tolerance), abs=1e-9)


def test_the_mean_of_an_interval_is_the_mean_of_its_points():
    rng = np.random.default_rng(3)
    heights = rng.normal(0.1, 1e-3, 500)
    p = zeros(PaperState)[0]
    for h in heights:
        add_point(p, rng.uniform(-0.4, 0.4), 0.0, h, 1.0)
    assert int(p["interval_count"]) == 1
    assert newest(p)[2] == pytest.approx(heights.mean(), abs=1e-15)


def test_a_path_that_dithers_on_an_interval_border_does_not_oscillate_between_two_intervals():
    p = zeros(PaperState)[0]
    add_point(p, 0.0, 0.0, 0.0, 1.0)
    opened = [add_point(p, 1.0 + d, 0.0, 0.0, 1.0) for d in (0.01, -0.01, 0.01, -0.01, 0.01)]
    assert opened == [1, 0, 0, 0, 0]


def test_a_plane_gives_its_slope_whatever_the_heading():
    for heading in np.linspace(0.0, 2.0 * math.pi, 17):
        p, slope = zeros(PaperState)[0], 0.2
        for way in np.arange(0.0, 0.1, 0.0007):
            x, y = way * math.cos(heading), way * math.sin(heading)
            if add_point(p, x, y, slope * way, 0.002) > 0:
                cut_ranges(p, 5)
        assert range_slope(p, 5) == pytest.approx(slope, rel=0.02)


def test_ranges_whose_centres_coincide_have_the_slope_along_the_path_between_them():
    p = zeros(PaperState)[0]
    # there and back over the same places: A B A B, so both ranges of two have one centre
    for k in range(8):
        if add_point(p, 1.5 * (k % 2), 0.0, float(k), 1.0) > 0:
            cut_ranges(p, 2)
    assert int(p["interval_count"]) == 8
    assert range_slope(p, 2) == pytest.approx(2.0 / 3.0)


def test_a_ring_that_wrapped_many_times_still_cuts_the_newest():
    p = zeros(PaperState)[0]
    for k in range(5 * INTERVALS + 7):
        if add_point(p, 1.5 * k, 0.0, 0.1 * k, 1.0) > 0:
            cut_ranges(p, INTERVALS // 2)
    assert range_slope(p, INTERVALS // 2) == pytest.approx(0.1 / 1.5, rel=1e-9)
