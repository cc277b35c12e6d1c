"""Bench the default follower: execution time of a cycle, and that no input gets a bad demand out of it.

    python tools/bench_follower.py [--cycles 10000000] [--json]

Times are CPU times of `follow_step` alone, called from Python, 1 kHz cycles with a sample every fourth;
"leading" has its only sensor 50 mm ahead, so that every tenth cycle plans over known ground. The random
cycles run inside one kernel with every kind of bad input. Exit 1 when a criterion is missed.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import sys
import time
from typing import Any

import numpy as np
from numba import njit

from surffollow.follower import Follower
from surffollow.follower.kernel_time import kernel_time
from surffollow.forecast.pose import push_pose
from surffollow.forecast.step import follow_step
from surffollow.shm.layout_follow import CHANNELS

P99_US = 50.0
MS = 1_000_000


@njit(nogil=True)
def _next(seed: Any) -> Any:
    """SplitMix64: a random word and the next seed."""
    seed += np.uint64(0x9E3779B97F4A7C15)
    z = seed
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return seed, z ^ (z >> np.uint64(31))


@njit(nogil=True)  # not kept: numba would not see a change of the package's kernels
def random_cycles(
    params: Any, state: Any, inputs: Any, output: Any, scratch: Any, cycles: Any, seed: Any
) -> Any:
    """Step with random and hostile inputs; returns (demands not finite, beyond limits, state not finite)."""
    p, s, i, o, a = params[0], state[0], inputs[0], output[0], state[0].adaptive
    pose = np.zeros(7)
    pose[6] = 1.0
    bad, beyond, sick = 0, 0, 0
    t, x, z = 10**12, 0.0, 0.1
    for _ in range(cycles):
        seed, r = _next(seed)
        what = r & np.uint64(255)
        t += np.int64((r >> np.uint64(8)) & np.uint64(2097151))  # up to 2 ms
        if what == np.uint64(0):
            t += 3_000_000_000
        seed, r = _next(seed)
        u = np.float64(r >> np.uint64(11)) / 9007199254740992.0
        if what < np.uint64(30):
            x += 0.002 * u
            z += 0.002 * (u - 0.5)
            if what == np.uint64(1):
                x, z = 1e6 * (u - 0.5), 10.0 * (u - 0.5)
            angle = 3.0 * (u - 0.5) if what == np.uint64(2) else 0.05 * (u - 0.5)
            pose[0], pose[1], pose[2] = x, 0.3 * x, z
            pose[3], pose[6] = math.sin(angle), math.cos(angle)
            push_pose(s.sense, t, pose, 0)
        i.t_ns = t
        if what == np.uint64(40):
            i.t_ns -= 5_000_000_000
        i.given_t_ns = i.t_ns - (30_000_000 if what & np.uint64(1) else 0)
        i.n_ranges = p.n_channels
        for c in range(p.n_channels):
            seed, r = _next(seed)
            v = np.float64(r >> np.uint64(11)) / 9007199254740992.0
            i.given_m[c] = 0.1 + 0.002 * (v - 0.5)
            if what > np.uint64(200):
                i.given_m[c] = 0.2 * v - 0.02
            if what == np.uint64(50):
                i.given_m[c] = math.inf
            if what > np.uint64(60) and what < np.uint64(120):
                i.given_m[c] = math.nan
        i.n_preview = 0
        if what > np.uint64(180):
            i.n_preview, i.preview_from_m, i.preview_step_m = 128, -0.01, 0.001 * u
            for k in range(128):
                i.preview_m[k] = math.nan if (k * 7 + np.int64(what)) % 31 == 0 else 0.01 * u * k / 128.0
        follow_step(params, state, inputs, output, scratch)
        total = 0.0
        for k in range(6):
            total += o.demand[k]
        if not math.isfinite(total):
            bad += 1
        turn = math.sqrt(o.demand[3] ** 2 + o.demand[4] ** 2 + o.demand[5] ** 2)
        if abs(o.demand[2]) > p.max_demand_m or turn > p.max_turn_rad * (1.0 + 1e-12):
            beyond += 1
        if not math.isfinite(
            a.estimate.height_m
            + a.estimate.slope
            + a.estimate.sigma_m
            + a.noise.sigma_m
            + a.plant.tau_s
            + a.setpoint.position_m
            + a.gate.scale_m
            + a.preview.mean_m
            + a.preview.offset_m2
            + a.preview.error_m2
            + a.plan.setpoint_m
        ):
            sick += 1
    return bad, beyond, sick


def _follower(channels: int) -> Follower:
    ring = [
        0.04 * np.array([math.cos(k), math.sin(k)]) * (channels > 1)
        for k in 2 * np.pi * np.arange(channels) / channels
    ]
    sensors = [{"position_m": [float(x), float(y), 0.0]} for x, y in ring]
    return Follower({"sensors": sensors, "memory": False}, offset_m=0.1)


def _leading() -> Follower:
    return Follower({"sensors": [{"position_m": [0.05, 0.0, 0.0]}], "memory": False}, offset_m=0.1)


def time_cycles(f: Follower, channels: int, cycles: int = 20_000) -> dict[str, float]:
    """Execution times of one cycle [µs]."""
    rng, took = np.random.default_rng(0), np.zeros(cycles)
    for k in range(cycles):
        t = 10**12 + k * MS
        if k % 10 == 0:
            f.pose(t, (1e-4 * k, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))
        t = kernel_time(t)
        f._given_m[:channels] = math.nan if k % 4 else 0.1 + 2.5e-4 * rng.standard_normal(channels)
        f._n_ranges[0], f._t_ns[0], f._given_t_ns[0] = channels, t, t
        begin = time.thread_time_ns()
        follow_step(f._params, f._state, f._inputs, f._output, f._scratch)
        took[k] = 1e-3 * (time.thread_time_ns() - begin)
    took = took[1000:]
    return {
        "p50_us": float(np.median(took)),
        "p99_us": float(np.percentile(took, 99)),
        "max_us": float(took.max()),
    }


def main() -> int:
    """Run both and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--cycles", type=int, default=10_000_000)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found: dict[str, Any] = {"machine": platform.machine(), "python": platform.python_version()}
    found["cycle"] = {str(n): time_cycles(_follower(n), n) for n in (1, 4, CHANNELS)}
    found["cycle"]["leading"] = time_cycles(_leading(), 1)
    sums = np.zeros(3, np.int64)
    begin = time.perf_counter()
    for n, f in enumerate((_follower(1), _follower(4), _leading()), 1):
        sums += random_cycles(
            f._params, f._state, f._inputs, f._output, f._scratch, -(-options.cycles // 3), np.uint64(n)
        )
    found["random"] = {
        "cycles": options.cycles,
        "not_finite": int(sums[0]),
        "beyond_limits": int(sums[1]),
        "state_not_finite": int(sums[2]),
        "seconds": time.perf_counter() - begin,
    }
    ok = max(row["p99_us"] for row in found["cycle"].values()) <= P99_US and not sums.any()
    found["ok"] = bool(ok)
    if options.json:
        sys.stdout.write(json.dumps(found) + "\n")
    else:
        for n, row in found["cycle"].items():
            sys.stdout.write(
                "channels {}: p50 {p50_us:.1f} µs, p99 {p99_us:.1f} µs, max {max_us:.1f} µs\n".format(
                    n, **row
                )
            )
        sys.stdout.write(
            "{cycles} random cycles: {not_finite} demands not finite, {beyond_limits} beyond limits, "
            "{state_not_finite} states not finite\n".format(**found["random"])
        )
    return 0 if ok else 1


if __name__ == "__main__":
    sys.exit(main())
