"""Sensor smoothing: what becomes a reading, and what its time stamp is."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forecast.driving import MS, Kernel, default_params
from surffollow.shm.conversion import FLAG_INVALID
from surffollow.shm.layout_follow import MODE_ADAPTIVE

T = 10_000 * MS
SCALE, ZERO = 0.1016 / 4095, 0.0508


def counts(n, channel=0, flags=0, first_ns=-1000, step_ns=100, value=2000):
    return [(first_ns + k * step_ns, channel, flags, value + k) for k in range(n)]


def sensed(kernel):
    return kernel.state[0]["sense"]


def test_a_reading_is_the_mean_of_the_newest_sensor_readings_conversions():
    k = Kernel(default_params(sensor_readings=7))
    k.step(T, conversions=counts(20, value=2000))
    assert sensed(k)["fresh"][0] == 1
    assert sensed(k)["range_m"][0] == pytest.approx(ZERO + SCALE * np.mean(range(2013, 2020)), abs=1e-15)


def test_a_reading_is_stamped_at_the_middle_of_its_conversions_less_the_latency():
    k = Kernel(default_params(sensor_readings=3, sensor_latency_ns=30 * MS))
    k.step(T, conversions=[(-500, 0, 0, 2000), (-300, 0, 0, 2000), (-200, 0, 0, 2000), (-100, 0, 0, 2000)])
    assert sensed(k)["range_t_ns"][0] == T - 200 - 30 * MS


def test_the_window_spans_cycles():
    k = Kernel(default_params(sensor_readings=7))
    for cycle in range(3):
        k.step(T + cycle * MS, conversions=counts(3))
        assert sensed(k)["fresh"][0] == (1 if cycle == 2 else 0)


def test_a_slow_sensor_has_a_reading_behind_one_that_it_missed():
    """GIVEN a conversion per step, one of them a loss THEN the distance is missing in that step alone.

    It was missing until seven came in a row: 3.5 s at 2 Hz, with the demand VALID.
    """
    k = Kernel(default_params(sensor_readings=7, mode=MODE_ADAPTIVE))
    for cycle in range(20):
        flag = FLAG_INVALID if cycle == 10 else 0
        o = k.step(T + cycle * 500 * MS, conversions=[(-1, 0, flag, 2000)])
        assert math.isnan(o["range_m"][0]) == (cycle == 10)


@pytest.mark.parametrize("bad", ["flag", "near limit", "far limit", "below zero", "beyond the converter"])
def test_an_invalid_conversion_ends_the_reading_and_no_mean_spans_the_loss(bad):
    k = Kernel(default_params(sensor_readings=7))
    k.step(T, conversions=counts(7))
    word = {
        "flag": (-1, 0, FLAG_INVALID, 2000),
        "near limit": (-1, 0, 0, 0),
        "far limit": (-1, 0, 0, 4095),
        "below zero": (-1, 0, 0, -(1 << 23)),
        "beyond the converter": (-1, 0, 0, (1 << 23) - 1),
    }[bad]
    o = k.step(T + MS, conversions=[word])
    assert sensed(k)["valid"][0] == 0
    assert math.isnan(o["range_m"][0])
    k.step(T + 2 * MS, conversions=counts(6, value=1000))
    assert sensed(k)["fresh"][0] == 0
    k.step(T + 3 * MS, conversions=counts(1, value=1000))
    assert sensed(k)["fresh"][0] == 1
    assert sensed(k)["range_m"][0] < ZERO + SCALE * 1010


def test_channels_do_not_mix_and_disabled_channels_do_not_exist():
    k = Kernel(default_params(sensor_readings=2, n_channels=3))
    words = [(-10 * (8 - c) + i, c, 0, 500 * (c + 1)) for i in range(2) for c in range(8) if c < 7]
    o = k.step(T, poses=[(T, (0, 0, 0.2, 0, 0, 0, 1))], conversions=words)
    assert int(o["fresh"]) == 0b111
    for c in range(3):
        assert o["range_m"][c] == pytest.approx(ZERO + SCALE * 500 * (c + 1), abs=1e-15)
    assert np.isnan(o["range_m"][3:]).all()


def test_an_old_reading_stays_readable_and_is_not_fresh_again():
    k = Kernel(default_params())
    pose = [(T, (0, 0, 0.2, 0, 0, 0, 1))]
    first = k.step(T, poses=pose, conversions=counts(7)).copy()
    second = k.step(T + MS)
    assert int(first["fresh"]) == 1
    assert int(second["fresh"]) == 0
    assert second["range_m"][0] == first["range_m"][0]


@pytest.mark.parametrize("mode", [0, 1])
@pytest.mark.parametrize("latency_ns", [0, 60 * MS])
def test_a_reading_is_reported_for_the_time_of_extrapolation_and_no_longer(mode, latency_ns):
    k = Kernel(default_params(mode=mode, sensor_latency_ns=latency_ns, loss_timeout_ns=40 * MS))
    pose = (0, 0, 0.2, 0, 0, 0, 1)
    first = float(k.step(T, poses=[(T, pose)], conversions=counts(7))["range_m"][0])
    assert first == first
    last_ns = int(sensed(k)["range_t_ns"][0]) + latency_ns + 40 * MS
    assert k.step(last_ns, poses=[(last_ns, pose)])["range_m"][0] == first
    assert math.isnan(k.step(last_ns + 1, poses=[(last_ns + 1, pose)])["range_m"][0])
    assert k.step(T + 500 * MS, conversions=counts(7))["range_m"][0] == first


def test_a_reading_that_just_came_is_reported_whatever_its_age():
    k = Kernel(default_params(sensor_readings=64, loss_timeout_ns=0))
    o = k.step(T, conversions=counts(64, first_ns=-640_000, step_ns=10_000))
    assert o["range_m"][0] == o["range_m"][0]
    assert math.isnan(k.step(T + MS)["range_m"][0])


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 0.0, -0.1, 0.0508, 0.1524, 1e308])
def test_given_ranges_outside_the_window_are_no_readings(value):
    k = Kernel(default_params(sensor_readings=1))
    pose = [(T, (0, 0, 0.2, 0, 0, 0, 1))]
    o = k.step(T, poses=pose, ranges=[value], given_t_ns=T)
    assert int(o["fresh"]) == 0
    assert math.isnan(o["range_m"][0])
    o = k.step(T + MS, ranges=[0.1], given_t_ns=T + MS)
    assert int(o["fresh"]) == 1
    assert o["range_m"][0] == 0.1


def test_a_channel_that_is_given_no_range_any_more_has_no_reading():
    k = Kernel(default_params(n_channels=3, sensor_readings=1))
    k.step(T, poses=[(T, (0, 0, 0.2, 0, 0, 0, 1))], ranges=[0.1, 0.11, 0.12], given_t_ns=T)
    o = k.step(T + MS, ranges=[0.1], given_t_ns=T + MS)
    assert int(o["fresh"]) == 1
    assert o["range_m"][0] == 0.1
    assert np.isnan(o["range_m"][1:]).all()
    assert sensed(k)["valid"].tolist() == [1, 0, 0, 0, 0, 0, 0, 0]


def test_the_largest_window_uses_all_it_keeps():
    k = Kernel(default_params(sensor_readings=64))
    for cycle in range(4):
        k.step(T + cycle * MS, conversions=counts(32, value=1000 + 100 * cycle))
    expected = np.mean([*range(1200, 1232), *range(1300, 1332)])
    assert sensed(k)["range_m"][0] == pytest.approx(ZERO + SCALE * expected, abs=1e-14)


@pytest.mark.parametrize("mode", [0, 1], ids=["paper", "adaptive"])
def test_a_reading_that_was_overtaken_empties_no_window(mode):
    """GIVEN ranges at 50 Hz WHEN every tenth arrives behind the next one THEN none counts as lost.

    The negative gap became a spacing of 1 ns, and every later sample came after a gap.
    """
    kernel = Kernel(default_params(sensor_readings=4, mode=mode))
    order = list(range(200))
    for k in range(10, 199, 10):
        order[k], order[k + 1] = order[k + 1], order[k]
    pose = [0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0]
    for k, at in enumerate(order):
        now = T + 20 * k * MS
        kernel.step(now, poses=[(now, pose)], ranges=[0.1], given_t_ns=T + 20 * at * MS)
        kernel.step(now + MS, ranges=[math.nan], given_t_ns=now + MS)
    assert kernel.state["sense"]["losses"][0][0] <= 1, "no spacing is known in the first gap"
    assert kernel.state["sense"]["spacing_ns"][0][0] >= 20 * MS
