"""Forecasts of the range from a CSV log: paired with what came, scored, summarised."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surffollow.record.columns import Columns
from surffollow.record.csv_plausibility import other_time_unit
from surffollow.record.csv_points import pose_notes
from surffollow.record.csv_replay import CsvReplay, follow_notes, horizon_notes
from surffollow.record.csv_times import ISO_UNIT, date_text


def score_forecast(replay: CsvReplay, columns: Columns) -> list[dict[str, float]]:
    """RMS error of the forecasts and of "no change", over the same pairs of rows, per horizon.

    A pair is a row with a reading and a forecast at t, and the first later row with a reading
    at or after t + horizon, unless it is more than the column file's `match` later.
    """
    rows = []
    for k, horizon_s in enumerate(columns.horizons_s):
        pairs = pair_forecasts(replay, columns, k)
        rows.append(
            {
                "horizon_s": horizon_s,
                "rms_m": _rms(pairs.forecast_m - pairs.truth_m),
                "no_change_rms_m": _rms(pairs.present_m - pairs.truth_m),
                "n": pairs.t_s.size,
            }
        )
    return rows


class Pairs(NamedTuple):
    """Forecasts and what came, (n,) each: time of the truth [s], forecast, truth, reading then [m]."""

    t_s: NDArray[np.float64]
    forecast_m: NDArray[np.float64]
    truth_m: NDArray[np.float64]
    present_m: NDArray[np.float64]


def pair_forecasts(replay: CsvReplay, columns: Columns, horizon: int) -> Pairs:
    """The pairs of one horizon (by its number) that `score_forecast` scores."""
    has = np.isfinite(replay.log.range_m)
    t, r = replay.log.elapsed_s()[has], replay.log.range_m[has]
    slack_s = replay.log.slack_s()  # times written as decimals must not miss by their last bit
    horizon_s = columns.horizons_s[horizon]
    forecast = replay.forecast_m[has, horizon]
    j = np.searchsorted(t, t + horizon_s - slack_s)
    inside = (j < t.size) & np.isfinite(forecast)
    inside[inside] &= t[j[inside]] - t[inside] - horizon_s <= columns.match_s + slack_s
    then = j[inside]
    return Pairs(t[then], forecast[inside], r[then], r[inside])


def _rms(errors: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(errors**2))) if errors.size else math.nan


def _difference(values: NDArray[np.float64], reference: NDArray[np.float64]) -> dict[str, Any]:
    d = (values - reference)[np.isfinite(values) & np.isfinite(reference)]
    if d.size == 0:
        return {"n": 0, "mean_m": None, "std_m": None}
    return {"n": int(d.size), "mean_m": float(d.mean()), "std_m": float(d.std())}


def unscored_notes(replay: CsvReplay, columns: Columns, rows: list[dict[str, float]]) -> list[str]:
    """Why no forecast of any horizon met a reading, as text."""
    if not rows or any(row["n"] for row in rows):
        return []
    over = ", ".join(f"{row['horizon_s']:g}" for row in rows)
    t_s = replay.log.elapsed_s()[np.isfinite(replay.log.range_m)]
    readings = f"{t_s.size} readings"
    if t_s.size > 1:
        interval_s = float(np.median(np.diff(t_s)))
        other = other_time_unit(columns, interval_s)
        readings += f" (over {np.ptp(t_s):g} s, {interval_s:g} s apart{other and '; ' + other})"
    return [
        f"no forecast over {over} s could be compared: none of the {readings} came within "
        f'{columns.match_s:g} s after a horizon; check [time] unit = "{columns.time.unit}", and [forecast] '
        "horizons and match"
    ]


def _dates(columns: Columns, start_s: float, end_s: float) -> dict[str, str]:
    """First and last time as dates, of a log that has dates."""
    if columns.time.unit != ISO_UNIT:
        return {}
    return {"start": date_text(start_s), "end": date_text(end_s)}


def summarise(path: str | Path, replay: CsvReplay, columns: Columns) -> dict[str, Any]:
    """The replay in one dictionary, ready for JSON (a figure that does not exist is None)."""
    log = replay.log
    heights = replay.height_m[np.isfinite(replay.height_m)]
    slopes = replay.slope[np.isfinite(replay.slope)]
    scores = score_forecast(replay, columns)
    out: dict[str, Any] = {
        "file": str(path),
        "mode": replay.mode,
        "rows": int(log.t_s.size),
        "readings": int(np.isfinite(log.range_m).sum()),
        "start_s": float(log.t_s[0]),
        "end_s": float(log.t_s[-1]),
        **_dates(columns, float(log.t_s[0]), float(log.t_s[-1])),
        "height_m": {"min": float(heights.min()), "mean": float(heights.mean()), "max": float(heights.max())},
        "slope": {"min": float(slopes.min()), "mean": float(slopes.mean()), "max": float(slopes.max())},
        "notes": [*log.notes]
        + follow_notes(columns, replay.mode)
        + horizon_notes(columns, replay.mode)
        + unscored_notes(replay, columns, scores)
        + pose_notes(log, replay.target_m),
        "forecast": [{k: None if v != v else v for k, v in row.items()} for row in scores],
    }
    if log.reference_m is not None and columns.reference is not None:
        out["reference"] = {
            "column": columns.reference.column,
            "height": _difference(replay.height_m, log.reference_m),
            "target": _difference(replay.target_m[:, 2], log.reference_m),
        }
    return out
