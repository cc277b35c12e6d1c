"""Kill client, recorder and service in turn at random moments: all must heal with no manual step.

Each is killed by SIGKILL after a random time, start-up included, and started again at once, as an init
system would. Afterwards the others must find it by themselves. Counted: hangs (no healthy state within the
time limit), ends that nobody asked for, objects in /dev/shm beyond the service's own, and grids of the map
that were known before a kill and are not, or went back, after it (contents compared).
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import numpy as np  # noqa: E402

from report import criterion, finish  # noqa: E402
from running_service import READY_S, Service, World, config_text, objects_of, unique_name  # noqa: E402
from surffollow.client import observe  # noqa: E402
from surffollow.errors import SurffollowError  # noqa: E402
from surffollow.shm import map_layout as ml  # noqa: E402
from surffollow.shm.dtypes import numpy_dtype  # noqa: E402
from surffollow.shm.ending_signals import ended_by_signals  # noqa: E402
from surffollow.shm.objects import SharedObject  # noqa: E402

HEALTH_S = 90.0
MIN_KNOWN_GRIDS = 10  # grids before the first kill
GRIDS = 20_000
PARTS = ("client", "recorder", "service")
OWN = ("", ".sock", ".lock", ".map", ".world", ".world.lock")
# moves with the world: the tool's place is a function of the clock, and the client knows it
PLACE = "0.05 + 0.04 * math.cos(t), 0.05 + 0.04 * math.sin(1.3 * t), 0.1, 0.0, 0.0, 0.0, 1.0"
CLIENT = f"""
import math, sys, time
from surffollow.client import attach
from surffollow.errors import SurffollowError
client = None
n = 0
while True:
    time.sleep(0.004)
    t = time.monotonic()
    try:
        if client is None:
            client = attach(sys.argv[1])
        client.ee_pos(({PLACE}))
        client.dev_vector()
        n += 1
        if n % 25 == 0:
            client.set_params(interval_size="2 mm")
        if n % 60 == 0:
            with client.exclusive(timeout_s=1.0):
                pass
    except SurffollowError:
        pass
"""


class MovingWorld(World):
    """The true place of the tool, as the client reports it."""

    @property
    def pose(self) -> tuple[float, ...]:
        import math

        t = time.monotonic()
        return eval(PLACE, {"math": math, "t": t})  # type: ignore[no-any-return]

    @pose.setter
    def pose(self, value: Any) -> None:
        return


class Part:
    """One of the three programs, started again whenever it is killed."""

    def __init__(self, name: str, command: list[str], log: Path) -> None:
        self.name, self.command, self.log = name, command, log
        self.kills = self.own_ends = 0
        self.start()

    def start(self) -> None:
        with self.log.open("ab") as out:
            self.process = subprocess.Popen(self.command, stdout=out, stderr=out)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        self.kills += 1

    def restart_if_ended(self, may_end: bool) -> None:
        """Start it again when it ended by itself."""
        if self.process.poll() is not None:
            self.own_ends += not may_end
            self.start()


def map_of(name: str) -> tuple[Any, Any, tuple[Any, ...]] | None:
    """Heights, counts and shape of the kept map; None when there is none yet."""
    try:
        map_ = SharedObject.open(f"{name}.map")
    except SurffollowError:
        return None
    data = np.frombuffer(bytes(map_.memory), np.uint8)
    map_.close()
    header = data[: ml.MapHeader.SIZE].view(numpy_dtype(ml.MapHeader))[0]
    if header["state"] != ml.READY:
        return None
    n = int(header["nx"] * header["ny"])
    start = ml.pairs_offset()
    pairs = data[start : start + ml.PAIR_BYTES * ml.pairs_of(n)].view(numpy_dtype(ml.GridPair))
    shape = tuple(header[k] for k in ("nx", "ny", "grid_m", "x0_m", "y0_m", "quantum_m"))
    return pairs["h"].reshape(-1)[:n].copy(), pairs["c"].reshape(-1)[:n].copy(), shape


def lost_grids(before: Any, after: Any) -> int:
    """Grids that were known and are not, have fewer samples, or another height with the same samples."""
    if before is None:
        return 0
    if after is None or before[2] != after[2]:
        return int(np.count_nonzero(before[1]))
    (h0, c0, _), (h1, c1, _) = before, after
    known = h0 != ml.UNKNOWN
    # a kill between a height and its count leaves the count one behind, for that one grid
    changed = known & (c1 == c0) & (h1 != h0) & (c0 < ml.FULL_COUNT)
    gone = known & ((h1 == ml.UNKNOWN) | (c1 < c0))
    return int(np.count_nonzero(gone)) + max(0, int(np.count_nonzero(changed)) - 1)


class Trial:
    """The three programs, and what went wrong."""

    def __init__(self, folder: Path, seed: int, pause_s: float) -> None:
        self.rng, self.pause_s = random.Random(seed), pause_s
        name = unique_name("kill")
        self.service = Service(folder, config_text(kind="simulated", grids=GRIDS, access='map = "any"'), name)
        self.name, self.folder = name, folder
        self.world = MovingWorld(name)
        self.hangs = self.leaked = self.lost = self.known = 0
        self.slowest_s = 0.0
        self.reference: Any = None
        self.parts: dict[str, Part] = {}

    def begin(self) -> None:
        """Start them, and wait until all is well."""
        name, folder = self.name, self.folder
        command = [sys.executable, "-m", "surffollow"]
        start = [*command, "start", "--quiet", "--name", name, "--config", str(self.service.config)]
        self.parts["service"] = Part("service", start, folder / "service.log")
        self.wait(self.answers, READY_S)  # the first start may have to compile the kernels
        self.slowest_s = 0.0
        client = [sys.executable, "-c", CLIENT, name]
        self.parts["client"] = Part("client", client, folder / "client.log")
        record = [*command, "record", "--force", "--name", name, "--out", str(folder / "log.mcap")]
        self.parts["recorder"] = Part("recorder", record, folder / "recorder.log")
        self.wait(self.healthy)
        with self.service.attach() as one:
            one.map_reset((0.0, 0.0, 0.1, 0.1))
        self.wait(self.enough_known)

    def enough_known(self) -> bool:
        """The map holds something that could be lost."""
        now = map_of(self.name)
        return now is not None and int(np.count_nonzero(now[0] != ml.UNKNOWN)) > MIN_KNOWN_GRIDS

    def answers(self) -> bool:
        try:
            with observe(self.name) as watcher:
                # for 20 ms after a kill the dead service's last demand still counts as fresh
                return watcher.alive() and watcher.board.pid == self.parts["service"].process.pid
        except SurffollowError:
            return False

    def healthy(self) -> bool:
        """The service runs, takes the client's poses and applies their samples; the recorder writes."""
        if any(p.process.poll() is not None for p in self.parts.values()):
            return False
        try:
            with observe(self.name) as watcher:
                first, size, end = watcher.status(), self.recorded(), time.monotonic() + 2.0
                while time.monotonic() < end:
                    time.sleep(0.02)
                    now = watcher.status()
                    if (
                        now["alive"]
                        and now["poses"] > first["poses"] + 3
                        and now["map"].get("applied", 0) > first["map"].get("applied", 0)
                        and self.recorded() > size
                    ):
                        return True
        except SurffollowError:
            pass
        return False

    def recorded(self) -> int:
        path = self.folder / "log.mcap"
        return path.stat().st_size if path.exists() else 0

    def wait(self, condition: Callable[[], bool], seconds: float = HEALTH_S) -> None:
        """Until all is well; a hang when it is not in time."""
        start = time.monotonic()
        while not condition():
            for part in self.parts.values():
                # without a service there is nothing to record: an init system tries again
                part.restart_if_ended(may_end=part.name == "recorder")
            if time.monotonic() - start > seconds:
                self.hangs += 1
                return
            time.sleep(0.02)
        self.slowest_s = max(self.slowest_s, time.monotonic() - start)

    def kill_one(self, number: int, check: bool) -> None:
        part = self.parts[PARTS[number % 3]]
        time.sleep(self.rng.random() ** 2 * self.pause_s)
        if part.process.poll() is not None:
            part.restart_if_ended(may_end=part.name == "recorder")
        part.kill()
        if part.name == "service":
            self.compare()
        self.leaked += len(objects_of(self.name) - {self.name + o for o in OWN})
        part.start()
        if check:
            self.wait(self.healthy)

    def compare(self) -> None:
        """Compare the map, which has no writer now, with the one at the service's last death."""
        now = map_of(self.name)
        self.lost += lost_grids(self.reference, now)
        self.reference = now
        if now is not None:
            self.known = int(np.count_nonzero(now[0] != ml.UNKNOWN))

    def end(self) -> set[str]:
        """Stop in good order; what is left of it."""
        self.wait(self.healthy)
        stopped = {name: self.parts.pop(name) for name in ("client", "recorder")}
        for part in (*stopped.values(), self.parts["service"]):
            part.kill()
        self.compare()
        self.world.close()
        self.parts["service"].start()
        self.wait(self.answers)
        self.parts |= stopped
        self.service.run("stop", "--purge")
        self.parts["service"].process.wait(timeout=30)
        return objects_of(self.name) - {f"{self.name}.world"}


def run(args: argparse.Namespace) -> dict[str, Any]:
    start = time.monotonic()
    with ended_by_signals(), tempfile.TemporaryDirectory() as folder:
        trial = Trial(Path(folder), args.seed, args.pause)
        try:
            trial.begin()
            for number in range(args.kills):
                trial.kill_one(number, check=number % args.every == args.every - 1)
                if trial.hangs > 3 or time.monotonic() - start > args.seconds:
                    break
                if number % 50 == 49:
                    print(
                        f"{number + 1} kills, {time.monotonic() - start:.0f} s", file=sys.stderr, flush=True
                    )
            left = trial.end()
        finally:
            for part in trial.parts.values():
                part.process.kill()
                part.process.wait()
            trial.service.purge()
            logs = {p.name: (Path(folder) / f"{p.name}.log").read_text()[-600:] for p in trial.parts.values()}
    ends = {p.name: p.own_ends for p in trial.parts.values()}
    kills = {p.name: p.kills for p in trial.parts.values()}
    return {
        "what": f"{sum(kills.values())} SIGKILLs at random moments, seed {args.seed}: {kills}",
        "machine": f"{time.monotonic() - start:.0f} s",
        "kills": kills,
        "seed": args.seed,
        "known_grids": trial.known,
        "criteria": [
            criterion("hangs", trial.hangs, 0, "", f"slowest recovery {trial.slowest_s:.1f} s"),
            criterion("ends that nobody asked for", sum(ends.values()), 0, "", str(ends)),
            criterion("objects leaked in /dev/shm", trial.leaked + len(left), 0, "", str(sorted(left))),
            criterion("grids lost", trial.lost, 0, "", f"{trial.known} known at the end"),
        ],
        "notes": [f"{k}: {v}" for k, v in logs.items() if sum(ends.values()) or trial.hangs],
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=3600.0, help="begin no kill after so long")
    parser.add_argument("--every", type=int, default=20, help="wait for health after so many kills")
    parser.add_argument("--pause", type=float, default=0.9, help="longest time from one kill to the next [s]")
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(1 << 31))
    parser.add_argument("--json", action="store_true")
    return finish(run(parser.parse_args()))


if __name__ == "__main__":
    sys.exit(main())
