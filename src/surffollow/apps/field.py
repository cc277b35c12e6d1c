"""The simulated field: a compliant arm with a stereo camera beside a piece of ground with a buried target.

The *model* arm is what planning knows; the *real* one differs by sag, base place, heading and lengths.
The same joint angles put both at different tips: their difference is what calibration finds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from surffollow.scan.arm import Arm
from surffollow.scan.camera import Camera, looking_down
from surffollow.scan.checks import Floats
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.image_files import DepthImage
from surffollow.scan.surveying import SurveySettings, survey
from surffollow.sim.field_ground import make_ground
from surffollow.sim.flexible_tip import Compliance
from surffollow.sim.stereo_camera import render_depth, stereo_disparity
from surffollow.sim.surfaces import HeightField

FIELD_M = (0.4, -1.5, 3.0, 1.5)
MAP_M = (0.95, -1.15, 2.45, 1.15)
BASE_HEIGHT_M = 0.6
SHAPE = (240, 320)
LENS_PX = (277.0, 277.0, 159.5, 119.5)  # 60° wide
BASELINE_M = 0.12
CAMERA_HEIGHT_M = 1.3
VIEWS = tuple((rho, yaw) for rho in (1.3, 2.0) for yaw in (-0.55, -0.18, 0.18, 0.55))
STEEP_AVERAGE_M = 0.01  # squares of 20 mm round off a 70° flank
AVERAGE_M = 0.02  # a detector of 0.1 m rests on the peaks of the map's noise; smaller squares lift it
SAG_AT_2M_M = 0.05
SAG_KNOWN = 0.9  # part of the sag that the model arm has


@dataclass(frozen=True)
class Errors:
    """Differences between the real field and the model; every element can be switched off."""

    noise: bool = True  # of disparities, wrong matches, lost texture
    occlusion: bool = True
    sag: bool = True
    calibration: bool = True  # place, heading and lengths of the arm, mounting of the camera
    modes: bool = True
    sway: bool = True


@dataclass(frozen=True)
class Field:
    """Ground, arms and camera of one simulation.

    Attributes
    ----------
    ground : HeightField       true heights
    model, real : Arm
    errors : Errors
    seed : int
    """

    ground: HeightField
    model: Arm
    real: Arm
    errors: Errors
    seed: int
    compliance: Compliance = field(default_factory=Compliance)

    @cached_property
    def depths_m(self) -> list[Floats]:
        """True depths that the real camera has in all views [m]; NaN where the second camera sees nothing."""
        real = self.real.ground_from_camera(view_joints(self.model))
        baseline_m = BASELINE_M if self.errors.occlusion else 0.0
        return [render_depth(self.ground, one, LENS_PX, SHAPE, baseline_m=baseline_m) for one in real]

    def on(self, ground: HeightField) -> Field:
        """The same vehicle on other ground."""
        return replace(self, ground=ground)

    def real_tip(self, command_m: Floats, normal: Floats) -> tuple[Floats, Floats, Floats]:
        """Real tip and normal of a stiff arm sent to commands (n, 3), and the joint angles (n, 5)."""
        joints = self.model.inverse(command_m, normal)
        tip, up = self.real.forward(joints)
        return tip, up, joints

    def true_grid(self) -> TerrainGrid:
        """The ground as a terrain grid whose cell centres are the field's nodes."""
        g = self.ground
        origin = (g.x0_m - 0.5 * g.grid_m, g.y0_m - 0.5 * g.grid_m)
        return TerrainGrid.of(g.heights_m, origin_m=origin, grid_m=g.grid_m)


def make_field(kind: str, seed: int, errors: Errors | None = None) -> Field:
    """A field with errors drawn from a seed.

    Parameters
    ----------
    kind : str          of ground: flat, bumpy, hump
    seed : int          of ground, errors and noise
    errors : Errors     None: everything on
    """
    on = Errors() if errors is None else errors
    rng = np.random.default_rng([seed, 1])
    sag = SAG_AT_2M_M if on.sag else 0.0
    base = np.eye(4)
    base[2, 3] = BASE_HEIGHT_M
    mount = looking_down(0.05, 0.0, 0.05, tilt_rad=0.15)
    model = Arm(vehicle_from_base=base, forearm_from_camera=mount, sag_at_2m_m=SAG_KNOWN * sag)
    real = replace(model, sag_at_2m_m=sag)
    if on.calibration:
        moved = base.copy()
        turn = rng.choice([-1.0, 1.0]) * rng.uniform(0.005, 0.012)
        c, s = math.cos(turn), math.sin(turn)
        moved[:2, :2] = [[c, -s], [s, c]]
        moved[:3, 3] += rng.uniform(-0.01, 0.01, 3)
        lengths = 1.0 + rng.uniform(-0.004, 0.004, 2)
        tilt = 0.15 + rng.uniform(-0.003, 0.003)
        real = replace(
            real,
            vehicle_from_base=moved,
            upper_m=model.upper_m * float(lengths[0]),
            fore_m=model.fore_m * float(lengths[1]),
            forearm_from_camera=looking_down(0.052, 0.001, 0.049, tilt_rad=tilt, heading_rad=0.002),
        )
    return Field(make_ground(kind, FIELD_M, seed), model, real, on, seed)


def view_joints(arm: Arm) -> Floats:
    """(n, 5) joint angles [rad] from which the camera looks at the work space."""
    pivot_z = CAMERA_HEIGHT_M - float(arm.forearm_from_camera[2, 3])
    tip = np.array([(r * math.cos(a), r * math.sin(a), pivot_z - arm.tool_m) for r, a in VIEWS])
    return arm.inverse(tip, np.tile([0.0, 0.0, 1.0], (len(tip), 1)))


def take_images(place: Field, rng: np.random.Generator) -> list[DepthImage]:
    """Disparity images from all views: rendered from the real camera, posed as in the model."""
    modelled = place.model.ground_from_camera(view_joints(place.model))
    fx, fy, cx, cy = LENS_PX
    images = []
    for k, depth in enumerate(place.depths_m):
        if place.errors.noise:
            q = stereo_disparity(depth, fx * BASELINE_M, rng)
        else:
            q = fx * BASELINE_M / depth
        camera = Camera(
            fx, fy, cx, cy, modelled[k], baseline_m=BASELINE_M, max_range_m=4.0, name=f"view {k + 1}"
        )
        images.append(DepthImage(q, "disparity", camera))
    return images


def survey_field(
    place: Field,
    *,
    image_filter: str = "cpf",
    grid_m: float = 0.01,
    average_m: float = AVERAGE_M,
    run: int = 0,
) -> TerrainGrid:
    """Look at the ground from all views and make its map.

    Parameters
    ----------
    place : Field
    image_filter : str             of `SurveySettings`
    grid_m, average_m : float [m]  of `SurveySettings`
    run : int                      changes the noise
    """
    images = take_images(place, np.random.default_rng([place.seed, 2, run]))
    settings = SurveySettings(
        grid_m=grid_m, region=MAP_M, filter=image_filter, average_m=average_m, fill_m=0.15
    )
    return survey(images, [], settings)[0]
