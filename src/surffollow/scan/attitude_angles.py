"""Attitudes of a two-axis wrist: unit normals, wrist angles and quaternions, to and fro.

The wrist stands at an azimuth ψ about the vertical. It turns by *pitch* about its y axis, then by *roll*
about the x axis that came with it: body axes in the ground frame are R_z(ψ) R_y(pitch) R_x(roll).
"""

from __future__ import annotations

import numpy as np

from surffollow.scan.checks import Floats


def wrist_angles(normal: Floats, azimuth_rad: Floats) -> Floats:
    """(n, 2) pitch and roll [rad] that turn the body's z axis to the unit normals (n, 3).

    Notes
    -----
    In wrist coordinates the normal is (sin p cos r, -sin r, cos p cos r).
    """
    c, s = np.cos(azimuth_rad), np.sin(azimuth_rad)
    x = c * normal[:, 0] + s * normal[:, 1]
    y = -s * normal[:, 0] + c * normal[:, 1]
    return np.column_stack([np.arctan2(x, normal[:, 2]), np.arcsin(np.clip(-y, -1.0, 1.0))])


def normals_of(angles_rad: Floats, azimuth_rad: Floats) -> Floats:
    """(n, 3) unit normals of pitch and roll (n, 2) at an azimuth (n,)."""
    p, r = angles_rad[:, 0], angles_rad[:, 1]
    x, y, z = np.sin(p) * np.cos(r), -np.sin(r), np.cos(p) * np.cos(r)
    c, s = np.cos(azimuth_rad), np.sin(azimuth_rad)
    return np.column_stack([c * x - s * y, s * x + c * y, z])


def quaternions_of(normal: Floats, azimuth_rad: Floats) -> Floats:
    """(n, 4) quaternions x, y, z, w of R_z(ψ) R_y(pitch) R_x(roll), w ≥ 0."""
    angles = wrist_angles(normal, azimuth_rad)
    cp, sp = np.cos(angles[:, 0] / 2), np.sin(angles[:, 0] / 2)
    cr, sr = np.cos(angles[:, 1] / 2), np.sin(angles[:, 1] / 2)
    cy, sy = np.cos(azimuth_rad / 2), np.sin(azimuth_rad / 2)
    q = np.column_stack(
        [
            cy * cp * sr - sy * sp * cr,
            cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr,
            cy * cp * cr + sy * sp * sr,
        ]
    )
    return np.where(q[:, 3:] < 0.0, -q, q)


def body_axes(normal: Floats, azimuth_rad: Floats) -> Floats:
    """(n, 3, 3) rotations body to ground of the same attitudes."""
    x, y, z, w = quaternions_of(normal, azimuth_rad).T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], axis=-1),
            np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], axis=-1),
            np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=-1),
        ],
        axis=1,
    )
