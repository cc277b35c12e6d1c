"""Places of the body in the poses of a path file, for its check. No code of the planner."""

from __future__ import annotations

import numpy as np

from surffollow.scan.check_file import Array, Facts, Poses


def control_points(poses: Poses, facts: Facts) -> Array:
    """(n, m, 3) control points of the poses that have a height."""
    on = poses.planned
    axes = rotations(poses.quaternion[on])
    return np.asarray(poses.position[on][:, None, :] + (axes @ facts.body.T).transpose(0, 2, 1), np.float64)


def rotations(q: Array) -> Array:
    """(n, 3, 3) matrices: the columns are the body's axes."""
    x, y, z, w = q.T
    n = x * x + y * y + z * z + w * w
    s = 2.0 / np.where(n > 0.0, n, np.nan)
    rows = [
        [1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
        [s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)],
        [s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)],
    ]
    return np.asarray(np.array(rows).transpose(2, 0, 1), np.float64)
