"""Regression of a plane on the footprints of several beams."""

import math
from typing import NamedTuple

from surffollow.forecast import elementary
from surffollow.forecast.estimation.noise import assumed_noise_m
from surffollow.shm.jit import jit, jit_inlined


class PlaneFit(NamedTuple):
    """A plane by regression on footprints."""

    rank: int  # slopes that the footprints give: 2 both, 1 along their line, 0 none
    x_m: float  # mean of the footprints
    y_m: float
    h_m: float
    error_x: float  # slopes minus the known ones
    error_y: float
    spread_m2: float  # of the footprints, where it is less
    error_m2: float  # sum of the squared residuals


@jit
def half_squared_distance(beams, c):
    """Half the squared distance of a beam's footprint from the tool's axis [m²]."""
    dx, dy = beams.footprint_m[3 * c] - beams.axis_x_m, beams.footprint_m[3 * c + 1] - beams.axis_y_m
    return 0.5 * (dx * dx + dy * dy)


@jit
def farthest_half_squared(params, beams):
    """Half the squared distance from the tool's axis of the farthest accepted beam [m²]."""
    farthest_m2 = 0.0
    for c in range(params.n_channels):
        if beams.accepted[c] != 0:
            farthest_m2 = max(farthest_m2, half_squared_distance(beams, c))
    return farthest_m2


@jit
def flat_height(beams, curvature, c):
    """Height of a beam's footprint, corrected for the curvature [m]."""
    return beams.footprint_m[3 * c + 2] - curvature * half_squared_distance(beams, c)


@jit_inlined
def principal_axis(xx, xy, yy):
    """Unit vector along which points of these second moments are spread most; (1, 0) where none is."""
    cosine, sine = xx - yy, 2.0 * xy  # of twice its angle, times their length
    length = elementary.hypot(cosine, sine)
    if not length > 0.0:
        return 1.0, 0.0
    longer = math.sqrt(0.5 + 0.5 * abs(cosine) / length)
    shorter = 0.5 * abs(sine) / (length * longer)
    x, y = (longer, shorter) if cosine > 0.0 else (shorter, longer)
    return x, math.copysign(y, sine)


@jit
def fit_plane(adaptive, weights, n_channels, without=-1):
    """Weighted least squares of a plane, along the principal axes of the footprints.

    Parameters
    ----------
    adaptive : record of `AdaptiveState`: heights are corrected by the known slopes and curvature
    weights : (8,) array  0 to 1; 0: the beam does not count
    n_channels : int      channels in use
    without : int         a channel that does not count; -1: all do

    Returns
    -------
    PlaneFit
    """
    beams, plane = adaptive.beams, adaptive.plane
    total, mx, my, mh = 0.0, 0.0, 0.0, 0.0
    for c in range(n_channels):
        w = weights[c] if c != without else 0
        mx, my = mx + w * beams.footprint_m[3 * c], my + w * beams.footprint_m[3 * c + 1]
        total, mh = total + w, mh + w * flat_height(beams, plane.curvature, c)
    mx, my, mh = mx / total, my / total, mh / total
    xx, xy, yy, xh, yh, hh = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for c in range(n_channels):
        w = weights[c] if c != without else 0
        dx, dy = beams.footprint_m[3 * c] - mx, beams.footprint_m[3 * c + 1] - my
        dh = flat_height(beams, plane.curvature, c) - mh - plane.slope_x * dx - plane.slope_y * dy
        xx, xy, yy = xx + w * dx * dx, xy + w * dx * dy, yy + w * dy * dy
        xh, yh, hh = xh + w * dx * dh, yh + w * dy * dh, hh + w * dh * dh
    ux, uy = principal_axis(xx, xy, yy)
    major = xx * ux * ux + 2.0 * xy * ux * uy + yy * uy * uy
    minor = xx * uy * uy - 2.0 * xy * ux * uy + yy * ux * ux
    along, across = (xh * ux + yh * uy) / major, (yh * ux - xh * uy) / minor
    # footprints nearer to each other than 20 standard deviations of a reading give no slope
    least_m2 = (20.0 * assumed_noise_m(adaptive.noise)) ** 2
    rank = 1 if major > least_m2 else 0
    error_m2 = hh - major * along * along - minor * across * across
    if minor > max(least_m2, 1e-2 * (major + minor)):
        rank = 2
    else:  # nearly on one line they give none across it
        across = 0.0
    ex, ey = along * ux - across * uy, along * uy + across * ux
    return PlaneFit(rank, mx, my, mh, ex, ey, minor, error_m2)


@jit
def is_bent(adaptive, n_channels, gate_m):
    """Whether the accepted beams lie on no plane within the gate."""
    fit = fit_plane(adaptive, adaptive.beams.accepted, n_channels)
    return fit.rank == 2 and fit.error_m2 > gate_m * gate_m


@jit
def is_too_steep(params, adaptive):
    """Whether the accepted beams lie on a plane steeper than `max_tilt_rad`, and than 45 degrees: an edge.

    A smaller `max_tilt_rad` may be that of an arm, and says nothing of the ground.
    """
    plane, fit = adaptive.plane, fit_plane(adaptive, adaptive.beams.accepted, params.n_channels)
    sine, cosine = elementary.sin_cos(params.max_tilt_rad)
    slope = elementary.hypot(plane.slope_x + fit.error_x, plane.slope_y + fit.error_y)
    return fit.rank == 2 and slope * cosine > max(sine, cosine)


@jit
def odd_beam(adaptive, n_channels, gate_m):
    """Accepted beam without which the others lie on a plane best, within the gate; -1: none.

    The known slopes do not matter: with wrong ones all beams disagree.
    """
    odd, least_m2 = -1, gate_m * gate_m
    for c in range(n_channels):
        if adaptive.beams.accepted[c] != 0:
            fit = fit_plane(adaptive, adaptive.beams.accepted, n_channels, c)
            if fit.rank == 2 and fit.error_m2 <= least_m2:
                odd, least_m2 = c, fit.error_m2
    return odd


@jit
def curvature_error(adaptive, n_channels, fit):
    """Error of the mean curvature by the residuals of the plane (normalised least mean squares) [1/m].

    Three beams have no residuals. A ring without a beam in the middle has nearly one distance from the axis,
    and gives no curvature: their spread is below 0.1 of that about zero, with a middle beam 1/n or more.

    Parameters
    ----------
    adaptive : record of `AdaptiveState`
    n_channels : int  channels in use
    fit : PlaneFit    of these beams
    """
    beams, plane = adaptive.beams, adaptive.plane
    total, mean_q, square_q, covariance = 0.0, 0.0, 0.0, 0.0
    for c in range(n_channels):
        w, q = beams.weight[c], half_squared_distance(beams, c)
        dx, dy = beams.footprint_m[3 * c] - fit.x_m, beams.footprint_m[3 * c + 1] - fit.y_m
        left = flat_height(beams, plane.curvature, c) - fit.h_m - plane.fitted_x * dx - plane.fitted_y * dy
        total, mean_q = total + w, mean_q + w * q
        square_q, covariance = square_q + w * q * q, covariance + w * q * left
    spread = square_q - mean_q * mean_q / total
    return covariance / spread if spread > 0.1 * square_q else 0.0
