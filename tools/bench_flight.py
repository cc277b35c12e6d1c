"""Predict the range of a quadcopter's flight: the default follower and a damped trend over "no change".

    SURFFOLLOW_DATA=DIR python tools/bench_flight.py [--file LOG.csv --columns TOML] [--json]

The log is the first half of the flight, 40 to 450 s. The follower keeps its defaults. The damped trend
(Holt's exponential smoothing with a trend that decays, for uneven intervals) is tuned on this very log: for
all horizons at once, and per horizon. So is a linear prediction: least squares on the changes of the range
over the last 3 s and on its distance from a mean, per horizon. Its error on the log that it is fitted to is a
limit for linear predictors of the range. Each figure is an RMS error over that of "no change", on the same
pairs of rows.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from report import criterion, finish, result
from surffollow.record.columns import Columns, load_columns
from surffollow.record.csv_log import read_csv
from surffollow.record.csv_replay import CsvReplay, run_csv
from surffollow.record.forecast_scores import pair_forecasts, score_forecast
from surffollow.sim.profiles_measured import data_dir

LIMITS = {0.2: 0.78, 0.5: 0.70, 1.0: 0.75, 2.0: 0.85}  # by horizon [s]
START_S, END_S = 40.0, 450.0
COLUMNS = Path(__file__).resolve().parents[1] / "examples" / "columns" / "quad_flight.toml"
LEVEL_S = (0.01, 0.03, 0.06, 0.12, 0.25, 0.5)  # time constants that are tried
TREND_S = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
LAGS_S = (0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0, 1.4, 2.0, 3.0)  # inputs of the linear prediction
MEAN_ROWS = 300
DAMPING_S = (0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 2.5, 5.0, 20.0)

Floats = NDArray[np.float64]


def damped_trend(t_s: Floats, range_m: Floats, horizons_s: Floats, tuning: Floats) -> Floats:
    """Forecasts of a damped trend.

    Parameters
    ----------
    t_s, range_m : (n,) float64, readings
    horizons_s : (h,) float64
    tuning : (k, 3) float64, time constants [s] of level and trend, and of the decay of the trend

    Returns
    -------
    (n, h, k) float64 [m], made after each reading
    """
    level_s, trend_s, damping_s = np.ascontiguousarray(tuning.T)
    ahead = damping_s * (1.0 - np.exp(-np.divide.outer(horizons_s, damping_s)))
    level, trend = np.full(len(tuning), range_m[0]), np.zeros(len(tuning))
    forecast = np.empty((len(t_s), len(horizons_s), len(tuning)))
    forecast[0] = level
    for i in range(1, len(t_s)):
        dt = max(t_s[i] - t_s[i - 1], 1e-6)
        way = damping_s * (1.0 - np.exp(-dt / damping_s))
        before = level
        level = level + trend * way
        level = level + (1.0 - np.exp(-dt / level_s)) * (range_m[i] - level)
        trend = trend * np.exp(-dt / damping_s)
        trend = trend + (1.0 - np.exp(-dt / trend_s)) * ((level - before) / dt - trend)
        forecast[i] = level + trend * ahead
    return forecast


def grid() -> Floats:
    """Every tuning that is tried, (k, 3)."""
    return np.array(list(itertools.product(LEVEL_S, TREND_S, DAMPING_S)))


def trend_ratios(replay: CsvReplay, columns: Columns, tuning: Floats) -> Floats:
    """RMS errors of damped trends over those of "no change", (k, h), on the pairs of the replay."""
    has = np.isfinite(replay.log.range_m)
    horizons = np.array(columns.horizons_s)
    made = damped_trend(replay.log.elapsed_s()[has], replay.log.range_m[has], horizons, tuning)
    ratios = np.empty((len(tuning), len(horizons)))
    forecast = np.full((len(has), len(horizons)), np.nan)
    for k in range(len(tuning)):
        forecast[has] = made[:, :, k]
        scores = score_forecast(dataclasses.replace(replay, forecast_m=forecast), columns)
        ratios[k] = [row["rms_m"] / row["no_change_rms_m"] for row in scores]
    return ratios


def linear_ratios(replay: CsvReplay, columns: Columns) -> list[float]:
    """RMS errors of a linear prediction fitted to the log itself over those of "no change", per horizon."""
    has = np.isfinite(replay.log.range_m)
    t, r = replay.log.elapsed_s()[has], replay.log.range_m[has]
    past = np.array([np.interp(t - lag_s, t, r) for lag_s in LAGS_S]).T
    sums = np.concatenate([[0.0], np.cumsum(r)])
    begin = np.maximum(np.arange(r.size) - MEAN_ROWS, 0)
    mean = (sums[1:] - sums[begin]) / (np.arange(r.size) + 1 - begin)
    inputs = np.column_stack([past, mean]) - r[:, None]
    numbered, ratios = np.full((has.size, len(columns.horizons_s)), np.nan), []
    numbered[has] = np.arange(r.size)[:, None]
    for k in range(len(columns.horizons_s)):
        pairs = pair_forecasts(dataclasses.replace(replay, forecast_m=numbered), columns, k)
        made = inputs[pairs.forecast_m.astype(int)]
        change = pairs.truth_m - pairs.present_m
        missed = change - made @ np.linalg.lstsq(made, change, rcond=None)[0]
        ratios.append(float(np.sqrt(np.mean(missed**2) / np.mean(change**2))))
    return ratios


def measure(file: Path, columns_file: Path) -> list[dict[str, Any]]:
    """One row per horizon: errors of all predictors, and the tunings of the damped trend."""
    columns = load_columns(columns_file)
    replay = run_csv(read_csv(file, columns).between(START_S, END_S), columns)
    tried = grid()
    ratios = trend_ratios(replay, columns, tried)
    once = int(np.argmin(np.log(ratios).sum(axis=1)))
    linear = linear_ratios(replay, columns)
    rows: list[dict[str, Any]] = []
    for h, scored in enumerate(score_forecast(replay, columns)):
        own = int(np.argmin(ratios[:, h]))
        rows.append(
            {
                "horizon_s": scored["horizon_s"],
                "n": pair_forecasts(replay, columns, h).t_s.size,
                "no_change_rms_m": scored["no_change_rms_m"],
                "follower": scored["rms_m"] / scored["no_change_rms_m"],
                "linear_fit": linear[h],
                "holt": float(ratios[once, h]),
                "holt_tuning_s": tried[once].tolist(),
                "holt_per_horizon": float(ratios[own, h]),
                "holt_per_horizon_tuning_s": tried[own].tolist(),
            }
        )
    return rows


def main() -> int:
    """Predict, compare, and print the criteria; 1 when one is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--file", type=Path, help="the log; the flight in SURFFOLLOW_DATA when left out")
    parser.add_argument("--columns", type=Path, default=COLUMNS)
    parser.add_argument("--json", action="store_true")
    o = parser.parse_args()
    folder = data_dir()
    file = o.file or (folder / "quad_flight" / "flight_first_half.csv" if folder else None)
    what = "range predicted over a real flight, RMS error over that of no change"
    if file is None:
        note = "no data folder; set SURFFOLLOW_DATA to it"
        return finish(result(what, [criterion(f"{h:g} s", None, m, "", note) for h, m in LIMITS.items()], []))
    rows = measure(file, o.columns)
    criteria = [
        criterion(
            f"default follower, {r['horizon_s']:g} s",
            r["follower"],
            LIMITS[r["horizon_s"]],
            "",
            f"damped trend {r['holt']:.3f}, per horizon {r['holt_per_horizon']:.3f};"
            f" linear {r['linear_fit']:.3f}; {r['n']} pairs",
        )
        for r in rows
        if r["horizon_s"] in LIMITS
    ]
    level, trend, damping = rows[0]["holt_tuning_s"]
    notes = [f"damped trend: level {level:g} s, trend {trend:g} s, decay {damping:g} s, tuned on the log"]
    return finish(result(what, criteria, notes, rows=rows))


if __name__ == "__main__":
    sys.exit(main())
