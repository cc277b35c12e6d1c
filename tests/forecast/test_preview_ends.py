"""Known ground that ends on a slope: plan and share fade together."""

from __future__ import annotations

import numpy as np

from .driving import MS, Kernel, default_params

SPEED_MPS, SLOPE, TAU_S, STANDOFF_M = 0.4, 0.2, 0.04, 0.1


def ramp(x: float) -> float:
    return SLOPE * max(x - 0.1, 0.0)


def errors_m(known_until_m: float) -> np.ndarray:
    """Stand-off errors at every sample of a tool on a ramp whose ground is known up to a place [m]."""
    kernel = Kernel(default_params(mode=1, orient=0, max_demand_m=0.05))
    i, rng = kernel.inputs[0], np.random.default_rng(0)
    z = setpoint = base = STANDOFF_M
    x_report, errors = 0.0, []
    for n in range(330):
        t_ns, x = 10_000 * MS + 4 * MS * n, SPEED_MPS * 4e-3 * n
        for _ in range(4):
            z += (setpoint - z) / TAU_S * 1e-3
        poses = []
        if n % 2 == 0:
            poses, x_report, base = [(t_ns, (x, 0.0, z, 0.0, 0.0, 0.0, 1.0))], x, z
        places = x_report - 0.02 + 1.5e-3 * np.arange(128)
        known = places < known_until_m
        i["preview_from_m"], i["preview_step_m"] = -0.02, 1.5e-3
        i["preview_m"][:128] = np.where(known, [ramp(at) for at in places], np.nan)
        i["n_preview"] = 128 if known.any() else 0
        reading = z - ramp(x) + 5e-5 * rng.standard_normal()
        o = kernel.step(t_ns, poses, ranges=[reading], given_t_ns=t_ns)
        setpoint = base + float(o["demand"][2])
        errors.append(z - ramp(x) - STANDOFF_M)
    return np.array(errors)


def test_a_tool_does_not_sink_where_known_ground_ends_on_a_ramp():
    """GIVEN a ramp of 20 % at 400 mm/s WHEN its known part ends THEN the tool stays at its height.

    The plan was not made anew while its share faded, and ended at the last known ground: 0.8 mm too low.
    """
    errors = errors_m(0.35)[150:]
    print(
        f"lowest {1e3 * errors.min():.2f} mm, without known ground {1e3 * errors_m(-1.0)[150:].min():.2f} mm"
    )
    assert errors.min() > -0.2e-3
