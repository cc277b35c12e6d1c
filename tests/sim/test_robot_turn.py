"""The simulated robot's wrist, the ground under a tilted tool, and demanded rotations."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from surffollow.shm.dtypes import zeros
from surffollow.sim.mounts import around_tool
from surffollow.sim.robot import RobotCore
from surffollow.sim.robot_config import RobotConfig
from surffollow.sim.robot_turn import ACCEL_RADPS2, SPEED_RADPS, along_axis, turned, wrist_step
from surffollow.sim.surfaces import shell_field
from surffollow.sim.world import WorldPose
from surffollow.sim.world_surface import WorldConfig

MS = 1_000_000
REGION = (0.0, 0.0, 1.2, 1.0)
DOME = shell_field(REGION, 1.0, 0.9, 2e-3)
FRAME = np.array([DOME.x0_m, DOME.y0_m, DOME.grid_m])


def test_an_attitude_is_turned_about_world_axes() -> None:
    rng, out = np.random.default_rng(0), np.zeros(4)
    for _ in range(50):
        q, w = Rotation.random(random_state=int(rng.integers(1 << 30))), rng.normal(0.0, 1.0, 3)
        turned(q.as_quat(), *w, out)
        assert (Rotation.from_quat(out) * (Rotation.from_rotvec(w) * q).inv()).magnitude() < 1e-9


def test_the_wrist_arrives_within_its_speed_and_acceleration() -> None:
    q, w, scratch = np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(4)
    desired = Rotation.from_rotvec([0.4, -0.7, 0.2])
    goal, speeds = -desired.as_quat(), [w.copy()]  # the other sign is the same attitude
    for _ in range(3000):
        before = Rotation.from_quat(q)
        wrist_step(q, w, goal, scratch, 1e-3)
        moved = (Rotation.from_quat(q) * before.inv()).as_rotvec()
        assert moved == pytest.approx(w * 1e-3, abs=1e-9)
        speeds.append(w.copy())
    assert (Rotation.from_quat(q) * desired.inv()).magnitude() < 1e-6
    assert np.linalg.norm(speeds, axis=1).max() <= SPEED_RADPS + 1e-9
    assert np.linalg.norm(np.diff(speeds, axis=0), axis=1).max() <= ACCEL_RADPS2 * 1e-3 + 1e-9


def test_stand_off_along_the_axis_and_angle_agree_with_the_shell_s_formula() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        x, y = rng.uniform(0.3, 0.9), rng.uniform(0.3, 0.7)
        q = Rotation.from_rotvec([*rng.uniform(-0.35, 0.35, 2), 0.0])
        axis = q.apply([0.0, 0.0, 1.0])
        z = DOME.height_m(x, y) + 0.1
        standoff, ground, angle, tilt = along_axis(DOME.heights_m, FRAME, x, y, z, q.as_quat())

        def gap(d: float, x: float = x, y: float = y, z: float = z, axis: np.ndarray = axis) -> float:
            return float(z - d * axis[2] - DOME.height_m(x - d * axis[0], y - d * axis[1]))

        assert standoff == pytest.approx(brentq(gap, 0.0, 0.2, xtol=1e-12), abs=1e-7)
        assert ground == pytest.approx(z - standoff * axis[2], abs=1e-12)
        u, v = x - standoff * axis[0] - 0.6, y - standoff * axis[1] - 0.5
        normal = np.array([u / math.sqrt(1.0 - u * u), v / math.sqrt(0.81 - v * v), 1.0])
        normal /= np.linalg.norm(normal)
        assert angle == pytest.approx(math.acos(float(normal @ axis)), abs=1e-4)
        assert tilt == pytest.approx(math.acos(float(normal[2])), abs=1e-4)


def test_a_robot_that_does_not_turn_ignores_rotations_and_one_that_does_publishes_them() -> None:
    world = WorldConfig(surface="dome", region=REGION, grid_m=4e-3)
    field = world.make()
    for turn in (False, True):
        core = RobotCore(RobotConfig(world=world, turn=turn, report_turn_sigma_rad=0.0), field, 10**12)
        core.measure()
        core.advance(core.t_ns + 20 * MS)
        ((t_ns, pose),) = core.reports()
        assert pose[3:] == pytest.approx([0.0, 0.0, 0.0, 1.0])
        core.command(0.0, t_ns, (0.1, -0.2, 0.0))
        core.advance(core.t_ns + 2000 * MS)
        found = Rotation.from_quat(core.world["pose"][0, 3:]).as_rotvec()
        assert found == pytest.approx([0.1, -0.2, 0.0] if turn else [0.0, 0.0, 0.0], abs=1e-6)
        core.measure()
        core.advance(core.t_ns + 20 * MS)
        _, pose = core.reports()[-1]
        assert Rotation.from_quat(pose[3:]).as_rotvec() == pytest.approx(found, abs=1e-6)
        assert ("angle_rms_rad" in core.summary()) == turn


def test_published_angular_velocity_is_that_of_the_published_attitudes() -> None:
    world = WorldConfig(surface="dome", region=REGION, grid_m=4e-3)
    core = RobotCore(RobotConfig(world=world, turn=True), world.make(), 10**12)
    core.measure()
    core.advance(core.t_ns + 20 * MS)
    ((t_ns, _),) = core.reports()
    core.command(0.0, t_ns, (0.3, 0.1, 0.0))
    rows: list[np.ndarray] = []
    for _ in range(200):
        core.advance(core.t_ns + MS)
        rows.append(core.world[0].copy())
    assert rows[0].dtype == zeros(WorldPose).dtype
    turns = [Rotation.from_quat(r["pose"][3:]) for r in rows]
    steps = np.array([(b * a.inv()).as_rotvec() for a, b in itertools.pairwise(turns)])
    np.testing.assert_allclose(steps / 1e-3, [r["velocity"][3:] for r in rows[1:]], atol=1e-6)


def test_mounts_stand_around_the_tool_and_never_in_a_line() -> None:
    for count in range(3, 9):
        mounts = np.array(around_tool(count))
        assert mounts.shape == (count, 7)
        assert (mounts[:, 3:] == [0.0, 0.0, 0.0, 1.0]).all()
        assert mounts[:, :2].mean(axis=0) == pytest.approx([0.0, 0.0], abs=1e-12)
        assert np.linalg.eigvalsh(np.cov(mounts[:, :2].T))[0] > 1e-4
        assert len({tuple(np.round(m, 9)) for m in mounts}) == count
