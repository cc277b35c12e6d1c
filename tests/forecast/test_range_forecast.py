"""Forecast of the range: a damped trend with a learnt return to the mean."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surffollow.follower.range_forecast import (
    RangeForecast,
    observe_range,
    predict_range,
    return_gain,
    update_forecast,
)
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_follow import FollowState, Params

from .feeding import MS, default_params


def test_the_forecast_follows_a_ramp_rejects_a_spike_and_accepts_a_jump():
    forecast = zeros(RangeForecast)[0]
    for k in range(400):
        update_forecast(
            default_params(),
            forecast,
            10**9 + k * 100 * MS,
            5.0 + 0.03 * k * 0.1 + (2.0 if k == 350 else 0.0),
        )
    # the trend decays: a third of the change over the horizon is missing
    assert predict_range(forecast, 0.5) == pytest.approx(5.0 + 0.03 * (39.9 + 0.5), abs=5e-3)
    for k in range(400, 403):
        update_forecast(default_params(), forecast, 10**9 + k * 100 * MS, 8.0)
    assert predict_range(forecast, 0.0) == pytest.approx(8.0, abs=0.1)


@pytest.mark.parametrize(("horizon_s", "sigmas"), [(0.2, 1.5), (2.0, 4.0)])
def test_the_forecast_of_a_constant_range_is_constant(horizon_s, sigmas):
    """GIVEN readings every 0.1 s with noise THEN the trend that they seem to have is small 20 ahead, too."""
    forecast, rng, errors = zeros(RangeForecast)[0], np.random.default_rng(2), []
    for k in range(2000):
        update_forecast(default_params(), forecast, 10**9 + k * 100 * MS, 2.0 + 0.01 * rng.standard_normal())
        errors.append(predict_range(forecast, horizon_s) - 2.0)
    assert abs(np.mean(errors[100:])) < 1e-3
    assert np.std(errors[100:]) < 0.01 * sigmas


def naive_forecasts(t_s, ranges_m, horizon_s, most=1.0):
    """Forecasts by a trend with a learnt return to the mean, from its formulas; no outliers, no gaps."""
    made, level, trend, mean, mean_s, interval, check = [], ranges_m[0], 0.0, ranges_m[0], 0.0, 0.0, None
    products, gain = np.zeros(2), 0.0

    def parts(h):
        w = 15.0 * unit * (1.0 - math.exp(-h / (15.0 * unit)))
        share = 1.0 - math.exp(-(h - w) / (15.0 * unit))
        return np.array([level + trend * w, share * (mean - level)])

    for k in range(1, len(t_s)):
        dt = t_s[k] - t_s[k - 1]
        interval += (min(dt, 2 * interval) - interval) / 20 if interval else dt
        unit = max(interval, 0.12)

        def weight(duration_s, intervals, unit=unit):
            return 1.0 - math.exp(-duration_s / (intervals * unit))

        expected = parts(dt) @ (1.0, gain)
        new = expected + weight(dt, 0.45) * (ranges_m[k] - expected)
        back = gain * (mean - level) / (15.0 * unit)
        trend += weight(dt, 15.0) * (back - trend)
        trend += weight(dt, 2.5) * ((new - level) / dt - trend)
        level = new
        mean_s = min(mean_s + dt, 1000.0 * unit)
        mean += (1.0 - math.exp(-dt / mean_s)) * (level - mean)
        if check is None or t_s[k] - check[0] >= 15.0 * unit:
            if check is not None:
                missed, back_m = level - check[1], check[2]
                share = weight(t_s[k] - check[0], 1000.0)
                products += share * (np.array([missed * back_m, back_m**2]) - products)
                gain = float(np.clip(products[0] / products[1], 0.0, most))
            check = t_s[k], *parts(15.0 * unit)
        made.append(parts(horizon_s) @ (1.0, gain))
    return np.array(made), gain


def swinging_ranges(n):
    """Times [s] and ranges [m] of a controlled distance that noise disturbs, at uneven intervals."""
    rng, distance, rate, ranges = np.random.default_rng(5), 0.0, 0.0, []
    t_s = np.cumsum(rng.integers(80, 250, n)) * 1e-3
    for dt in np.diff(t_s, prepend=0.0):
        rate += dt * (-0.5 * distance - 1.0 * rate) + 0.1 * math.sqrt(dt) * rng.standard_normal()
        distance += dt * rate
        ranges.append(3.0 + distance + 0.003 * rng.standard_normal())
    return t_s, np.array(ranges)


def forecasts(t_s, ranges_m, horizon_s):
    """Forecasts after every range but the first, and the record."""
    forecast, made = zeros(RangeForecast)[0], []
    for t, range_m in zip(t_s, ranges_m, strict=True):
        update_forecast(default_params(), forecast, 10**9 + round(t * 1e9), range_m)
        made.append(predict_range(forecast, horizon_s))
    return np.array(made[1:]), forecast


def test_the_forecast_agrees_with_its_naive_twin():
    t_s, ranges_m = swinging_ranges(1500)
    made, forecast = forecasts(t_s, ranges_m, 1.5)
    twin, gain = naive_forecasts(t_s, ranges_m, 1.5)
    assert forecast["seen_ns"] == forecast["t_ns"]
    assert return_gain(forecast) == pytest.approx(gain, rel=1e-6)
    np.testing.assert_allclose(made, twin, atol=1e-8)


def test_the_forecast_returns_to_the_mean_only_where_the_range_does():
    t_s, ranges_m = swinging_ranges(3000)
    made, forecast = forecasts(t_s, ranges_m, 2.0)
    assert return_gain(forecast) > 0.5
    later = np.interp(t_s[1:] + 2.0, t_s, ranges_m)
    trend, _ = naive_forecasts(t_s, ranges_m, 2.0, most=0.0)
    seen = slice(500, -20)
    errors = [np.sqrt(np.mean((f[seen] - later[seen]) ** 2)) for f in (made, trend)]
    assert errors[0] < 0.95 * errors[1]
    _, forecast = forecasts(t_s, 3.0 + 0.05 * t_s, 2.0)  # a slope
    assert return_gain(forecast) == 0.0


def test_the_forecast_begins_its_mean_after_a_jump_and_a_gap():
    t_s, ranges_m = swinging_ranges(600)
    for late_s in (0.2, 60.0):
        made, forecast = forecasts(
            np.r_[t_s, t_s[-1] + late_s + 0.1 * np.arange(3)], np.r_[ranges_m, 8.0, 8.0, 8.0], 30.0
        )
        assert forecast["mean_m"] == pytest.approx(8.0, abs=0.01)
        assert made[-1] == pytest.approx(8.0, abs=0.5)


def test_a_value_that_the_sensor_holds_is_one_range():
    """GIVEN a value that is read again within `hold` THEN it counts once; behind that it counts again."""
    params, state, forecast = zeros(Params), zeros(FollowState), zeros(RangeForecast)
    params["hold_ns"], params["plant_tau_s"], sense = 50 * MS, 0.04, state[0]["sense"]
    seen = []
    for t_ms, range_m, fresh in (
        (1000, 2.0, 1),
        (1010, 2.0, 1),
        (1020, 2.1, 1),
        (1030, 2.2, 0),
        (1070, 2.1, 1),
    ):
        sense["fresh"][0], sense["range_m"][0], sense["range_t_ns"][0] = fresh, range_m, t_ms * MS
        observe_range(params, state, forecast)
        seen.append(int(forecast[0]["seen_ns"]) // MS)
    assert seen == [1000, 1000, 1020, 1020, 1070]


def test_behind_a_pause_the_first_range_counts_at_once():
    """GIVEN ranges of 2 m WHEN there are none for 10 s THEN one of 8 m is no outlier."""
    forecast = zeros(RangeForecast)[0]
    for t_ns, range_m in [(10**9 + k * 100 * MS, 2.0 + 1e-3 * (k % 3)) for k in range(100)]:
        update_forecast(default_params(), forecast, t_ns, range_m)
    update_forecast(default_params(), forecast, t_ns + 10 * 10**9, 8.0)
    assert predict_range(forecast, 0.0) == 8.0
