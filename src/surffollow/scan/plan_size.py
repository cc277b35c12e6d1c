"""Refuse, before the work, a plan with too many rows: which number makes them, and what is sensible."""

from __future__ import annotations

import numpy as np

from surffollow.errors import ScanInputError
from surffollow.scan.body import body_points
from surffollow.scan.plan import PlanSettings
from surffollow.scan.serpentine import outline
from surffollow.scan.swath import body_width

MAX_SAMPLES = 1_000_000  # rows: 5 km of passes at 5 mm; a plan of so many takes 4 GB of memory
SAMPLES_PER_S = 1000.0  # of planning, about


def refuse_large_plan(settings: PlanSettings, grid_m: float) -> float:
    """Raise where the rows of a plan would be too many.

    Parameters
    ----------
    settings : PlanSettings
    grid_m : float [m]      side of the map's cells

    Returns
    -------
    float
        about how many rows the passes will have; 0 where the planner refuses the settings

    Raises
    ------
    ScanInputError
        the run-up that a shaper needs, or the passes, make more than `MAX_SAMPLES` rows
    """
    corners = outline(settings.region)
    length = float(np.hypot(*np.ptp(corners, axis=0)))
    step = settings.step_m
    if step is None:
        step = min(max(grid_m, settings.gap_m / 16.0), settings.gap_m / 2.0)
    shaper = settings.shaper
    run_up = 0.0 if shaper is None else settings.motion.speed_mps * shaper.duration_s
    if shaper is not None and run_up / step > MAX_SAMPLES:
        raise ScanInputError(
            f"a mode of {shaper.highest_hz:g} Hz (--lateral-mode) needs a run-up of {run_up:.3g} m before "
            f"each pass, at {settings.motion.speed_mps:g} m/s; modes of arms are from about 0.1 Hz to 50 Hz"
        )
    turned = settings.work_space is not None
    width = body_width(body_points(settings.body_m), settings.scheme, settings.angle_rad, turned=turned)
    swath = settings.swath_m if settings.swath_m is not None else width
    if swath <= 0.0:
        return 0.0  # the planner names what is missing
    samples = (length / swath + 1.0) * (length + 2.0 * run_up) / step
    if samples > MAX_SAMPLES:
        what = "--swath" if settings.swath_m is not None else "--body, whose width is the swath"
        why = " (half of --gap)" if settings.step_m is None and step < grid_m else ""
        raise ScanInputError(
            f"passes {swath:.3g} m apart ({what}) over a region of {length:.3g} m make about {samples:.2g} "
            f"samples, {step:.3g} m apart{why}; at most {MAX_SAMPLES:.0e}: choose a smaller region, or "
            "parts of it, or a larger swath or gap (are map and region in metres?)"
        )
    return samples
