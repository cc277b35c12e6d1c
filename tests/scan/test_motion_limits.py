"""Limits of motion from the rows of written paths, shaped or not, and what the checker finds of them."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest

import naive_field as naive
from scan.row_figures import greatest
from surffollow.cli.scan_plan import REMEDIES
from surffollow.errors import ScanInputError
from surffollow.scan.attitude_angles import normals_of, wrist_angles
from surffollow.scan.body import disc
from surffollow.scan.check import check_path
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.kept_limits import limited_tilt, refuse_fast
from surffollow.scan.limits import Annulus
from surffollow.scan.path import ScanPath
from surffollow.scan.path_file import write_path
from surffollow.scan.plan import PlanSettings, plan_scan
from surffollow.scan.shaping import Shaper
from surffollow.scan.timing import MotionLimits, timed

SHAPER = Shaper.zvd(2.0, 0.04)


def hump(steep=2.7, around_m=0.0):
    """A hump of 12 cm with flanks of 70° on gently bumpy ground, which goes on around it."""
    y, x = np.mgrid[-around_m : 1.2 + around_m : 0.01, -around_m : 1.4 + around_m : 0.01]
    flank = np.clip(0.12 - steep * np.maximum(np.hypot(x - 0.7, y - 0.6) - 0.08, 0.0), 0.0, None)
    return TerrainGrid.of(
        flank + 0.01 * np.sin(11.0 * x) * np.cos(9.0 * y), grid_m=0.01, origin_m=(-around_m, -around_m)
    )


def plan_of(folder, ground=None, **options):
    ground = hump() if ground is None else ground
    given = {"region": (0.4, 0.35, 1.0, 0.85), "gap_m": 0.05, "body_m": disc(0.1)} | options
    path = plan_scan(ground, PlanSettings(**given))
    write_path(folder / "path.csv", path)
    return path, ground, folder / "path.csv"


def findings_of(ground, file):
    return {f.name: f for f in check_path(ground.heights_m, ground.origin_m, ground.grid_m, file)}


def over(file, limits):
    """Figures above their limits by more than the rounding of a file."""
    found = greatest(file)
    return {k: v for k, v in found.items() if v > 1.005 * getattr(limits, k)}


MOTIONS = {
    "as default": MotionLimits(),
    "slow": MotionLimits(0.1, 0.5, 0.5),
    "little acceleration": MotionLimits(0.3, 0.3, 0.3),
    "much across": MotionLimits(0.4, 0.25, 2.66),
    "slow wrist": MotionLimits(0.3, 1.0, 1.0, vertical_mps=0.2, tilt_radps=0.5),
    "soft lift": MotionLimits(0.4, 1.0, 1.0, vertical_mps2=0.3),
}


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
@pytest.mark.parametrize("shaper", [None, SHAPER], ids=["plain", "shaped"])
def test_a_written_plan_keeps_every_limit_of_motion_and_its_gap(motion, shaper, tmp_path):
    _, ground, file = plan_of(tmp_path, motion=motion, shaper=shaper)
    assert over(file, motion) == {}
    found = findings_of(ground, file)
    of_motion = ("speed", "climb", "tilt_rate", "acceleration", "lateral", "vertical_acceleration")
    for name in (*of_motion, "clearance", "between_rows", "wrist", "coverage"):
        assert found[name].ok, found[name].text


@pytest.mark.parametrize("shaper", [None, SHAPER], ids=["plain", "shaped"])
def test_arcs_whose_wrist_turns_with_the_arm_keep_every_limit(shaper, tmp_path):
    motion = MotionLimits(0.4, 0.5, 0.5, tilt_radps=1.0)
    space = Annulus((0.0, 0.6, 0.5), radius_max_m=3.0)
    ground = hump(around_m=0.6)  # a shaped path swings out behind its passes
    _, ground, file = plan_of(tmp_path, ground, motion=motion, shaper=shaper, scheme="arcs", work_space=space)
    assert over(file, motion) == {}
    found = findings_of(ground, file)
    assert [f.text for f in found.values() if not f.ok] == []


def test_a_slowed_command_is_still_shaped(tmp_path):
    motion = MotionLimits(0.3, 0.3, 0.3)
    left = {}
    for name, shaper in (("shaped", SHAPER), ("plain", None)):
        path, _, _ = plan_of(
            tmp_path, TerrainGrid.of(np.zeros((120, 140)), grid_m=0.01), motion=motion, shaper=shaper
        )
        t = np.arange(0.0, path.t_s[-1] + 2.0, 1e-3)
        held = np.interp(t, path.t_s, path.position_m[:, 0])
        ring = naive.stepped_mode(held, 1e-3, 2.0, 0.04)
        left[name] = float(np.ptp(ring[t > path.t_s[-1] + 0.01]))
    assert left["plain"] > 1e-3
    assert left["shaped"] < 0.05 * left["plain"]


def test_a_large_turn_between_two_samples_counts_by_its_angle():
    xy = np.column_stack([0.1 * np.arange(7), np.zeros(7)])
    pitch = np.zeros(7)
    pitch[3:] = 2.0  # the chord of 2 rad is 1.68
    path = ScanPath.planar(xy, np.zeros(7, np.int32))
    path = path.changed(normal=normals_of(np.column_stack([pitch, np.zeros(7)]), np.zeros(7)))
    limits = MotionLimits(0.5, 2.0, 2.0)
    assert 2.0 / np.diff(timed(path, limits).t_s)[2] <= limits.tilt_radps * (1 + 1e-9)
    two = timed(path.changed(**{f.name: getattr(path, f.name)[2:4] for f in fields(path)[:-1]}), limits)
    assert 2.0 / two.t_s[1] <= limits.tilt_radps * (1 + 1e-9)


def test_attitudes_are_turned_as_little_as_the_rate_allows():
    rng = np.random.default_rng(7)
    n, rate = 300, 2.0
    t = np.cumsum(rng.uniform(0.005, 0.02, n))
    angles = np.column_stack(
        [np.where(t % 0.7 < 0.35, 0.4, -0.3), np.clip(rng.normal(0, 0.05, n), -0.1, 0.1)]
    )
    path = ScanPath.planar(np.zeros((n, 2)), np.zeros(n, np.int32), azimuth_rad=0.2 * t).changed(t_s=t)
    path = path.changed(normal=normals_of(angles, path.azimuth_rad))
    made = limited_tilt(path, rate)
    turned = np.arccos(np.clip((made.normal[1:] * made.normal[:-1]).sum(axis=1), -1.0, 1.0)) / np.diff(t)
    assert turned.max() <= rate * (1 + 1e-6)
    slow = wrist_angles(made.normal, path.azimuth_rad)
    assert (slow.min(axis=0) >= angles.min(axis=0) - 1e-12).all()
    assert (slow.max(axis=0) <= angles.max(axis=0) + 1e-12).all()
    # no angle can be nearer everywhere: half of what two samples differ by beyond the rate is needed
    lean = math.sin(0.4) * 1.1
    allowed = (rate - 0.2 * lean) / math.sqrt(2.0) * np.abs(t[:, None] - t[None, :])
    need = 0.5 * (np.abs(angles[:, None, 0] - angles[None, :, 0]) - allowed).max()
    assert np.abs(slow[:, 0] - angles[:, 0]).max() == pytest.approx(need, rel=0.05)
    still = limited_tilt(path, 1e4)
    np.testing.assert_allclose(still.normal, path.normal, atol=1e-9)


@pytest.mark.parametrize(
    ("limit", "finding", "unit"),
    [
        ("speed_mps", "speed", "m/s"),
        ("acceleration_mps2", "acceleration", "m/s² along"),
        ("lateral_mps2", "lateral", "m/s² across"),
        ("vertical_mps", "climb", "m/s upwards"),
        ("tilt_radps", "turn_rate", "rad/s of the whole tool"),
        ("vertical_mps2", "vertical_acceleration", "m/s² up and down"),
    ],
)
def test_the_checker_names_the_limit_that_is_not_kept_with_place_and_figure(limit, finding, unit, tmp_path):
    path, ground, file = plan_of(tmp_path, motion=MotionLimits(0.3, 1.0, 1.0))
    most = greatest(file)[limit]
    for part, ok in ((1.01, True), (0.8, False)):
        write_path(file, path.changed(facts=path.facts | {limit: part * most}))
        found = {name for name, f in findings_of(ground, file).items() if not f.ok}
        assert (finding not in found) == ok
        # the ends of a path need its acceleration, and a tilt is a turn of the tool
        assert found <= {finding, "between_rows", "rest", "tilt_rate"}
    text = findings_of(ground, file)[finding].text
    assert text.startswith(f"{most:.4g} {unit.split()[0]} of {0.8 * most:g} {unit}")
    x, y = (float(v) for v in text.split("near (")[1].split(")")[0].split(", "))
    assert np.hypot(path.position_m[:, 0] - x, path.position_m[:, 1] - y).min() < 1e-3
    k = int(np.argmin(np.abs(path.t_s - float(text.split("at ")[1].split(" s")[0]))))
    assert path.position_m[k, :2] == pytest.approx([x, y], abs=1e-3)


def test_a_plan_that_cannot_keep_a_limit_is_refused_by_name():
    xy = np.column_stack([0.01 * np.arange(50), np.zeros(50)])
    path = timed(ScanPath.planar(xy, np.zeros(50, np.int32)), MotionLimits(0.5))
    refuse_fast(path, MotionLimits(0.5))
    for name, text in (("speed_mps", "m/s speed"), ("acceleration_mps2", "along the path")):
        with pytest.raises(ScanInputError, match=f"{text}.*near .*lower speed"):
            refuse_fast(path, replace(MotionLimits(), **{name: 0.1}))


def test_each_refusal_that_a_user_can_mend_has_a_remedy_of_scan_plan(tmp_path):
    """The other findings are of what the planner itself must do right."""
    _, ground, file = plan_of(tmp_path)
    own = {"time", "rows", "rest", "pose", "height", "clearance_column", "unknown_beneath"}
    assert findings_of(ground, file).keys() - own == REMEDIES.keys()
