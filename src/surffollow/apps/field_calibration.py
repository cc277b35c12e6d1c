"""Calibration in the simulated field: touched spots on flat ground, a ring-down (§3.4-3.5)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from surffollow.apps.field import Field, survey_field, view_joints
from surffollow.scan.calibration import CalibrationMatrix
from surffollow.scan.checks import Floats
from surffollow.scan.envelope import Envelope
from surffollow.scan.grid import TerrainGrid
from surffollow.scan.held_out import choose_matrix, choose_polar
from surffollow.scan.modes import Mode, identify_mode
from surffollow.scan.motion_profile import trapezoid
from surffollow.scan.path import ScanPath
from surffollow.scan.polar import PolarCorrection, polar_correction
from surffollow.sim.field_ground import make_ground
from surffollow.sim.field_sensors import accelerometer
from surffollow.sim.flexible_tip import tip_deflection

SPOT_RADII_M = (1.15, 1.4, 1.65, 1.9, 2.15)
SPOT_YAWS_RAD = (-0.5, -0.25, 0.0, 0.25, 0.5)
SPOT_SIGMA_M = 5e-4  # of a contact, each axis
RATE_HZ = 200.0
RING_S = 5.0


@dataclass(frozen=True)
class Calibration:
    """Results of touching and ringing.

    Attributes
    ----------
    polar : PolarCorrection    without effect when left-out spots do not confirm it
    matrix : CalibrationMatrix
    mode : Mode                of the arm across its plane
    model : str                of the matrix, chosen by left-out spots (`scan.held_out`)
    held_out_rms_m : dict      residuals [m] of left-out spots by model
    surface : Envelope         z is sampled again from it as in equation 10; None: z of the planned place
    """

    polar: PolarCorrection
    matrix: CalibrationMatrix
    mode: Mode
    surface: Envelope | None = None
    model: str = "triangles"
    held_out_rms_m: dict[str, float] = field(default_factory=dict)

    def apply(self, path: ScanPath) -> ScanPath:
        """Commands that bring the real tip to a path in map coordinates: equations 8, 9 and 11.

        Without `surface` z stays that of the planned place: the map is right here, and the arm is sent
        elsewhere to reach it.
        """
        return self.matrix.apply(polar_correction(path, self.polar, self.surface))


def calibrate(place: Field, model: str = "auto") -> Calibration:
    """Map flat ground, touch it at spots all over the work space, and let the tip ring.

    `model` of the vertical correction: see `scan.held_out.choose_matrix`.

    Raises
    ------
    ScanInputError
        as the functions of `scan.calibration`, `scan.polar` and `scan.modes`
    """
    flat = place.on(make_ground("flat", place.ground.region, place.seed + 1000, grid_m=place.ground.grid_m))
    mapped = survey_field(flat, run=1)
    rng = np.random.default_rng([place.seed, 3])
    commands, touched = touch(flat)
    seen = as_seen(flat, touched) + rng.normal(0.0, SPOT_SIGMA_M, touched.shape)
    commands[:, 2] += rng.normal(0.0, SPOT_SIGMA_M, len(commands))
    polar, polar_rms = choose_polar(commands, seen, place.model.base_m)
    z = heights_at(mapped, seen)
    known = np.isfinite(z)
    spots = np.column_stack([commands[known, :2], (commands[:, 2] - z)[known]])
    chosen = choose_matrix(spots, model=model, grid_m=0.1)
    residuals = {f"xy_{k}": v for k, v in polar_rms.items()} | chosen.held_out_rms_m
    mode = ring_down(place, rng)
    return Calibration(polar, chosen.matrix, mode, model=chosen.model, held_out_rms_m=residuals)


def touch(place: Field) -> tuple[Floats, Floats]:
    """Commands (n, 3) at which the real tip meets the ground, and the places where it does (n, 3)."""
    rho, yaw = (v.reshape(-1) for v in np.meshgrid(SPOT_RADII_M, SPOT_YAWS_RAD))
    command = np.column_stack([rho * np.cos(yaw), rho * np.sin(yaw), np.zeros(len(rho))])
    up = np.tile([0.0, 0.0, 1.0], (len(rho), 1))
    for _ in range(8):
        real = place.real_tip(command, up)[0]
        ground = np.array([place.ground.height_m(x, y) for x, y in real[:, :2]])
        command[:, 2] -= real[:, 2] - ground
    return command, place.real_tip(command, up)[0]


def as_seen(place: Field, points_m: Floats) -> Floats:
    """(n, 3) points of the ground at the places that the nearest view's modelled pose gives them."""
    joints = view_joints(place.model)
    real, modelled = place.real.ground_from_camera(joints), place.model.ground_from_camera(joints)
    nearest = np.linalg.norm(points_m[:, None, :2] - real[None, :, :2, 3], axis=2).argmin(axis=1)
    whole = np.column_stack([points_m, np.ones(len(points_m))])
    moved = np.stack([modelled[k] @ np.linalg.inv(real[k]) for k in range(len(joints))])
    return np.asarray(np.einsum("nij,nj->ni", moved[nearest], whole)[:, :3])


def heights_at(ground: TerrainGrid, xy_m: Floats) -> Floats:
    """(n,) bilinear heights of a map [m]; NaN unknown."""
    from surffollow.scan.surface_lookup import sample_surface

    uv = np.ascontiguousarray((xy_m[:, :2] - np.array(ground.origin_m)) / ground.grid_m - 0.5)
    out = np.empty((len(uv), 3))
    sample_surface(ground.heights_m, 1.0, uv, out)
    return out[:, 0]


def ring_down(place: Field, rng: np.random.Generator) -> Mode:
    """Swing the base joint by 0.3 rad, stop, and identify the mode from the accelerometer."""
    position, seconds = trapezoid(0.3, 0.4, 1.3)
    t = np.arange(0.0, seconds + RING_S, 1.0 / RATE_HZ)
    yaw, rho = position(t), 1.8
    tip = np.column_stack([rho * np.cos(yaw), rho * np.sin(yaw), np.full(len(t), 0.3)])
    moved = tip + tip_deflection(tip, RATE_HZ, np.array(place.model.base_m), place.compliance)
    after = accelerometer(moved, RATE_HZ, rng)[t > seconds + 2.0 / RATE_HZ]
    across = after[:, 1] * math.cos(0.3) - after[:, 0] * math.sin(0.3)
    return identify_mode(across, RATE_HZ, band_hz=(0.8, 6.0))
