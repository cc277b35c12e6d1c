"""Search for hazards: scenarios of wrong readings and poses, followers and a plain P loop side by side.

Printed per family: the least clearance of each [mm, 100 wanted], how far the first follower came nearer to
the ground than the P loop did or than wanted, and contacts while the demand was VALID. The worst is shrunk.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from surffollow import Follower
from surffollow.benchmark.cell_runs import in_parallel
from surffollow.benchmark.hazard_scenarios import FAMILIES, FAR_M, KINDS, NEAR_M, STANDOFF_M, Scenario, draw
from surffollow.benchmark.hazards import PLoop, play, shortfall_m, shrink

BELOW_P_M = 5e-3
METHODS = ("adaptive", "paper", "p")


def make(method: str, family: str, interval_ms: int = 0) -> Any:
    if method == "p":
        return PLoop(interval_ms)
    sensors = [
        {"near_m": NEAR_M, "far_m": FAR_M, "position_m": [x, y, 0.0]} for x, y in KINDS[family].mounts_m
    ]
    config: dict[str, Any] = {"mode": method, "sensors": sensors}
    if method == "paper":
        config["pose_interpolate"] = "latest"
    return Follower(config, offset_m=STANDOFF_M)


def run(job: tuple[str, int, tuple[str, ...]]) -> dict[str, Any]:
    family, seed, methods = job
    scenario = draw(family, seed)
    played = {m: asdict(play(make(m, family, scenario.interval_ms), scenario)) for m in methods}
    return {"scenario": asdict(scenario), **played}


def show_progress(done: int, total: int) -> None:
    """Overwrite the terminal's line with the number of scenarios played."""
    print(f"\r{done} of {total} scenarios", end="" if done < total else "\n", file=sys.stderr)


def below(row: dict[str, Any], method: str) -> float:
    return shortfall_m(row["p"]["clearance_m"], row[method]["clearance_m"])


def below_p_m(method: str, s: Scenario) -> float:
    clearance = {m: play(make(m, s.family, s.interval_ms), s).clearance_m for m in ("p", method)}
    return shortfall_m(clearance["p"], clearance[method])


def main(argv: Sequence[str] | None = None) -> int:
    """Run the search; exit 1 when the first method misses a limit."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=50, help="scenarios per family")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--families", default=",".join(FAMILIES))
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(argv)
    methods = tuple(dict.fromkeys([*given.methods.split(","), "p"]))
    if given.count < 1:
        parser.error(f"--count is {given.count}; expected at least 1")
    if unknown := [m for m in methods if m not in METHODS]:
        parser.error(f"unknown methods {unknown}; there are {list(METHODS)}")
    families = [f for f in given.families.split(",") if f]
    if not families:
        parser.error(f"--families names none; there are {list(FAMILIES)}")
    if unknown := [f for f in families if f not in FAMILIES]:
        parser.error(f"unknown families {unknown}; there are {list(FAMILIES)}")
    jobs = [(f, given.first + k, methods) for f in families for k in range(given.count)]
    begun = time.process_time()
    found = list(in_parallel(run, jobs, given.processes, show_progress if sys.stderr.isatty() else None))
    found.sort(key=lambda r: r["scenario"]["seed"])
    first, rows = methods[0], []
    for family in families:
        of = [r for r in found if r["scenario"]["family"] == family]
        worst = max(of, key=lambda r: below(r, first))
        rows.append(
            {
                "family": family,
                "least_m": {m: min(r[m]["clearance_m"] for r in of) for m in methods},
                "below_p_m": {m: max(below(r, m) for r in of) for m in methods},
                "over_limit": {m: sum(below(r, m) > BELOW_P_M for r in of) for m in methods},
                "contact_valid": {m: sum(r[m]["contact_valid"] for r in of) for m in methods},
                "tilt_rad": {m: max(r[m]["tilt_rad"] for r in of) for m in methods},
                "worst": worst["scenario"],
            }
        )
        if rows[-1]["below_p_m"][first] > BELOW_P_M:
            least = shrink(Scenario(**worst["scenario"]), lambda s: below_p_m(first, s) > BELOW_P_M)
            rows[-1]["shrunk"] = asdict(least)
    met = all(r["below_p_m"][first] <= BELOW_P_M and r["contact_valid"][first] == 0 for r in rows)
    if given.json:
        done = {
            "rows": rows,
            "scenarios": len(jobs),
            "limit_m": BELOW_P_M,
            "met": met,
            "cpu_s": time.process_time() - begun,
        }
        print(json.dumps(done, indent=1))
        return 0 if met else 1
    head = "least, below p [mm], over the limit, VALID contacts"
    print("| family |" + "".join(f" {m}: {head} |" for m in methods))
    print("| --- |" + " --- |" * len(methods))
    for r in rows:
        cells = (
            f" {1e3 * r['least_m'][m]:.1f}, {1e3 * r['below_p_m'][m]:.1f}, {r['over_limit'][m]},"
            f" {r['contact_valid'][m]} |"
            for m in methods
        )
        print(f"| {r['family']} |" + "".join(cells))
        if r["tilt_rad"][first] > 0.0:
            print(
                f"{r['family']}: tilt of {first} up to {math.degrees(r['tilt_rad'][first]):.1f} deg",
                file=sys.stderr,
            )
        if "shrunk" in r:
            print(f"least harmful scenario: {r['shrunk']}", file=sys.stderr)
    over, touched = (sum(r[key][first] for r in rows) for key in ("over_limit", "contact_valid"))
    print(
        f"{len(jobs)} scenarios: {first} is more than {1e3 * BELOW_P_M:g} mm below p in {over},"
        f" and touches the ground while VALID in {touched}; the limit is none of either"
    )
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
