"""The paper's demonstration field in two dimensions: rolling clay with boxes and ramps on it."""

from __future__ import annotations

import numpy as np

from surffollow.sim.profiles_random import (
    FY91_PEAK_TO_PEAK_M,
    FY91_TEXTURE_CORRELATION_M,
    FY91_TEXTURE_M,
    FY91_WAVELENGTHS_M,
    fy91_objects,
)
from surffollow.sim.surfaces import HeightField, Region, field_axes

BAND_M = 0.2  # objects stand in bands along x this wide, so that every straight path meets its share
WAVES = 24


def fy91_field(
    seed: int = 91, region: Region = (-0.2, -0.1, 6.2, 0.1), grid_m: float = 1e-3, objects: bool = True
) -> HeightField:
    """Make the FY91 field over a region.

    Rolling terrain of wavelengths 0.2-1 m and 30 mm peak to peak, a fine clay texture, and per metre of
    path along x 5 boxes of 5-20 mm and 2 ramps of 20 %. `HeightField.parts` has their places.

    Parameters
    ----------
    seed : the same seed, region and grid give the same field
    region : (x_min, y_min, x_max, y_max) [m]
    grid_m : spacing [m]
    objects : False leaves boxes and ramps out

    Raises
    ------
    RegionError
        see `field_axes`
    """
    from scipy.ndimage import gaussian_filter  # half a second that a service without a simulation saves

    x, y = field_axes(region, grid_m)
    rng = np.random.default_rng([seed, 1991])
    # plane waves of every direction: along a straight path none looks shorter than it is
    n = rng.uniform(1.0 / FY91_WAVELENGTHS_M[1], 1.0 / FY91_WAVELENGTHS_M[0], WAVES)
    n[:2] = 1.0 / FY91_WAVELENGTHS_M[1], 1.0 / FY91_WAVELENGTHS_M[0]
    turn = rng.uniform(0.0, 2 * np.pi, WAVES)
    phase = rng.uniform(0.0, 2 * np.pi, WAVES)
    along = np.exp(2j * np.pi * np.outer(n * np.cos(turn), x)) * (np.exp(1j * phase) / n)[:, None]
    across = np.exp(2j * np.pi * np.outer(y, n * np.sin(turn)))
    z = (across @ along).real
    z *= FY91_PEAK_TO_PEAK_M / np.ptp(z)
    texture = gaussian_filter(rng.standard_normal(z.shape), FY91_TEXTURE_CORRELATION_M / grid_m)
    z += texture * (FY91_TEXTURE_M / texture.std())
    parts = np.zeros(z.shape, np.uint8)
    if objects:
        first = np.floor(y[0] / BAND_M)
        for band in range(int(np.floor(y[-1] / BAND_M) - first) + 1):
            rows = np.floor(y / BAND_M) == first + band
            heights, row_parts = fy91_objects(rng, x)
            z[rows] += heights
            parts[rows] = row_parts
    return HeightField(np.ascontiguousarray(z), region[0], region[1], grid_m, parts)
