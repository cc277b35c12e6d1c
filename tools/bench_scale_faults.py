"""Faults of the range sensor at every scale, from a torch over a weld seam to an AUV, beside a plain P loop.

Printed per fault: how far the least clearance is below that of the P loop, or below the stand-off if that is
less, and runs in which that is more than 5 % of the stand-off; how far the tool rose above the P loop; runs
with a VALID demand for less than a third of the time behind the begin of the fault. The limit is no contact
while VALID.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bench_hazards import show_progress
from scale_cases import CASES
from scale_faults import FAULTS, FaultyDoor, PLoop
from surffollow.benchmark.cell_runs import in_parallel
from surffollow.benchmark.drive import drive
from surffollow.benchmark.methods import factory_of

CASES_USED = CASES["tune"] + CASES["publish"]
JOBS = {case.name: replace(case, duration_s=0.5 * case.duration_s) for case in CASES_USED}
BELOW, SELDOM = 0.05, 1.0 / 3.0


def play(job: str, fault: str, seed: int, method: str) -> dict[str, Any]:
    """Least and greatest clearance [stand-offs], RMS behind the begin [stand-offs], share VALID, contact."""
    case = JOBS[job]
    scene = case.scene(seed)
    run, world = scene.fresh()
    follower = PLoop(case) if method == "p" else factory_of(method)(scene.conditions)
    door = FaultyDoor(follower, case, FAULTS[fault], fault == "late stamps", seed, 1e-3 * len(world.z))
    drive(door, run, world)
    begin_ms = round(1e3 * door.begin_s)
    clearance = ((world.z - scene.ground_m) / case.standoff_m)[begin_ms:]
    touched = np.nonzero(clearance <= 0.0)[0]
    at_s = 1e-3 * (begin_ms + int(touched[0])) if len(touched) else -1.0
    return {
        "least": float(clearance.min()),
        "most": float(clearance.max()),
        "rms": float(np.sqrt(np.mean((clearance - 1.0) ** 2))),
        "valid": float(np.mean([ok for t, ok in door.valid if t > door.begin_s])),
        "contact_valid": bool([ok for t, ok in door.valid if t <= at_s][-1]) if at_s > 0.0 else False,
    }


def run(job: tuple[str, str, int]) -> dict[str, Any]:
    """A job with a fault, by the follower and by the P loop."""
    return {"job": job[0], "fault": job[1], "ours": play(*job, "ours"), "p": play(*job, "p")}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of one fault."""
    losses = [min(r["p"]["least"], 1.0) - r["ours"]["least"] for r in rows]
    rises = [r["ours"]["most"] - max(r["p"]["most"], 1.0) for r in rows]
    return {
        "runs": len(rows),
        "greatest_loss": max(losses),
        "over_limit": sum(loss > BELOW for loss in losses),
        "greatest_rise": max(rises),
        "mean_rise": float(np.mean(np.maximum(rises, 0.0))),
        "without_demand": sum(r["ours"]["valid"] < SELDOM for r in rows),
        "contact_valid": sum(r["ours"]["contact_valid"] for r in rows),
        "rms": float(np.mean([r["ours"]["rms"] for r in rows])),
        "rms_p": float(np.mean([r["p"]["rms"] for r in rows])),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the faults; exit 1 at a contact while the demand is VALID."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=1, help="runs per fault and job")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--faults", default=",".join(FAULTS))
    parser.add_argument("--job", action="append", help="only jobs whose name contains this")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(argv)
    faults = given.faults.split(",")
    if unknown := [f for f in faults if f not in FAULTS]:
        parser.error(f"unknown faults {unknown}; there are {list(FAULTS)}")
    names = [n for n in JOBS if not given.job or any(part in n for part in given.job)]
    if not names or given.count < 1:
        parser.error(f"no job; there are {list(JOBS)}" if not names else "--count is below 1")
    jobs = [(n, f, given.first + k) for f in faults for n in names for k in range(given.count)]
    progress = show_progress if sys.stderr.isatty() else None
    found = list(in_parallel(run, jobs, given.processes, progress))
    rows = {f: summary([r for r in found if r["fault"] == f]) for f in faults}
    touched = sum(r["contact_valid"] for r in rows.values())
    if given.json:
        print(json.dumps({"rows": rows, "limits": {"below": BELOW, "contact_valid": 0}, "met": touched == 0}))
        return 0 if touched == 0 else 1
    print("| fault | runs | greatest loss | over 0.05 | greatest, mean rise | no demand | RMS (P loop) |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    for name, r in rows.items():
        loss = f"{r['greatest_loss']:.2f} | {r['over_limit']}"
        rise = f"{r['greatest_rise']:.1f}, {r['mean_rise']:.2f}"
        rms = f"{r['rms']:.3f} ({r['rms_p']:.3f})"
        print(f"| {name} | {r['runs']} | {loss} | {rise} | {r['without_demand']} | {rms} |")
    print(f"{len(jobs)} runs, lengths in stand-offs; {touched} contacts while VALID, the limit is none")
    return 0 if touched == 0 else 1


if __name__ == "__main__":
    sys.exit(main())
