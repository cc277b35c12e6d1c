"""Follow steep falls with drawn axes and noise: sensors that fail at the end of a fall, and good ones.

All is drawn in units of the stand-off s₀ and of the axis' time constant τ. The ground falls by 0.03 to 0.3 s₀
in τ. A faulty sensor freezes, or is blocked, at the end of the fall or up to 10 τ before it. Counted are runs
in which the tool touches the ground while the demand is VALID. Good sensors go on over the fall: the figures
are the RMS of the stand-off, and over that of a P loop.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from surffollow.benchmark.cell_runs import in_parallel
from surffollow.benchmark.job_loop import Job, follow

TAU_S, STANDOFF_M = 0.04, 0.1
STEEPEST = 0.75  # of the axis' greatest speed: at more of it a tool that was held comes back late
LEVEL_TAUS, SECONDS_TAUS, BEHIND_TAUS = 5.0, 80.0, 40.0  # before the fall, of a good sensor, behind the fall
LEAST_P = 0.01  # of s₀: a P loop that errs by less is not to be beaten


@dataclass(frozen=True)
class Fall:
    """A job, its fall, and what the sensor reads from `fault_s` on: one range, with other noise."""

    job: Job
    slope: float
    speed_mps: float
    fault_s: float
    end_s: float
    size_m: float
    noise_m: float

    def ground_m(self, ends: bool) -> Any:
        """Height of the ground at a place and a time."""
        begin_m, end_m = LEVEL_TAUS * self.speed_mps * TAU_S, self.speed_mps * self.end_s
        return lambda x_m, t_s: -self.slope * max((min(x_m, end_m) if ends else x_m) - begin_m, 0.0)


def log_uniform(rng: np.random.Generator, least: float, most: float) -> float:
    return math.exp(rng.uniform(math.log(least), math.log(most)))


def draw(seed: int, steepest: float) -> Fall:
    """Draw a job, its fall, at a share of the axis' greatest speed at most, and its fault."""
    rng, unit_mps = np.random.default_rng([seed, 5]), STANDOFF_M / TAU_S
    reading_s = max(1e-3, round(1e3 * TAU_S * log_uniform(rng, 0.05, 1.5)) * 1e-3)
    pose_s = round(1e3 * TAU_S * rng.uniform(0.1, 0.5)) * 1e-3
    v_max = unit_mps * log_uniform(rng, 0.08, 1.5)
    a_max = v_max / TAU_S / rng.uniform(0.25, 1.5)
    sigma_m, window_m = STANDOFF_M * log_uniform(rng, 0.001, 0.012), (0.3 * STANDOFF_M, 3.0 * STANDOFF_M)
    job = Job(STANDOFF_M, TAU_S, reading_s, pose_s, v_max, a_max, sigma_m, window_m)
    rate, slope = min(unit_mps * log_uniform(rng, 0.03, 0.3), steepest * v_max), rng.uniform(0.1, 1.0)
    fault_s = TAU_S * rng.uniform(40.0, 50.0)
    end_s = fault_s + TAU_S * rng.uniform(0.0, 10.0) * int(rng.integers(0, 2))
    kind = int(rng.integers(0, 3))  # frozen, blocked near the stand-off, blocked farther from it
    size_m = STANDOFF_M * (0.0, 0.03, 0.2)[kind] * rng.uniform(-1.0, 1.0)
    return Fall(
        job, slope, rate / slope, fault_s, end_s, size_m, sigma_m * float(rng.choice([0.0, 0.2, 1.0]))
    )


def run_faulty(seed: int, steepest: float) -> bool:
    """Whether the tool touches the ground while the demand is VALID."""
    fall, held = draw(seed, steepest), []

    def misread(t_s: float, range_m: float, rng: np.random.Generator) -> float:
        if t_s < fall.fault_s:
            return range_m
        if not held:
            held.append(range_m + fall.size_m)
        return held[0] + fall.noise_m * float(rng.standard_normal())

    seconds = fall.end_s + BEHIND_TAUS * TAU_S
    run = follow(fall.job, fall.ground_m(True), seconds, fall.speed_mps, misread=misread, seed=seed)
    valid = ["VALID" in s["status"] for s in run.states]
    return bool(np.any((run.clearance_m <= 0.0) & np.array(valid)))


def run_good(seed: int, steepest: float) -> tuple[float, float, float]:
    """RMS of the follower and of a P loop, and the follower's greatest clearance [s₀]."""
    fall, seconds = draw(seed, steepest), SECONDS_TAUS * TAU_S
    ours, plain = (
        follow(fall.job, fall.ground_m(False), seconds, fall.speed_mps, plain=plain, seed=seed)
        for plain in (False, True)
    )
    rms, rms_p = (r.rms_m(fall.job) / STANDOFF_M for r in (ours, plain))
    return rms, rms_p, float(ours.clearance_m.max()) / STANDOFF_M


def run(seed: int, steepest: float = STEEPEST) -> tuple[int, bool, tuple[float, float, float]]:
    """Both runs of a seed."""
    return seed, run_faulty(seed, steepest), run_good(seed, steepest)


def show_progress(done: int, total: int) -> None:
    """Overwrite the terminal's line with the number of seeds done."""
    print(f"\r{done} of {total} seeds", end="" if done < total else "\n", file=sys.stderr)


def main(argv: Sequence[str] | None = None) -> int:
    """Run both parts; exit 1 when a faulty sensor leads to a contact while VALID."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=400, help="seeds; each has a faulty and a good sensor")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument(
        "--steepest",
        type=float,
        default=STEEPEST,
        metavar="SHARE",
        help="greatest rate of a fall, of the axis' greatest speed (default: %(default)s)",
    )
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(argv)
    if given.count < 1:
        parser.error(f"--count is {given.count}; expected at least 1")
    seeds = range(given.first, given.first + given.count)
    both, show = partial(run, steepest=given.steepest), show_progress if sys.stderr.isatty() else None
    found = list(in_parallel(both, seeds, given.processes, show))
    contacts = sorted(seed for seed, touched, _ in found if touched)
    ours, plain, highest = np.array([good for *_, good in found]).T
    ratio = ours / np.maximum(plain, LEAST_P)
    result = {
        "runs": given.count,
        "contacts_valid": len(contacts),
        "seeds_of_contacts": contacts,
        "rms_standoffs": float(ours.mean()),
        "p_rms_standoffs": float(plain.mean()),
        "ratio_geometric_mean": float(np.exp(np.log(ratio).mean())),
        "worse_than_p": int((ratio > 1.0).sum()),
        "above_2_5_standoffs": int((highest > 2.5).sum()),
    }
    if given.json:
        print(json.dumps(result, indent=1))
    else:
        print(f"faulty sensors: {len(contacts)} contacts while VALID in {given.count} runs")
        print(
            f"good sensors: RMS {ours.mean():.3f} stand-offs, P loop {plain.mean():.3f}; geometric mean of"
            f" the ratio {result['ratio_geometric_mean']:.2f}; {result['worse_than_p']} worse than the P"
            f" loop, {result['above_2_5_standoffs']} higher than 2.5 stand-offs"
        )
    return 1 if contacts else 0


if __name__ == "__main__":
    sys.exit(main())
