"""Scribble over all that clients may write, at full speed, while a robot works; what the service made of it.

Three runs alternate: `idle` (nobody writes), `bytes` (random bytes over the whole inbox: heads, claims,
generations, poses, requests, access flags, streams, other clients' slots) and `commands` (well-formed poses
and requests with extreme values, in everybody's name). Overruns are compared with a run beside the same
writer on private memory (`neighbour`): on a machine of few processors a busy process alone costs some.

Fails when the service dies or stalls, an output is not finite or beyond its limit, overruns exceed those of
the quiet runs, nothing was refused and counted, or the service does not work normally afterwards.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SCRIBBLER = Path(__file__).with_name("scribbler.py")
sys.path.insert(0, str(ROOT / "tests"))

import numpy as np  # noqa: E402

from report import bar, bar_line  # noqa: E402
from running_service import POSE, Service, World, config_text, objects_of, until  # noqa: E402
from surffollow.client import Client  # noqa: E402
from surffollow.client.report import percentile_ns  # noqa: E402
from surffollow.config.params import PARAMS  # noqa: E402
from surffollow.errors import SurffollowError  # noqa: E402
from surffollow.shm import layout_board as lb  # noqa: E402
from surffollow.shm.layout_follow import Output, Params  # noqa: E402

RUNS = ("idle", "neighbour", "bytes", "commands")
COUNTERS = ("cycles", "overruns", "skipped", "poses_refused", "requests", "requests_refused", "torn")


class Robot:
    """A robot that works as if nothing were wrong, and checks every output that it sees."""

    def __init__(self, service: Service) -> None:
        self.client: Client = service.attach()
        self.outputs = self.poses = self.limited = self.refusals = 0
        self.faults: list[str] = []

    def params(self) -> tuple[int, float]:
        reader = self.client.board.latch("params", Params)
        generation = self.client.board.words[self.client.board.regions["params"][0] // 8]
        data = reader.read()
        return generation, math.inf if data is None else float(data["max_demand_m"])

    def step(self) -> None:
        try:
            self.client.ee_pos(POSE)
            self.poses += 1
        except SurffollowError:
            self.refusals += 1
        before, limit = self.params()
        output = self.client.board.latch("output", Output).read()
        after, _ = self.params()
        if output is None:
            return
        self.outputs += 1
        if not all(math.isfinite(v) for v in output["demand"]):
            self.faults.append(f"cycle {output['cycle']}: demand {output['demand']}")
        if before == after:
            self.limited += 1
            if abs(output["demand"][2]) > limit:
                self.faults.append(f"cycle {output['cycle']}: {output['demand'][2]} m beyond {limit} m")
        if output["status"] < 0 or not all(math.isfinite(v) for v in self.client.dev_vector()):
            self.faults.append(f"cycle {output['cycle']}: status {output['status']}")


def counters(robot: Robot) -> dict[str, int]:
    status = robot.client.status()
    return {k: int(status[k]) for k in COUNTERS}


def one_run(service: Service, robot: Robot, kind: str, seconds: float, seed: int) -> dict[str, Any]:
    """One piece of one kind of run; what the counters gained."""
    child = None
    if kind != "idle":
        words = [sys.executable, str(SCRIBBLER), service.name, kind, str(seed)]
        child = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        assert child.stdout is not None
        child.stdout.readline()
    before, end = counters(robot), time.monotonic() + seconds
    work = robot.client.board.plain("stats", lb.Stats)["execution"]
    while time.monotonic() < end:
        robot.step()
        if service.process is None or service.process.poll() is not None:
            robot.faults.append(f"the service ended during {kind}")
            break
    after = counters(robot)
    gained: dict[str, Any] = {k: after[k] - before[k] for k in COUNTERS}
    now = robot.client.board.plain("stats", lb.Stats)["execution"]
    gained["work"] = np.array(now) - np.array(work)
    if child is not None:
        child.kill()
        text, _ = child.communicate()
        gained["writes"] = int(text.split()[-1]) if text.split() else 1
    return gained


def works(service: Service) -> bool:
    """Whether a fresh robot gets a demand, answers and a map."""
    with service.attach() as client:
        defaults = {n: s.default for n, s in PARAMS.items() if not n.startswith(("range_", "sensor_latency"))}
        window = {"range_min_m": PARAMS["range_min_m"].default, "range_max_m": PARAMS["range_max_m"].default}
        values = {**window, **defaults, "range_size": 5, "sensor_latency_ns": 30e6, "mode": 0}
        client.claim_pose()
        for k in range(0, len(values), lb.REQUEST_ARGS):
            client.set_params(**dict(list(values.items())[k : k + lb.REQUEST_ARGS]))
        client.sf_reset(0.1)
        client.map_reset((0.0, 0.0, 0.1, 0.1), timeout_s=30.0)

        def good() -> bool:
            client.ee_pos(POSE)
            return client.dev_vector().valid

        until(good, "a demand after the fuzzing")
        with client.exclusive(timeout_s=40.0):
            return True


def run(args: argparse.Namespace) -> dict[str, Any]:
    pieces = max(1, round(args.seconds / 5))
    piece_s = args.seconds / pieces
    totals: dict[str, dict[str, Any]] = {k: dict.fromkeys(COUNTERS, 0) for k in RUNS}
    report: dict[str, Any] = {"seconds": args.seconds, "seed": args.seed, "cpus": os.cpu_count()}
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        config = config_text(kind="simulated", period=args.period, map='access_lease = "1 s"')
        service = Service(Path(folder), config)
        stack.callback(service.purge)
        world = World(service.name)
        stack.callback(world.close)
        service.start()
        robot = Robot(service)
        for piece in range(pieces):
            for kind in RUNS:
                gained = one_run(service, robot, kind, piece_s, args.seed + piece)
                for k, v in gained.items():
                    totals[kind][k] = totals[kind].get(k, 0) + v
        robot.client.close()
        report["works_afterwards"] = works(service)
        report["exit_code"] = service.terminate(signal.SIGTERM)
        report["left"] = sorted(objects_of(service.name) - {f"{service.name}.map", f"{service.name}.world"})
    for t in totals.values():
        work = t.pop("work").tolist()
        t["work_p50_ns"], t["work_p99_9_ns"] = (round(percentile_ns(work, f)) for f in (0.5, 0.999))
        t["overruns_per_100000"] = round(1e5 * t["overruns"] / max(1, t["cycles"]), 1)
    report |= {"runs": totals, "outputs": robot.outputs, "checked_against_limit": robot.limited}
    report |= {
        "poses": robot.poses,
        "refusals_seen_by_the_robot": robot.refusals,
        "faults": robot.faults[:10],
    }
    rate = {k: totals[k]["overruns_per_100000"] for k in RUNS}
    quiet = max(rate["idle"], rate["neighbour"]) + args.slack
    # overruns come by chance: two equal runs differ by so much and more once in forty times
    most = max(totals[k]["overruns"] for k in ("idle", "neighbour"))
    noise = 2e5 * math.sqrt(2 * most) / max(1, totals["idle"]["cycles"])
    counted = sum(totals["bytes"][k] for k in ("poses_refused", "requests_refused", "torn"))
    unit = "in 100,000 cycles"
    report["bars"] = [
        bar("bad outputs", len(robot.faults), 0, ""),
        bar(
            "overruns while scribbled at",
            rate["bytes"],
            quiet + noise,
            unit,
            f"quiet {quiet:.1f}, chance {noise:.1f}",
        ),
        bar(
            "overruns in a flood of commands",
            rate["commands"],
            quiet + noise,
            unit,
            f"quiet {quiet:.1f}, chance {noise:.1f}",
        ),
        bar("damage that was not counted", int(counted == 0), 0, "", f"counted {counted}"),
        bar("service's exit code", abs(report["exit_code"]), 0, ""),
        bar("objects left", len(report["left"]), 0, ""),
    ]
    return report


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each kind of run")
    parser.add_argument("--period", default="1 ms", help="of the service's cycle")
    parser.add_argument("--seed", type=int, default=91)
    parser.add_argument("--slack", type=float, default=0.0, help="more overruns allowed in 100,000 cycles")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    report = run(args)
    if args.json:
        print(json.dumps(report))
    else:
        for kind, totals in report["runs"].items():
            print(f"{kind:10s}", ", ".join(f"{k} {v}" for k, v in totals.items()))
        print(*(f"{k}: {v}" for k, v in report.items() if k not in ("runs", "bars")), sep="\n")
        print(*map(bar_line, report["bars"]), sep="\n")
    return 0 if all(b["ok"] for b in report["bars"]) else 1


if __name__ == "__main__":
    sys.exit(main())
