"""Take away service, controller or driver while the simulated robot moves: is its tool at rest in time?

The body and its drives run here, in wall time; controller and service are processes of their own. In turn,
after a random time of motion at full speed: SIGKILL to the service, SIGSTOP to the service, SIGKILL to the
controller, no more news from the driver, a stop asked for by another client. From the stated time on the tool
must be at rest along the path, and hold its height or retract (docs/reference/protocol.md, "Stop").
`--retract` lets it retract by 20 mm.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import numpy as np  # noqa: E402

from report import finish  # noqa: E402
from report import result as bench_result  # noqa: E402
from running_service import Service, config_text, unique_name  # noqa: E402
from stop_controller import COMMAND, REPORT  # noqa: E402
from surffollow.client import Client  # noqa: E402
from surffollow.client import attach as attach_to  # noqa: E402
from surffollow.errors import NotRunningError, SurffollowError  # noqa: E402
from surffollow.shm.ending_signals import ended_by_signals  # noqa: E402
from surffollow.shm.latch_shape import latch_bytes  # noqa: E402
from surffollow.sim.hardware_priority import hardware_priority  # noqa: E402
from surffollow.sim.robot import RobotCore  # noqa: E402
from surffollow.sim.robot_config import RobotConfig  # noqa: E402
from surffollow.sim.robot_stop import REST_MPS, time_to_rest_s  # noqa: E402
from surffollow.sim.world import WorldPose, WorldWriter  # noqa: E402
from surffollow.sim.world_surface import WorldConfig  # noqa: E402

TICK_NS = 10_000_000
STALE_S, LOSS_S, HEARTBEAT_S = 0.02, 0.3, 0.05
HOST_S = 0.1  # a busy host's share: time taken from controller and service
KINDS = ("service killed", "service stopped", "controller killed", "driver silent", "stop requested")
REGION = (0.0, 0.0, 1.0, 0.2)
HEALTH_S = 120.0


def noticed_s(kind: str, config: RobotConfig) -> float:
    """Time from the event until a tick of the controller, or the drives' watchdog, misses the demand [s]."""
    return {
        "service killed": STALE_S,
        "service stopped": STALE_S,
        "controller killed": config.command_timeout_s,
        "driver silent": LOSS_S + HEARTBEAT_S,
        "stop requested": 0.002,
    }[kind]


class Rig:
    """Body, drives, controller and service around one robot."""

    def __init__(self, folder: Path, retract_m: float) -> None:
        text = config_text(
            kind="simulated", follow=f'loss_timeout = "{LOSS_S} s"', driver="", access='parameters = "holder"'
        ).replace("region = [0.0, 0.0, 0.1, 0.1]", f"region = {list(REGION)}")
        self.service = Service(folder, text, unique_name("stop"))
        config = WorldConfig(surface="flat", region=REGION)
        self.config = RobotConfig(world=config, seconds=0.0, retract_m=retract_m)
        self.core = RobotCore(self.config, config.make(), time.monotonic_ns())
        self.core.advance(self.core.t_ns + 2_000_000)
        self.world = WorldWriter(self.service.name)
        self.nowhere = np.zeros(latch_bytes(WorldPose.SIZE) // 8 + 8, np.int64)
        self.blind = False
        self.controller: subprocess.Popen[bytes] | None = None
        self.link, self.far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.healing: threading.Thread | None = None

    def start_controller(self) -> None:
        self.link.close()
        self.far.close()
        self.link, self.far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.link.setblocking(False)
        words = [
            sys.executable,
            str(ROOT / "tools" / "stop_controller.py"),
            self.service.name,
            str(self.far.fileno()),
        ]
        self.controller = subprocess.Popen(words, pass_fds=[self.far.fileno()])

    def tick(self) -> None:
        """One tick of the body: reports out, commands in, 10 ms of motion."""
        core = self.core
        core.measure()
        for t_ns, pose in core.reports():
            with contextlib.suppress(OSError):
                self.link.send(REPORT.pack(0, t_ns, *pose))
        with contextlib.suppress(OSError):
            while True:
                follow, pose_t_ns, z = COMMAND.unpack(self.link.recv(COMMAND.size))
                if follow:
                    core.command(z, pose_t_ns)
                else:
                    core.hold()
        core.watch_commands()
        core.advance(core.t_ns + TICK_NS, int(self.nowhere.ctypes.data) if self.blind else self.world.latch)

    @property
    def speed_mps(self) -> float:
        return float(self.core.motion["speed_mps"][0])

    def at_rest(self) -> bool:
        """At rest along the path, and vertically at rest or on the way up."""
        return self.speed_mps == 0.0 and float(self.core.motion["axis"][0, 1]) > -REST_MPS

    def take_away(self, kind: str, other: Client | None) -> None:
        if kind == "service killed":
            self.service.kill()
        elif kind == "service stopped":
            self.service.send(signal.SIGSTOP)
        elif kind == "controller killed":
            assert self.controller is not None
            self.controller.kill()
        elif kind == "driver silent":
            self.blind = True
        else:
            assert other is not None
            while not self._stops(other):
                self.tick()

    @staticmethod
    def _stops(other: Client) -> bool:
        """Whether the request is sent; after a restart the client gets its slot in steps."""
        try:
            other.stop("bench", wait=False)
        except NotRunningError:
            return False
        return True

    def heal(self, kind: str) -> None:
        """Give back what was taken away; a thread, for the body goes on meanwhile."""
        if kind == "service killed":
            self.service.start()
        elif kind == "service stopped":
            self.service.send(signal.SIGCONT)
        elif kind == "controller killed":
            assert self.controller is not None
            self.controller.wait()
            self.start_controller()
        elif kind == "driver silent":
            self.blind = False
        else:
            self.link.send(REPORT.pack(1, 0, *[0.0] * 7))

    def state(self) -> str:
        """Name what holds the robot, for a failure's report."""
        assert self.controller is not None
        z_m = float(self.core.motion["axis"][0, 0])
        late_s = 1e-9 * (time.monotonic_ns() - self.core.t_ns)
        status = self.service.run("status")
        return (
            f"tool at {z_m:.4f} m, {'holding' if self.core.holding else 'following'}, {late_s:.3f} s late; "
            f"exit code of the controller {self.controller.poll()}; service:\n{status.stdout}{status.stderr}"
        )

    def close(self) -> None:
        if self.controller is not None:
            self.controller.kill()
            self.controller.wait()
        self.world.close()
        self.service.purge()


def until_moving(rig: Rig, extra_s: float) -> bool:
    """Tick until the robot has moved at full speed for so long; False when it never does."""
    end, since = time.monotonic() + HEALTH_S, 0.0
    while time.monotonic() < end:
        rig.tick()
        if rig.speed_mps < 0.9 * rig.config.speed_mps:
            # at the path's end it turns, which is no trial
            since = 0.0
        elif since == 0.0:
            since = time.monotonic()
        elif time.monotonic() > since + extra_s:
            return True
    return False


def trial(rig: Rig, kind: str, extra_s: float, other: Client | None) -> tuple[float | None, float]:
    """Take one thing away: (seconds to rest; None: not in time or not for good, stated seconds)."""
    stated_s = noticed_s(kind, rig.config) + time_to_rest_s(rig.config) + HOST_S
    rig.take_away(kind, other)
    began, rested = time.monotonic(), None
    while (passed := time.monotonic() - began) < stated_s + 0.2:
        rig.tick()
        if not rig.at_rest():
            if passed > stated_s:
                return None, stated_s
            rested = None
        elif rested is None:
            rested = passed
    return rested, stated_s


def run(trials: int, seed: int, retract_m: float) -> dict[str, Any]:
    """All trials, in turn by kind."""
    rng = random.Random(seed)
    times: dict[str, list[float]] = {k: [] for k in KINDS}
    failed: list[str] = []
    with ended_by_signals(), tempfile.TemporaryDirectory() as folder:
        rig = Rig(Path(folder), retract_m)
        try:
            rig.service.start()
            rig.core.restart_clock(time.monotonic_ns())
            rig.start_controller()
            other: Client | None = None
            for n in range(trials):
                kind, extra_s = KINDS[n % len(KINDS)], rng.uniform(0.0, 0.3)
                if not until_moving(rig, extra_s):
                    failed.append(f"{n}: the robot does not move again before {kind}: {rig.state()}")
                    break
                with contextlib.suppress(SurffollowError):
                    other = other or attach_to(rig.service.name, stale_min_s=1.0)
                rested, stated_s = trial(rig, kind, extra_s, other)
                if rested is None:
                    failed.append(f"{n}: {kind}: not at rest within {stated_s:.3f} s")
                else:
                    times[kind].append(rested)
                healing = threading.Thread(target=rig.heal, args=(kind,))
                healing.start()
                while healing.is_alive():
                    rig.tick()
                if n % 50 == 49:
                    print(
                        f"bench_stop: {n + 1} of {trials}, {len(failed)} failed", file=sys.stderr, flush=True
                    )
        finally:
            rig.close()
    done = sum(len(v) for v in times.values())
    config = rig.config
    rows = {
        kind: {
            "trials": len(v),
            "stated_s": round(noticed_s(kind, config) + time_to_rest_s(config) + HOST_S, 3),
            "median_s": round(float(np.median(v)), 3) if v else None,
            "longest_s": round(max(v), 3) if v else None,
        }
        for kind, v in times.items()
    }
    missed = {
        "criterion": "trials not at rest in time",
        "got": trials - done,
        "limit": 0,
        "unit": "",
        "sense": "≤",
    }
    criteria = [missed | {"ok": done == trials, "note": f"{done} of {trials} in time; seed {seed}"}]
    notes = [
        f"{kind:<18} {r['trials']:>4} trials, stated {r['stated_s']} s, median {r['median_s']} s, "
        f"longest {r['longest_s']} s"
        for kind, r in rows.items()
    ]
    what = f"seconds from a random loss to rest, {'retracting' if retract_m else 'holding'} height"
    return bench_result(
        what, criteria, [*notes, *failed], kinds=rows, failed=failed, trials=trials, seed=seed
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--retract", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with hardware_priority():
        return finish(run(options.trials, options.seed, 0.02 if options.retract else 0.0))


if __name__ == "__main__":
    sys.exit(main())
