"""Follow ground that moves, and ground that stays, with a tool that rests or creeps and a noisy position.

Three jobs of `surffollow.benchmark.job_loop`. Lengths are in stand-offs s₀, times in time constants τ. The
ground heaves by 0.3 s₀ in 50 τ, shakes by 0.03 s₀ in 20 τ and 0.02 s₀ in 33 τ, or stays: waves of 4 and
1.7 s₀, or planes of ±30 %. Figures are the RMS of the stand-off in thousandths of s₀, as a mean over seeds,
behind the default follower and a P loop.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence

import numpy as np

from surffollow.benchmark.job_loop import BOOM, CELL, Job, follow

Ground = Callable[[float, float], float]
DRONE = Job(2.0, 0.3, 0.1, 0.05, 3.0, 4.0, 0.03, (0.2, 10.0))
JOBS = {"cell": CELL, "boom": BOOM, "drone": DRONE}
SECONDS_TAUS = 200.0
# job, ground, speed [mm/s], standard deviation of the position [% of s₀]
CASES = [
    *(("cell", "heaves", v, 0.0) for v in (0, 6, 12, 25, 50)),
    *(("boom", "heaves", v, 0.0) for v in (0, 14, 42)),
    *(("cell", "shakes", v, 0.0) for v in (0, 6, 12, 25, 50)),
    *(("cell", "shakes", 0, noise) for noise in (0.3, 1.0)),
    *(("drone", "shakes", 0, noise) for noise in (0.0, 1.0, 2.5)),
    *(("cell", "waves", v, 0.0) for v in (6, 12, 25, 50)),
    *(("cell", "waves", v, 1.0) for v in (6, 25)),
    *(("cell", "planes", v, 0.0) for v in (6, 12, 30)),
    *(("boom", "planes", v, 0.0) for v in (14, 42)),
]


def sine(turns: float) -> float:
    return math.sin(2.0 * math.pi * turns)


def grounds(name: str, s0: float, tau: float) -> list[Ground]:
    """Grounds of a name for a job of these scales."""
    if name == "heaves":
        return [lambda x, t: 0.3 * s0 * sine(t / (50.0 * tau))]
    if name == "shakes":
        return [lambda x, t: 0.03 * s0 * sine(t / (20.0 * tau)) + 0.02 * s0 * sine(t / (33.0 * tau))]
    if name == "waves":
        return [lambda x, t: 0.1 * s0 * (sine(x / (4.0 * s0)) + 0.5 * sine(x / (1.7 * s0) + 0.16))]
    return [lambda x, t: 0.3 * x, lambda x, t: -0.3 * x]


def errors(case: tuple[str, str, float, float], seeds: range) -> tuple[float, float]:
    """Mean RMS of the follower and of a P loop, in thousandths of the stand-off."""
    name, ground, speed_mmps, noise_percent = case
    job = JOBS[name]
    found = [
        1e3
        * follow(
            job,
            g,
            SECONDS_TAUS * job.tau_s,
            1e-3 * speed_mmps,
            plain,
            seed=seed,
            place_noise_m=1e-2 * noise_percent * job.standoff_m,
        ).rms_m(job)
        / job.standoff_m
        for plain in (False, True)
        for g in grounds(ground, job.standoff_m, job.tau_s)
        for seed in seeds
    ]
    ours, plain_ones = np.split(np.array(found), 2)
    return float(ours.mean()), float(plain_ones.mean())


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=2, help="number of seeds (default: %(default)s)")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(argv)
    if given.seeds < 1:
        parser.error(f"--seeds is {given.seeds}; expected at least 1")
    rows = []
    for case in CASES:
        ours, plain = errors(case, range(given.seeds))
        keys = ("job", "ground", "speed_mmps", "position_noise_percent")
        rows.append(dict(zip(keys, case, strict=True)) | {"rms": ours, "p_rms": plain})
        if not given.json:
            name, ground, speed, noise = case
            print(
                f"{name:<6}{ground:<7} {speed:>3} mm/s, noise {noise:g} %: {ours:6.2f}, P loop {plain:6.2f}"
            )
    if given.json:
        print(json.dumps(rows, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
