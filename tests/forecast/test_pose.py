"""Poses: rotation, history, interpolation and footprints, against SciPy's rotations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from naive import interpolated_pose, sensor_and_footprint
from surffollow.forecast.pose import footprint, pose_at, push_pose, rotate
from surffollow.shm.dtypes import zeros
from surffollow.shm.layout_follow import POSES, SenseState

MS = 1_000_000


def random_pose(rng):
    q = rng.normal(size=4)
    return np.concatenate([rng.normal(size=3), q / np.linalg.norm(q)])


def history(rng, n, near=False):
    sense, kept, t = zeros(SenseState)[0], [], 1_000 * MS
    pose = random_pose(rng)
    for _ in range(n):
        t += int(rng.integers(1, 30)) * MS
        if near:
            q = pose[3:] + rng.normal(0.0, 0.01, 4)
            pose = np.concatenate([pose[:3] + rng.normal(0.0, 0.01, 3), q / np.linalg.norm(q)])
        else:
            pose = random_pose(rng)
        assert push_pose(sense, t, pose, 0) == 1
        kept.append((t, pose.tolist()))
    return sense, kept


def at(sense, t_ns):
    out = np.zeros(7)
    pose_at(sense, t_ns, out)
    return out


@pytest.mark.parametrize("seed", range(5))
def test_rotation_is_scipys(seed):
    rng = np.random.default_rng(seed)
    for _ in range(50):
        pose, v = random_pose(rng), rng.normal(size=3)
        assert np.allclose(rotate(*pose[3:], *v), Rotation.from_quat(pose[3:]).apply(v), atol=1e-14)


@pytest.mark.parametrize("seed", range(5))
def test_the_footprint_is_the_pose_then_the_mount_then_the_beam_along_minus_z(seed):
    rng = np.random.default_rng(seed)
    for _ in range(50):
        tool, mounts = random_pose(rng), np.array([random_pose(rng) for _ in range(8)])
        c, distance = int(rng.integers(0, 8)), rng.uniform(0.05, 0.15)
        world, sensor = Rotation.from_quat(tool[3:]), Rotation.from_quat(mounts[c, 3:])
        face = tool[:3] + world.apply(mounts[c, :3])
        expected = face + world.apply(sensor.apply([0.0, 0.0, -distance]))
        got = footprint(tool, mounts.reshape(-1), c, distance)
        assert np.allclose(got, [*expected, face[2]], atol=1e-13)
        naive_face, naive_point = sensor_and_footprint(tool.tolist(), mounts[c].tolist(), distance)
        assert got == (*naive_point, naive_face[2])


@pytest.mark.parametrize("n", [1, 2, 5, POSES, 3 * POSES + 11])
def test_interpolation_has_the_bits_of_the_twin_inside_and_outside_the_history(n):
    rng = np.random.default_rng(n)
    sense, kept = history(rng, n)
    kept = kept[-POSES:]
    times = [kept[0][0] - 5, kept[-1][0] + 5, *(t for t, _ in kept[:3])]
    times += rng.integers(kept[0][0] - 10 * MS, kept[-1][0] + 10 * MS, 60).tolist()
    for t in times:
        assert at(sense, t).tolist() == interpolated_pose(kept, t), f"n {n}, t {t}"
        assert at(sense, kept[-1][0] + MS).tolist() == kept[-1][1]


def test_interpolation_is_near_the_true_slerp_between_near_poses():
    sense, kept = history(np.random.default_rng(1), 40, near=True)
    times = np.array([t for t, _ in kept])
    slerp = Slerp(times, Rotation.from_quat([p[3:] for _, p in kept]))
    for t in range(int(times[0]), int(times[-1]), 3 * MS):
        got = at(sense, t)
        assert np.linalg.norm(got[3:]) == pytest.approx(1.0, abs=1e-15)
        # a normalised mean leaves the great circle's pace in third order: steps here are below 0.1 rad
        assert (Rotation.from_quat(got[3:]) * slerp(t).inv()).magnitude() < 0.1**3 / 100


def test_a_quaternion_and_its_negative_are_one_attitude():
    sense = zeros(SenseState)[0]
    q = np.array([0.1, 0.2, -0.1, 0.9])
    q /= np.linalg.norm(q)
    push_pose(sense, 10, np.concatenate([np.zeros(3), q]), 0)
    push_pose(sense, 20, np.concatenate([np.ones(3), -q]), 0)
    got = at(sense, 15)
    assert np.allclose(got[:3], 0.5)
    assert np.allclose(got[3:], q, atol=1e-15)


def test_poses_that_are_not_newer_are_refused_counted_and_leave_no_trace():
    sense = zeros(SenseState)[0]
    assert push_pose(sense, 100, np.ones(7), 0) == 1
    for t in (100, 99, -(2**62)):
        assert push_pose(sense, t, np.zeros(7), 0) == 0
    assert sense["pose_count"] == 1
    assert sense["poses_refused"] == 3
    assert at(sense, 0).tolist() == [1.0] * 7
