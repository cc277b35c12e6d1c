"""Score a run: stand-off error, clearance, chatter and lag."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from surffollow.benchmark.conditions import STANDOFF_M

LAG_STEP_MS = 4
LAG_SPAN_MS = 600
SIGN_DEADBAND_M = 1e-6  # smaller changes of the setpoint are rounding, not chatter


class Score(msgspec.Struct, frozen=True):
    """Figures of one run over its scored part.

    Attributes
    ----------
    rms_m, p95_m, peak_m : of the stand-off error [m]
    min_clearance_m : smallest distance between tool and ground [m]
    within_1mm, within_2_5mm : share of the time
    demand_accel_mps2 : RMS of the second difference of the setpoint per squared controller period [m/s²]
    demand_sign_changes_per_m : how often the setpoint turns, per metre of path
    lag_s : by which delay the tool resembles the ground most; NaN on flat ground
    bad_demands : demands that were not finite
    """

    rms_m: float
    p95_m: float
    peak_m: float
    min_clearance_m: float
    within_1mm: float
    within_2_5mm: float
    demand_accel_mps2: float
    demand_sign_changes_per_m: float
    lag_s: float
    bad_demands: int


def standoff_error(
    z_m: NDArray[np.float64], ground_m: NDArray[np.float64], standoff_m: float = STANDOFF_M
) -> NDArray[np.float64]:
    """Stand-off error [m]: positive when the tool is too high."""
    return np.asarray(z_m - ground_m - standoff_m, np.float64)


def score(
    z_m: NDArray[np.float64],
    ground_m: NDArray[np.float64],
    setpoints_m: NDArray[np.float64],
    first_ms: int,
    tick_ms: int,
    speed_mps: float,
    bad_demands: int = 0,
    lag: bool = True,
    standoff_m: float = STANDOFF_M,
) -> Score:
    """Score one run.

    Parameters
    ----------
    z_m, ground_m : (ms,) float64, true height of the tool and the ground under it [m]
    setpoints_m : (ticks,) float64 [m]
    first_ms : the first millisecond that counts
    tick_ms, speed_mps : of the run
    standoff_m : desired distance between tool and ground [m]
    lag : False leaves the (slow) cross-correlation out
    """
    e = np.abs(standoff_error(z_m, ground_m, standoff_m)[first_ms:])
    p = setpoints_m[first_ms // tick_ms : (len(z_m) - 1) // tick_ms + 1]
    dt = tick_ms * 1e-3
    accel = np.diff(p, 2) / dt**2
    move = np.diff(p)
    move = np.sign(move[np.abs(move) > SIGN_DEADBAND_M])
    path_m = len(e) * 1e-3 * speed_mps
    return Score(
        rms_m=float(np.sqrt(np.mean(e * e))),
        p95_m=float(np.partition(e, int(0.95 * (len(e) - 1)))[int(0.95 * (len(e) - 1))]),
        peak_m=float(e.max()),
        min_clearance_m=float((z_m - ground_m)[first_ms:].min()),
        within_1mm=float(np.mean(e <= 1e-3)),
        within_2_5mm=float(np.mean(e <= 2.5e-3)),
        demand_accel_mps2=float(np.sqrt(np.mean(accel * accel))) if len(accel) else 0.0,
        demand_sign_changes_per_m=float(np.count_nonzero(np.diff(move)) / path_m),
        lag_s=equivalent_lag(z_m[first_ms:], ground_m[first_ms:]) if lag else math.nan,
        bad_demands=bad_demands,
    )


def equivalent_lag(z_m: NDArray[np.float64], ground_m: NDArray[np.float64]) -> float:
    """Delay [s] at which tool and ground correlate best, −0.1 to 0.5 s; NaN on flat ground."""
    z = z_m[::LAG_STEP_MS] - z_m.mean()
    g = ground_m[::LAG_STEP_MS] - ground_m.mean()
    if g.std() < 1e-6 or z.std() < 1e-9 or len(z) < 2 * LAG_SPAN_MS // LAG_STEP_MS:
        return math.nan
    n = 1 << int(len(z) + LAG_SPAN_MS // LAG_STEP_MS).bit_length()
    c = np.fft.irfft(np.fft.rfft(z, n) * np.conj(np.fft.rfft(g, n)), n)
    lags = np.arange(-100 // LAG_STEP_MS, 500 // LAG_STEP_MS + 1)
    return float(lags[np.argmax(c[lags])] * LAG_STEP_MS * 1e-3)


def interval_95(values: list[float]) -> tuple[float, float]:
    """Mean's 95 % confidence interval over seeds (Student's t); both ends the value itself for one seed."""
    n = len(values)
    mean = float(np.mean(values))
    if n < 2:
        return mean, mean
    from scipy.stats import t

    half = float(t.ppf(0.975, n - 1) * np.std(values, ddof=1) / math.sqrt(n))
    return mean - half, mean + half


def mean_score(scores: list[Score]) -> dict[str, Any]:
    """Mean over seeds of every figure, the RMS's 95 % interval; peaks and clearance are the worst seed's."""
    table = {name: [getattr(s, name) for s in scores] for name in Score.__struct_fields__}
    row: dict[str, Any] = {}
    for name, values in table.items():
        finite = [v for v in values if math.isfinite(v)]
        row[name] = float(np.mean(finite)) if finite else None
    row["worst_peak_m"] = max(table["peak_m"])
    row["min_clearance_m"] = min(table["min_clearance_m"])
    row["bad_demands"] = sum(table["bad_demands"])
    row["rms_ci95_m"] = list(interval_95(table["rms_m"]))
    row["seeds"] = len(scores)
    return row
