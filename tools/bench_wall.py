"""Bench the wall-following experiments: figures of merit over many seeds, in simulated time.

    python tools/bench_wall.py [--json] [--seeds A:B]

"distance RMS" is that of the distance to the followed wall about its mean over four laps. "heading repeats"
is the standard deviation, over the laps, of the mean heading along each wall. "heading beside a wall" is that
of a base that stands there or drives along, with and without follow-wall-2 ("corrected").
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from report import criterion, finish, result
from surffollow.apps.wall_figures import figures
from surffollow.apps.wall_following import EXPERIMENTS, run_experiment
from surffollow.apps.wall_heading import heading_table

LAPS = 4


def one(job: tuple[str, int]) -> dict[str, float]:
    """Figures of one run."""
    return figures(run_experiment(job[0], laps=LAPS, seed=job[1]))


def main() -> dict[str, Any]:
    """All experiments over all seeds, on two processors."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--json", action="store_true")
    words.add_argument("--seeds", default="2000:2020")
    first, last = words.parse_args().seeds.split(":")
    seeds = range(int(first), int(last))
    one(("2", 0))  # compiles
    jobs = [(e, s) for e in EXPERIMENTS for s in seeds]
    with ProcessPoolExecutor(2) as pool:
        runs = dict(zip(jobs, pool.map(one, jobs)))

    def median(experiment: str, key: str) -> float:
        return statistics.median(runs[experiment, s][key] for s in seeds)

    def contacts(experiment: str) -> float:
        return sum(runs[experiment, s]["contacts"] for s in seeds)

    degrees = {
        (e, k): math.degrees(median(e, k))
        for e in EXPERIMENTS
        for k in ("heading_repeatability_rad", "heading_rms_rad")
    }
    criteria = [
        criterion("experiment 1, distance RMS", 1e3 * median("1", "distance_rms_m"), 60.0, "mm"),
        criterion("experiment 1, heading repeats", degrees["1", "heading_repeatability_rad"], 3.0, "deg"),
        criterion("experiment 2, distance RMS", 1e3 * median("2", "distance_rms_m"), 25.0, "mm"),
        criterion("experiment 2, heading repeats", degrees["2", "heading_repeatability_rad"], 1.5, "deg"),
        criterion("contacts, experiment 1", contacts("1"), 0, ""),
        criterion("contacts, experiment 2", contacts("2"), 0, ""),
        criterion("contacts, experiment 1 by a pair, with avoid", contacts("1-pair"), 0, ""),
    ]
    notes = [
        f"experiment {e}: distance RMS {1e3 * median(e, 'distance_rms_m'):.0f} mm, heading repeats within "
        f"{degrees[e, 'heading_repeatability_rad']:.2f} deg, off the wall by "
        f"{degrees[e, 'heading_rms_rad']:.2f} deg RMS, "
        f"contacts {contacts(e):.0f}, turns {median(e, 'turns'):.0f}, {median(e, 'seconds'):.0f} s"
        for e in EXPERIMENTS
    ]
    notes += [
        f"heading beside a wall, {case}: variance {f['variance_rad2'] * math.degrees(1.0) ** 2:.4f} deg², "
        f"off the wall by {math.degrees(f['error_rms_rad']):.2f} deg RMS"
        for case, f in heading_table(seeds).items()
    ]
    return result(f"wall following, {LAPS} laps, {len(seeds)} seeds", criteria, notes, seeds=[*seeds])


if __name__ == "__main__":
    sys.exit(finish(main()))
