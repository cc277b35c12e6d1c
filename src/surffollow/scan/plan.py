"""From a terrain grid to a timed path with attitudes: envelope, scheme, sampling, following, clearance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from surffollow.errors import ScanInputError
from surffollow.scan.body import body_points
from surffollow.scan.checks import Floats, positive
from surffollow.scan.clearance import Clearance, clear_rows, clear_ways, with_clearance
from surffollow.scan.envelope import Envelope, envelope_of
from surffollow.scan.following import advanced_terrain_following, reactionary, sample_terrain
from surffollow.scan.grid import MIN_CELLS, TerrainGrid
from surffollow.scan.kept_limits import limited_tilt, refuse_fast
from surffollow.scan.limits import WorkSpace, WristLimits
from surffollow.scan.path import OUT_OF_REACH, STOP, WRIST_LIMIT, ScanPath
from surffollow.scan.raised_heights import raised_heights
from surffollow.scan.schemes import arcs, lanes
from surffollow.scan.serpentine import outline
from surffollow.scan.shaped_motion import SAMPLES_PER_PERIOD, limited_climb, shaped_within
from surffollow.scan.shaping import Shaper
from surffollow.scan.swath import body_width
from surffollow.scan.timing import MotionLimits, timed
from surffollow.units import numbers_text

SCHEMES = ("lanes", "arcs")
FOLLOWING = ("atf", "reactionary")
STEEPEST = 4.0  # slope of a path from row to row: a steeper chord would cut a step's edge


@dataclass(frozen=True)
class PlanSettings:
    """Task of a plan.

    Attributes
    ----------
    region : (4,) or (n, 2) [m]
        rectangle or polygon to be scanned
    gap_m : float [m]
        scanning gap
    body_m : (m, 3) float [m]
        control points (`body`)
    swath_m : float [m]
        distance of passes; None: the body's width across them
    scheme : str
        "lanes" or "arcs"
    angle_rad : float
        direction of lanes
    base_m : (x, y, z) [m]
        of the arm; arcs need it (or a work space)
    following : str
        "atf" or "reactionary"
    wrist : WristLimits
    motion : MotionLimits
    step_m : float [m]
        between samples; None: one cell, but no more than half the gap and no less than a sixteenth of it
    span_m : float [m]
        slopes are taken over ± this; None: half the body's radius
    work_space : WorkSpace
        reach of the arm; None: not looked at
    shaper : Shaper
        of the planar motion (x, y; arcs: radius and azimuth); None: none

    Examples
    --------
    >>> from surffollow.scan import PlanSettings, WristLimits, disc
    >>> settings = PlanSettings((0.2, 0.2, 0.8, 0.8), 0.05, disc(0.05), wrist=WristLimits.symmetric(0.4))
    >>> settings.scheme, settings.following, settings.motion.speed_mps
    ('lanes', 'atf', 0.5)
    """

    region: ArrayLike
    gap_m: float
    body_m: ArrayLike
    swath_m: float | None = None
    scheme: str = "lanes"
    angle_rad: float = 0.0
    base_m: Sequence[float] | None = None
    following: str = "atf"
    wrist: WristLimits = field(default_factory=WristLimits)
    motion: MotionLimits = field(default_factory=MotionLimits)
    step_m: float | None = None
    span_m: float | None = None
    work_space: WorkSpace | None = None
    shaper: Shaper | None = None


def plan_scan(ground: TerrainGrid, settings: PlanSettings) -> ScanPath:
    """Plan a scan.

    Parameters
    ----------
    ground : TerrainGrid
        not expanded; cells outside the region and its margin are not used
    settings : PlanSettings

    Returns
    -------
    ScanPath
        facts hold everything that `scan check` needs

    Raises
    ------
    ScanInputError
        a region beside the map or without known ground, a gap or cells larger than the region, a map of
        fewer than 3 × 3 cells, a scheme that is none

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import PlanSettings, TerrainGrid, disc, plan_scan
    >>> ground = TerrainGrid.of(np.zeros((50, 50)), grid_m=0.02)      # flat, 1 m by 1 m
    >>> path = plan_scan(ground, PlanSettings((0.3, 0.3, 0.7, 0.7), 0.05, disc(0.05)))
    >>> round(float(path.position_m[0, 2]), 3), float(path.t_s[0]), path.poses.shape == (len(path), 7)
    (0.05, 0.0, True)
    """
    body = body_points(settings.body_m)
    gap = positive("gap_m", settings.gap_m)
    corners = outline(settings.region)
    radius = float(np.hypot(body[:, 0], body[:, 1]).max())
    turned = settings.work_space is not None
    width = body_width(body, settings.scheme, settings.angle_rad, turned=turned)
    swath = width if settings.swath_m is None else positive("swath_m", settings.swath_m)
    if swath <= 0.0:
        raise ScanInputError("the body has no width across its passes; give a swath (swath_m, --swath)")
    sides = np.ptp(corners, axis=0)
    if gap > float(sides.max()):
        raise ScanInputError(
            f"the gap of {gap:g} m is larger than the region ({sides[0]:g} × {sides[1]:g} m); "
            "is the unit metres?"
        )
    if min(ground.shape) < MIN_CELLS or ground.grid_m > float(sides.max()):
        rows, cols = ground.shape
        raise ScanInputError(
            f"a map of {rows} × {cols} cells of {ground.grid_m:g} m has no slopes in a region of "
            f"{sides[0]:g} × {sides[1]:g} m; map {MIN_CELLS} × {MIN_CELLS} cells or more, none larger than "
            "the region (is its unit metres?)"
        )
    local = _around(ground, corners, gap + radius + 1.5 * swath + _run_up_m(settings))
    envelope, compared = envelope_of(local, gap), Clearance.over(local, body)
    step = settings.step_m if settings.step_m is not None else _step_m(ground.grid_m, gap)
    base = settings.base_m
    span = settings.span_m if settings.span_m is not None else max(ground.grid_m, 0.5 * radius)

    def laid(planar: ScanPath) -> ScanPath:
        sampled = sample_terrain(planar, envelope, span_m=span)
        made = _followed(sampled, body, envelope, settings)
        if planar.t_s[-1] > 0.0:  # with times: attitudes have to keep them, and to be lifted anew
            normal, at_limit = limited_tilt(made, settings.motion.tilt_radps).normal, made.has(WRIST_LIMIT)
            made = reactionary(sampled.changed(normal=normal), body, envelope, settings.wrist)
            made = made.with_flag(WRIST_LIMIT, at_limit)
        return clear_ways(_ramped(clear_rows(made, compared, gap), step), compared, gap)

    path = laid(_scheme(settings, swath, step))
    shaper = settings.shaper
    if shaper is not None:
        rate = max(settings.motion.speed_mps / step, SAMPLES_PER_PERIOD * shaper.highest_hz)
        centre = path.facts["base_m"] if settings.scheme == "arcs" else None
        planar = shaped_within(path, shaper, rate, settings.motion, base_m=centre)
        path = laid(planar)
        path = path.with_flag(STOP, np.isin(np.arange(len(path)), (0, len(path) - 1)))
    else:
        path = timed(path, settings.motion)
    path = with_clearance(raised_heights(path, settings.motion), body, local, gap)
    refuse_fast(path, settings.motion)
    if settings.work_space is not None:
        base = settings.work_space.base_m if base is None else base
        path = path.with_flag(OUT_OF_REACH, ~settings.work_space.reachable(path.position_m, path.normal))
    facts = path.facts | {
        "gap_m": gap,
        "grid_m": ground.grid_m,
        "region_m": corners.tolist(),
        "body_m": np.round(body, 9).tolist(),
        "body_width_m": width,
        "wrist_rad": settings.wrist.as_array().tolist(),
        "following": settings.following,
        **asdict(settings.motion),
    }
    if shaper is not None:
        facts["shaper_s"] = shaper.times_s.tolist()
        facts["shaper_amplitudes"] = shaper.amplitudes.tolist()
    if base is not None:
        facts["base_m"] = [float(v) for v in base]
    return path.changed(facts=facts)


def _ramped(path: ScanPath, step_m: float) -> ScanPath:
    """A path that climbs a vertical step over several rows: between two rows a robot goes straight."""
    rows = np.arange(len(path), dtype=np.float64)
    return limited_climb(path.changed(t_s=rows), STEEPEST * step_m).changed(t_s=path.t_s)


def _step_m(grid_m: float, gap_m: float) -> float:
    """Way from row to row: its chord cuts into a ball's envelope by a thirty-second of the gap at most."""
    return min(max(grid_m, gap_m / 16.0), gap_m / 2.0)


def _around(ground: TerrainGrid, corners: Floats, margin_m: float) -> TerrainGrid:
    box = [*corners.min(axis=0).tolist(), *corners.max(axis=0).tolist()]
    inside = ground.window(box)
    if not inside.known.any():
        raise ScanInputError(f"no cell of the region {numbers_text(*box)} m is known; map it first")
    return ground.window(box, margin_m)


def _scheme(settings: PlanSettings, swath: float, step: float) -> ScanPath:
    if settings.scheme == "lanes":
        angle, way = settings.angle_rad, _run_up_m(settings)
        path = lanes(settings.region, swath, step_m=step, angle_rad=angle, run_up_m=way)
        if settings.work_space is not None:
            tip = np.nan_to_num(path.position_m)
            return path.changed(azimuth_rad=np.unwrap(settings.work_space.azimuth_rad(tip)))
        return path
    if settings.scheme != "arcs":
        raise ScanInputError(f"scheme is '{settings.scheme}'; expected one of {', '.join(SCHEMES)}")
    base = settings.base_m
    if base is None and settings.work_space is not None:
        base = settings.work_space.base_m
    if base is None:
        raise ScanInputError("arcs need the place of the arm's base joint; give it (base_m, --base)")
    return arcs(settings.region, swath, step_m=step, base_m=base, run_up_m=_run_up_m(settings))


def _run_up_m(settings: PlanSettings) -> float:
    """Way before a pass on which a shaped turn comes to its end."""
    return 0.0 if settings.shaper is None else settings.motion.speed_mps * settings.shaper.duration_s


def _followed(path: ScanPath, body: Floats, envelope: Envelope, settings: PlanSettings) -> ScanPath:
    if settings.following == "atf":
        return advanced_terrain_following(path, body, envelope, settings.wrist)
    if settings.following == "reactionary":
        return reactionary(path, body, envelope, settings.wrist)
    raise ScanInputError(f"following is '{settings.following}'; expected one of {', '.join(FOLLOWING)}")
