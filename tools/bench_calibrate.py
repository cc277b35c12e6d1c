"""Calibrations on simulated faults, over many seeds: range table, latency, mount and its covariance.

python tools/bench_calibrate.py --json
"""

from __future__ import annotations

import argparse
import math

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from report import print_figures
from surffollow.apps.fit_latency import fit_latency
from surffollow.apps.fit_mount import beam_of, fit_mount
from surffollow.apps.fit_range import fit_range
from surffollow.hw.simulation.led_config import FAR_M, NEAR_M

NONLINEARITY_M = 0.38e-3  # the data sheet's whole tolerance


def range_error_m(seed: int, pairs: int = 12, noise_v: float = 1e-3) -> float:
    """Largest error of a table over the window, from pairs with noise of the voltage."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0.0, 2.0 * np.pi)

    def volts(range_m: np.ndarray) -> np.ndarray:
        u = (range_m - NEAR_M) / (FAR_M - NEAR_M)
        return 10.0 * (u + NONLINEARITY_M / (FAR_M - NEAR_M) * np.sin(3.0 * np.pi * u + phase))

    true = np.linspace(NEAR_M, FAR_M, pairs)
    fit = fit_range(volts(true) + rng.normal(0.0, noise_v, pairs), true)
    at = np.linspace(NEAR_M, FAR_M, 2000)
    return float(np.abs(np.interp(volts(at), fit.table.indicated, fit.table.range_m) - at).max())


def latency_error_s(seed: int, noise_m: float = 0.25e-3) -> tuple[float, float]:
    """Error of the latency found from a sine of 5 mm at 1 Hz for 5 s, and its error by its own sigma."""
    rng = np.random.default_rng(seed)
    latency_s = rng.uniform(0.0, 0.2)
    t = np.arange(0.0, 5.0, 0.01) + rng.uniform(0.0, 1.0)
    z = 0.1 + 0.005 * np.sin(2.0 * np.pi * t)
    at = np.arange(t[0], t[-1], 0.004)
    seen = 0.1 + 0.005 * np.sin(2.0 * np.pi * (at - latency_s)) + 0.003 + rng.normal(0.0, noise_m, len(at))
    fit = fit_latency(t, z, at, seen)
    return abs(fit.latency_s - latency_s), (fit.latency_s - latency_s) / fit.sigma_s


def mount_errors(seed: int, noise_m: float = 0.1e-3, n: int = 1500) -> tuple[float, float, float]:
    """Position error [m], beam error [rad] and the squared error by the covariance (5 degrees of freedom)."""
    rng = np.random.default_rng(seed)
    place, angles = rng.uniform(-0.05, 0.05, 3), rng.uniform(-0.1, 0.1, 2)
    tilts = np.radians(rng.uniform(-30.0, 30.0, (n, 3)))
    turns = Rotation.from_euler("xyz", tilts)
    normal = np.array([0.02, -0.03, 1.0]) / np.linalg.norm([0.02, -0.03, 1.0])
    t = np.column_stack([rng.uniform(-0.2, 0.2, (n, 2)), rng.uniform(0.15, 0.25, n)])
    sensor, beam = t + turns.apply(place), turns.apply(beam_of(*angles))
    ranges = (0.01 - sensor @ normal) / (beam @ normal) + rng.normal(0.0, noise_m, n)
    fit = fit_mount(np.hstack([t, turns.as_quat()]), ranges)
    found = Rotation.from_quat(fit.mount[3:]).apply([0.0, 0.0, -1.0])
    a = math.asin(found[1])
    b = math.atan2(-found[0], -found[2])
    off = np.array([*(np.array(fit.mount[:3]) - place), a - angles[0], b - angles[1]])
    square = float(off @ np.linalg.solve(np.array(fit.covariance), off))
    turn = math.acos(min(1.0, float(found @ beam_of(*angles))))
    return float(np.linalg.norm(off[:3])), turn, square


def measure(seeds: int) -> dict[str, float]:
    """Worst and typical figures over the seeds."""
    ranges = [range_error_m(s) for s in range(seeds)]
    latencies = [latency_error_s(s) for s in range(seeds)]
    mounts = np.array([mount_errors(s) for s in range(seeds)])
    total = float(mounts[:, 2].sum())
    return {
        "seeds": seeds,
        "range_worst_mm": 1e3 * max(ranges),
        "range_median_mm": 1e3 * float(np.median(ranges)),
        "latency_worst_ms": 1e3 * max(e for e, _ in latencies),
        "latency_rms_sigmas": float(np.sqrt(np.mean([z * z for _, z in latencies]))),
        "mount_worst_mm": 1e3 * float(mounts[:, 0].max()),
        "mount_worst_deg": math.degrees(float(mounts[:, 1].max())),
        "mount_chi2_per_freedom": total / (5 * seeds),
        "mount_chi2_p": float(chi2.sf(total, 5 * seeds)),
    }


def main() -> None:
    words = argparse.ArgumentParser(description="Calibrations on simulated faults.")
    words.add_argument("--seeds", type=int, default=100)
    words.add_argument("--json", action="store_true")
    options = words.parse_args()
    result = measure(options.seeds)
    print_figures(result, options.json)


if __name__ == "__main__":
    main()
