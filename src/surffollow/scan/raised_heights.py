"""Heights raised as little as vertical speed and acceleration allow: a linear programme over all rows."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.optimize import Bounds, LinearConstraint, milp

from surffollow.errors import ScanInputError
from surffollow.scan.checks import Floats
from surffollow.scan.path import ScanPath
from surffollow.scan.timing import MotionLimits

ROUNDING = 1e-9  # parts of a limit


def raised_heights(path: ScanPath, limits: MotionLimits) -> ScanPath:
    """Raise rows until vertical speed and acceleration are kept: every gap stays, times and places too.

    Parameters
    ----------
    path : ScanPath
        with ascending times [s]; rows without height part it, and each part is at rest at both ends
    limits : MotionLimits
        `vertical_mps` and `vertical_mps2` of it

    Returns
    -------
    ScanPath
        `lift_m` grows by what was raised, in sum over the rows the least that is possible; `clearance_m` is
        that of before

    Raises
    ------
    ScanInputError
        numbers that no solver can use

    Examples
    --------
    >>> import numpy as np
    >>> from surffollow.scan import MotionLimits, ScanPath
    >>> from surffollow.scan.raised_heights import raised_heights
    >>> xy_m = np.column_stack([0.1 * np.arange(21), np.zeros(21)])
    >>> path = ScanPath.planar(xy_m, np.zeros(21, np.int32)).changed(t_s=0.1 * np.arange(21))
    >>> path.position_m[:, 2] = np.where(np.arange(21) == 10, 0.05, 0.0)      # a peak of 5 cm
    >>> z_m = raised_heights(path, MotionLimits(vertical_mps2=1.0)).position_m[:, 2]
    >>> np.round(z_m[6:15], 3)
    array([0.   , 0.01 , 0.03 , 0.045, 0.05 , 0.045, 0.03 , 0.01 , 0.   ])
    """
    z = path.position_m[:, 2]
    known = np.isfinite(z).astype(np.int8)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], known, [0]])))
    raised = np.zeros(len(z))
    for first, last in edges.reshape(-1, 2):
        raised[first:last] = _least(path.t_s[first:last], z[first:last], limits)
    position = path.position_m.copy()
    position[:, 2] += raised
    return path.changed(position_m=position, lift_m=path.lift_m + raised)


def _least(t_s: Floats, z_m: Floats, limits: MotionLimits) -> Floats:
    """Heights (n,) [m] of the least sum that added to z_m keep the limits; a level path always does."""
    n = len(z_m)
    if n < 2:
        return np.zeros(n)
    dt = np.diff(t_s)
    mid = 0.5 * (dt[1:] + dt[:-1])
    speed = sparse.diags([-1.0 / dt, 1.0 / dt], [0, 1], shape=(n - 1, n), format="csr")
    most = np.full(n - 1, limits.vertical_mps)
    most[[0, -1]] = np.minimum(most[[0, -1]], 0.5 * limits.vertical_mps2 * dt[[0, -1]])  # from and to rest
    change = sparse.diags(1.0 / (limits.vertical_mps2 * mid)) @ (speed[1:] - speed[:-1])
    rows = sparse.vstack([sparse.diags(1.0 / most) @ speed, change], format="csr")  # parts of the limits
    have = rows @ (z_m - z_m[0])
    if np.abs(have).max() <= 1.0 + ROUNDING:
        return np.zeros(n)
    unit = limits.vertical_mps2 * float(np.median(dt)) ** 2  # [m]: coefficients near 1
    kept = LinearConstraint(rows * unit, -1.0 - have, 1.0 - have)
    found = milp(np.ones(n), constraints=kept, bounds=Bounds(0.0, np.inf))
    if found.x is None:
        raise ScanInputError(f"no heights keep the limits of vertical motion: {found.message}")
    raised: Floats = np.maximum(found.x, 0.0) * unit
    return raised
