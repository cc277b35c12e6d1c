"""Figures of a plan: lengths, clearances, motion, the area that it scans in a second."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surffollow.scan.checks import Floats
from surffollow.scan.kept_limits import row_motion
from surffollow.scan.path import ScanPath, flag_counts


def plan_figures(path: ScanPath) -> dict[str, Any]:
    """Summary of a plan for its operator, before anything moves.

    Parameters
    ----------
    path : ScanPath
        a plan

    Returns
    -------
    dict
        figures by name, in SI units; flags by name. `scan_rate_m2ps`: area of the region that passes with a
        height cover, over the duration of the path

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import PlanSettings, TerrainGrid, disc, plan_figures, plan_scan
    >>> ground = TerrainGrid.of(np.zeros((50, 50)), grid_m=0.02)
    >>> figures = plan_figures(plan_scan(ground, PlanSettings((0.3, 0.3, 0.7, 0.7), 0.05, disc(0.05))))
    >>> figures["passes"], round(figures["length_m"], 2), figures["flags"]["lifted"]
    (4, 1.9, 0)
    """
    on = path.passes >= 0
    known = on & np.isfinite(path.clearance_m)
    tilt = np.degrees(np.arccos(np.clip(path.normal[:, 2], -1.0, 1.0)))
    with np.errstate(invalid="ignore", divide="ignore"):
        motion = row_motion(path)
    length = float(np.sum(np.linalg.norm(np.diff(path.position_m[on][:, :2], axis=0), axis=1)))

    def of(values: Floats, how: Any) -> float | None:
        good = values[np.isfinite(values)]
        return float(how(good)) if good.size else None

    return {
        "samples": len(path),
        "passes": int(path.passes.max()) + 1,
        "duration_s": float(path.t_s[-1]),
        "length_m": length,
        "clearance_min_m": of(path.clearance_m[known], np.min),
        "clearance_mean_m": of(path.clearance_m[known], np.mean),
        "clearance_max_m": of(path.clearance_m[known], np.max),
        "lift_max_m": of(path.lift_m[on], np.max),
        "lift_mean_m": of(path.lift_m[on], np.mean),
        "tilt_max_deg": of(tilt[on], np.max),
        "climb_max_mps": of(motion["vertical_mps"], np.max),
        "climb_max_mps2": of(motion["vertical_mps2"], np.max),
        "unplanned": int(np.count_nonzero(np.isnan(path.position_m[:, 2]))),
        "flags": flag_counts(path.flags),
        "scan_rate_m2ps": _rate(path, on),
    }


def _rate(path: ScanPath, on: NDArray[np.bool_]) -> float | None:
    """Area of the region that planned passes cover, over the duration [m²/s]; the passes cover all of it."""
    t = float(path.t_s[-1])
    if "region_m" not in path.facts or not on.any() or t <= 0.0 or not math.isfinite(t):
        return None
    x, y = np.array(path.facts["region_m"], np.float64).T
    x, y = x - x[0], y - y[0]  # far from the origin products would lose digits
    area = 0.5 * abs(float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)))
    return area * float(np.mean(np.isfinite(path.position_m[on, 2]))) / t
