"""Cost of calls to the service, in C and Python, beside other ways between two processes.

    python tools/bench_ipc.py [--rounds 3000] [--json]

One daemon at 10 kHz with a simulated sensor. Calls are timed in batches (64 in C, 100 in Python) and the
median of the batches is given; the clock that the calls read is inside. Hand-over: from before ee_pos to
the demand that refers to that very pose, polled, one pose at a time at random phases of the cycle.
The others pass 64 bytes to a process that sends them back; half of that is their hand-over.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ipc_others import WAYS, measure
from report import criterion, finish, result
from service_process import pinned, service_process
from surffollow.client import DEMAND_BYTES, Client, attach
from surffollow.shm.cheader import HEADER
from surffollow.shm.dtypes import zeros
from surffollow.sim.world import WorldPose, WorldWriter

PERIOD_NS = 100_000
PYTHON_NS, INTO_NS, C_NS, SLACK_NS = 1200.0, 600.0, 50.0, 2000.0
PUSH_NS, C_PUSH_NS = 1500.0, 60.0
POSE = (0.05, 0.05, 0.1, 0.0, 0.0, 0.0, 1.0)
CONFIG = """
period = "100 us"
log_words = 65536
[realtime]
cpu = CPU
[map]
grids = 1000
[driver]
kind = "simulated"
[driver.world]
surface = "flat"
region = [0.0, 0.0, 0.1, 0.1]
"""
EXTERNAL = """
[driver]
kind = "external"
range_min_m = "50 mm"
range_max_m = "300 mm"
"""


def per_call_ns(call: Callable[[], object], batches: int = 1000, calls: int = 100) -> tuple[float, float]:
    """p50 and p99 of batches of calls [ns per call]."""
    found, turns = [], range(calls)
    for _ in range(batches):
        start = time.perf_counter_ns()
        for _ in turns:
            call()
        found.append((time.perf_counter_ns() - start) / calls)
    found.sort()
    return found[batches // 2], found[int(batches * 0.99)]


def stand_still(world: WorldWriter) -> None:
    """Tell the simulated sensor that the tool is where it was."""
    record = zeros(WorldPose)
    record[0]["pose"], record[0]["t_ns"] = POSE, time.monotonic_ns()
    world.write(record)


def python_figures(name: str, rounds: int, world: WorldWriter) -> dict[str, float]:
    """Cost of the Python client's calls, and its hand-over."""
    out: dict[str, float] = {}
    with attach(name, label="bench") as robot:
        robot.ee_pos(POSE)
        calls: dict[str, Callable[[], object]] = {
            "dev_vector": robot.dev_vector,
            "ee_pos": lambda: robot.ee_pos(POSE),
            "nothing": lambda: None,
        }
        buffer = bytearray(DEMAND_BYTES)
        calls["dev_vector_into"] = lambda: robot.dev_vector_into(buffer)
        for what, call in calls.items():
            # poses and readings count for 100 ms, which the batches fit into: these are valid demands
            deadline = time.monotonic() + 20.0
            while not robot.dev_vector().valid:
                stand_still(world)
                robot.ee_pos(POSE)
                time.sleep(0.001)
                if time.monotonic() > deadline:
                    raise SystemExit(f"no valid demand: {robot.dev_vector()}")
            stand_still(world)
            robot.ee_pos(POSE)
            out[f"{what}_p50_ns"], out[f"{what}_p99_ns"] = per_call_ns(call)
        trips = [_hand_over(robot) for _ in range(rounds)]
    trips.sort()
    out["handover_p50_ns"], out["handover_p99_ns"] = trips[rounds // 2], trips[int(rounds * 0.99)]
    return out


def _hand_over(robot: Client) -> int:
    time.sleep(0.0003 + 0.0001 * random.random())
    t_ns = time.monotonic_ns()
    robot.ee_pos(POSE, t_ns)
    while robot.dev_vector().pose_t_ns != t_ns:
        if time.monotonic_ns() - t_ns > 1_000_000_000:
            raise SystemExit("no demand refers to the pose")
    return time.monotonic_ns() - t_ns


def c_figures(name: str, folder: Path, rounds: int) -> dict[str, float]:
    """The same for the C client; empty without a compiler."""
    return c_modes(name, folder, (("calls", 20000), ("handover", rounds)))


def c_modes(name: str, folder: Path, modes: tuple[tuple[str, int], ...]) -> dict[str, float]:
    """Figures of ipc_timing.c in some of its modes; empty without a compiler."""
    if shutil.which("gcc") is None:
        return {}
    program = str(folder / "ipc_timing")
    source = str(Path(__file__).with_name("ipc_timing.c"))
    subprocess.run(["gcc", "-std=c11", "-O2", f"-I{HEADER.parent}", source, "-o", program], check=True)
    out = {}
    for mode, n in modes:
        command = [program, mode, name, str(n)]
        words = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
        out.update({words[i]: float(words[i + 1]) for i in range(0, len(words), 2)})
    return out


def pushing_figures(name: str, folder: Path) -> tuple[dict[str, float], dict[str, float]]:
    """Cost of a pushed range in Python and C, the clock's look for its time included."""
    with attach(name, label="bench") as laser:

        def push() -> None:
            laser.push_range(0, time.monotonic_ns(), 0.1)

        push()
        p50, p99 = per_call_ns(push)
        laser.release_range(0)
    return {"push_range_p50_ns": p50, "push_range_p99_ns": p99}, c_modes(name, folder, (("push", 20000),))


def with_daemon(rounds: int) -> tuple[dict[str, float], dict[str, float]]:
    """Figures of the Python and the C client against one daemon, and of pushed ranges against another."""
    name = f"bench-ipc-{os.getpid()}"
    with tempfile.TemporaryDirectory() as path:
        folder = Path(path)
        with contextlib.closing(WorldWriter(name)) as world, service_process(name, pinned(folder, CONFIG)):
            python, c = python_figures(name, rounds, world), c_figures(name, folder, rounds)
        config = pinned(folder, CONFIG.partition("[driver]")[0] + EXTERNAL)
        with service_process(f"{name}-out", config):
            pushed, c_pushed = pushing_figures(f"{name}-out", folder)
    return python | pushed, c | c_pushed


def clear_debris(before: set[Path]) -> int:
    """Remove what iceoryx2 left behind in this run; how many files in /dev/shm that were."""
    left = set(Path("/dev/shm").glob("iox2_*")) - before
    for path in left:
        path.unlink(missing_ok=True)
    return len(left)


def main(rounds: int) -> dict[str, Any]:
    """Measure everything in one run and hold ours against the criteria."""
    python, c = with_daemon(rounds)
    before, state = set(Path("/dev/shm").glob("iox2_*")), Path("/tmp/iceoryx2")
    was_there = state.exists()
    others = {way: measure(way, rounds) for way in WAYS}
    debris = clear_debris(before)
    if not was_there:
        shutil.rmtree(state, ignore_errors=True)
    no_c = "" if c else "no gcc here"
    criteria = [
        criterion("Python ee_pos p50", python["ee_pos_p50_ns"], PYTHON_NS, "ns"),
        criterion("Python dev_vector p50", python["dev_vector_p50_ns"], PYTHON_NS, "ns"),
        criterion("Python dev_vector_into p50", python["dev_vector_into_p50_ns"], INTO_NS, "ns"),
        criterion("Python ee_pos p50, as it makes no object", python["ee_pos_p50_ns"], INTO_NS, "ns"),
        criterion("C ee_pos p50", c.get("ee_pos_p50_ns"), C_NS, "ns", no_c),
        criterion("C dev_vector p50", c.get("dev_vector_p50_ns"), C_NS, "ns", no_c),
        criterion("Python push_range p50", python["push_range_p50_ns"], PUSH_NS, "ns"),
        criterion("C sf_push_range p50", c.get("push_p50_ns"), C_PUSH_NS, "ns", no_c),
        criterion(
            "C pose to demand at 10 kHz p50", c.get("handover_p50_ns"), PERIOD_NS + SLACK_NS, "ns", no_c
        ),
        criterion(
            "Python pose to demand at 10 kHz p50", python["handover_p50_ns"], PERIOD_NS + SLACK_NS, "ns"
        ),
    ]
    if "clock_p50_ns" in c:
        criteria[5]["note"] = criteria[4]["note"] = f"the clock alone takes {c['clock_p50_ns']:.0f} ns"
    notes = ["other ways, Python to Python:"]
    for way, figures in others.items():
        if figures is None:
            notes.append(f"  {way:<26} not installed")
            continue
        notes.append(
            f"  {way:<26} hand-over p50 {figures['handover_p50_ns'] / 1e3:8.2f} us, "
            f"p99 {figures['handover_p99_ns'] / 1e3:8.2f} us, a look {figures['take_p50_ns'] / 1e3:7.2f} us"
        )
    if debris:
        notes.append(f"  iceoryx2 left {debris} objects in /dev/shm, removed here")
    what = "Calls of the clients, pose to demand through the daemon at 10 kHz, and other ways"
    return result(what, criteria, notes, python=python, c=c, others=others)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3000, help="hand-overs of each kind")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    sys.exit(finish(main(parser.parse_args().rounds)))
