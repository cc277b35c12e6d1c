"""Attack a service at random while a robot works: eleven kinds of attack by a user with no right but a slot.

`scribble` random bytes, extreme commands and ranges of channels that it claims in its slot, `cut` and
`restore` its size, `punch` holes, `lock` every byte that a reader can lock, `impostor` a forged board
under the service's name between its end and its next start, `full` fill /dev/shm, `churn` slots, pass
sockets that `linger` when they are closed, `crowd` the socket with silent connections, flood the `audit`
trail with refused changes. Idle pieces of the
same length alternate with the attacks, for comparison. The robot pushes the ranges of channel 0
(`--driver simulated`: the simulated sensor rides on a world block).

Fails when a distance of that channel is not the one that was pushed, the service ends, a demand is not
finite, beyond its limit or an impostor's, more cycles take longer than 300 us under attack than idle, or
a good client that attaches after an attack waits longer than 200 ms for an answer. Runs as root, with a
small /dev/shm in a mount namespace of its own where that is allowed; else `full` is left out.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from fuzz_attacks import KINDS, SHM, attack  # noqa: E402
from report import criterion, criterion_line  # noqa: E402
from running_service import POSE, Service, World, config_text, objects_of, until  # noqa: E402
from second_user import NOBODY, OtherUser  # noqa: E402
from service.test_foreign_names import forged_board  # noqa: E402
from surffollow.client import Client  # noqa: E402
from surffollow.errors import SurffollowError  # noqa: E402
from surffollow.service.cycle import histogram_bin  # noqa: E402
from surffollow.shm import layout_board as lb  # noqa: E402
from surffollow.shm.layout_follow import Output, Params  # noqa: E402

MODES = 'board_mode = "0644"\nsocket_mode = "0666"\nmap_mode = "0644"\n'
ACCESS = MODES + 'parameters = "any"\nmap = "any"\nranges = "any"\n'
LONG_NS = 300_000
ANSWER_S = 0.2
FORGED_M = -0.5
PUSHED_M = 0.125
WINDOW = 'range_min_m = "50 mm"\nrange_max_m = "150 mm"\nchannels = 8'
_CLONE_NEWNS = 0x20000


def private_shm(megabytes: int) -> bool:
    """A /dev/shm that no other process of the machine sees; False where that is not allowed."""
    if ctypes.CDLL(None, use_errno=True).unshare(_CLONE_NEWNS) != 0:
        return False
    commands = (
        ["mount", "--make-rprivate", "/"],
        ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m,mode=1777", "tmpfs", str(SHM)],
    )
    return all(subprocess.run(c, capture_output=True).returncode == 0 for c in commands)


class Robot:
    """A robot that works as if nothing were wrong, and checks every demand that it sees."""

    def __init__(self, service: Service, pushes: bool) -> None:
        self.service, self.pushes = service, pushes
        self.client: Client = service.attach()
        self.demands = self.poses = self.refusals = 0
        self.faults: list[str] = []
        self.slowest_s = 0.0

    def step(self) -> None:
        """One pose, one look at the demand."""
        try:
            self.client.ee_pos(POSE)
            if self.pushes:
                self.client.push_range(0, time.monotonic_ns(), PUSHED_M)
            self.poses += 1
        except SurffollowError:
            self.refusals += 1
        demand = self.client.dev_vector()
        tracked_m = self.client.raw_distance()
        if self.pushes and abs(tracked_m - PUSHED_M) > 1e-6:  # NaN is not
            self.faults.append(f"cycle {demand.cycle}: distance {tracked_m} m, {PUSHED_M} m was pushed")
        self.demands += 1
        board = self.client.board
        limits = [board.latch("params", Params).read() for _ in range(2)]
        output = board.latch("output", Output).read()
        highest = max((math.inf if p is None else float(p["max_demand_m"])) for p in limits)
        values = [*demand, *(output["demand"] if output else ())]
        if not all(math.isfinite(v) for v in values):
            self.faults.append(f"cycle {demand.cycle}: demand {values}")
        elif any(abs(v) > highest for v in values[2::6]) or demand[2] == FORGED_M:
            self.faults.append(f"cycle {demand.cycle}: {values} m beyond {highest} m")

    def work(self, seconds: float) -> None:
        """Many steps."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.step()
            if self.service.process is not None and self.service.process.poll() is not None:
                self.faults.append("the service ended")
                return

    def ask(self, kind: str) -> None:
        """A good client that comes after an attack: how long until it is answered."""
        began = time.monotonic()
        try:
            with self.service.attach() as client:
                client.sf_reset(0.1)
        except SurffollowError as e:
            self.faults.append(f"after {kind}: {e}")
        self.slowest_s = max(self.slowest_s, time.monotonic() - began)


def long_cycles(robot: Robot) -> tuple[int, int, int]:
    """Epoch, cycles, and those that took longer than 300 us."""
    stats = robot.client.board.plain("stats", lb.Stats)
    first = histogram_bin.py_func(LONG_NS) + 1
    return robot.client.epoch, int(stats["cycles"]), sum(stats["execution"][first:])


def impersonate(service: Service, robot: Robot, seconds: float) -> None:
    """End the service, let somebody else take its name, end him, start it again."""
    path = SHM / service.name
    epoch = robot.client.epoch
    forged = forged_board(path.read_bytes(), robot.client.board.regions["output"][0])
    service.terminate()

    def there(child: OtherUser) -> None:
        path.write_bytes(forged)
        path.chmod(0o666)
        child.say("attacks")
        child.receive()

    with OtherUser(there, NOBODY if os.geteuid() == 0 else os.getuid()) as other:
        other.receive()
        if os.geteuid() == 0:
            robot.work(seconds)
    path.unlink(missing_ok=True)
    service.start()
    until(lambda: robot.client.alive() and robot.client.epoch != epoch, "the service again")


def run(args: argparse.Namespace, private: bool) -> dict[str, Any]:
    rng = random.Random(args.seed)
    kinds = [k for k in KINDS if private or k != "full"]
    totals = {k: {"pieces": 0, "cycles": 0, "long": 0} for k in ("idle", *kinds)}
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        external = args.driver == "external"
        config = config_text(
            kind=args.driver,
            period=args.period,
            map='access_lease = "1 s"',
            access=ACCESS,
            driver=WINDOW if external else "",
        )
        service = Service(Path(folder), config)
        stack.callback(service.purge)
        world = World(service.name)
        stack.callback(world.close)
        service.start()
        robot = Robot(service, external)
        robot.ask("start")
        robot.slowest_s = 0.0
        end, order = time.monotonic() + args.seconds, list(kinds)
        while time.monotonic() < end or order:
            if not order:
                order = list(kinds)
            kind = order.pop(rng.randrange(len(order)))  # each comes, in any order
            seconds = rng.uniform(0.5, 1.5) * args.piece
            for what in ("idle", kind):
                before = long_cycles(robot)
                if what == "impostor":
                    impersonate(service, robot, seconds)
                elif what == "idle":
                    robot.work(seconds)
                else:
                    with OtherUser(attack(what, service.name, rng.randrange(1 << 30))) as attacker:
                        began = attacker.receive()
                        if began != "attacks":
                            raise SystemExit(f"the attack {what} did not begin: {began}")
                        robot.work(seconds)
                    (SHM / f"{service.name}.filler").unlink(missing_ok=True)
                if what != "idle":
                    robot.ask(what)
                after = long_cycles(robot)
                t = totals[what]
                t["pieces"] += 1
                if before[0] == after[0]:
                    t["cycles"] += after[1] - before[1]
                    t["long"] += after[2] - before[2]
        robot.client.close()
        code = service.terminate(signal.SIGTERM)
        own = {f"{service.name}{part}" for part in (".map", ".world", ".world.lock")}
        left = sorted(objects_of(service.name) - own)
    attacked = [totals[k] for k in kinds]
    cycles, long = sum(t["cycles"] for t in attacked), sum(t["long"] for t in attacked)
    idle = totals["idle"]
    share = cycles / max(1, idle["cycles"])
    # they come by chance: two equal runs differ by so much and more once in forty times
    most = idle["long"] * share + 2 * math.sqrt(idle["long"] * share * (1 + share)) + args.slack
    return {
        "seconds": args.seconds,
        "seed": args.seed,
        "cpus": os.cpu_count(),
        "private_shm": private,
        "runs": totals,
        "demands": robot.demands,
        "poses": robot.poses,
        "refusals_seen_by_the_robot": robot.refusals,
        "faults": robot.faults[:10],
        "criteria": [
            criterion("bad demands, refused clients and ends of the service", len(robot.faults), 0, ""),
            criterion(
                "cycles over 300 us under attack", long, most, "", f"idle {idle['long']} of {idle['cycles']}"
            ),
            criterion("slowest answer after an attack", robot.slowest_s, args.answer, "s"),
            criterion("service's exit code", abs(code), 0, ""),
            criterion("objects left", len(left), 0, "", str(left)),
        ],
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="of attacks and idle pieces together")
    parser.add_argument("--piece", type=float, default=1.0, help="of an attack, at the mean [s]")
    parser.add_argument("--period", default="1 ms", help="of the service's cycle")
    parser.add_argument("--driver", choices=("external", "simulated"), default="external")
    parser.add_argument("--seed", type=int, default=91)
    parser.add_argument("--slack", type=float, default=0.0, help="more long cycles allowed")
    parser.add_argument("--answer", type=float, default=ANSWER_S, help="longest wait for an answer [s]")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    if os.geteuid() != 0:
        raise SystemExit("bench_fuzz attacks as another user: run it as root")
    report = run(args, private_shm(256))
    if args.json:
        print(json.dumps(report))
    else:
        for kind, totals in report["runs"].items():
            print(f"{kind:10s}", ", ".join(f"{k} {v}" for k, v in totals.items()))
        print(*(f"{k}: {v}" for k, v in report.items() if k not in ("runs", "criteria")), sep="\n")
        print(*map(criterion_line, report["criteria"]), sep="\n")
    return 0 if all(b["ok"] for b in report["criteria"]) else 1


if __name__ == "__main__":
    sys.exit(main())
