"""A laser of your own, pushed into the service, and a controller that follows the ground which it sees.

    surffollow start --config laser.toml &
    surffollow status --wait 600    # until it is READY
    python push_range.py surf 20

laser.toml:

    [driver]
    kind = "external"
    range_min_m = "50 mm"
    range_max_m = "150 mm"

Laser and ground are pretended: put your sensor's range into Laser.measure(). The arm is a stand-in, too;
controller.py explains the loop. The stand-off printed is the true one, which only a pretended ground tells.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import random
import signal
import sys
import threading
import time

from surffollow.client import attach
from surffollow.errors import SurffollowError

TICK_NS = 10_000_000
STANDOFF_M = 0.1
SPEED_MPS = 0.05
ACCEL_MPS2 = 0.2
SETTLED_M, SETTLED_TICKS = 0.5e-3, 30
LASER_PERIOD_S, LASER_NOISE_M = 0.002, 0.05e-3


def ground_m(x_m: float) -> float:
    """The pretended ground: rolling, 9 mm from valley to hill."""
    return 3e-3 * math.sin(x_m / 0.04) + 1.5e-3 * math.sin(x_m / 0.013 + 1.0)


class Arm:
    """The stand-in: it moves evenly to what it was told last, at most 0.2 m/s up or down."""

    def __init__(self) -> None:
        self.move = (time.monotonic_ns(), 0.0, STANDOFF_M, 0.0, STANDOFF_M)

    def at(self, t_ns: int) -> tuple[float, float]:
        began_ns, x_m, z_m, to_x_m, to_z_m = self.move
        part = min(max((t_ns - began_ns) / TICK_NS, 0.0), 1.0)
        return x_m + part * (to_x_m - x_m), z_m + part * (to_z_m - z_m)

    def move_to(self, t_ns: int, x_m: float, z_m: float) -> None:
        now_x_m, now_z_m = self.at(t_ns)
        most = 0.2 * TICK_NS * 1e-9
        self.move = (t_ns, now_x_m, now_z_m, x_m, now_z_m + max(-most, min(most, z_m - now_z_m)))


class Laser(threading.Thread):
    """Measures 500 times a second and pushes each range as a client of its own."""

    def __init__(self, name: str, arm: Arm) -> None:
        super().__init__(daemon=True)
        self.client, self.arm, self.over = attach(name, label="laser"), arm, threading.Event()
        self.client.claim_range(0)

    def measure(self) -> tuple[int, float]:
        t_ns = time.monotonic_ns()
        x_m, z_m = self.arm.at(t_ns)
        return t_ns, z_m - ground_m(x_m) + random.gauss(0.0, LASER_NOISE_M)

    def run(self) -> None:
        while not self.over.wait(LASER_PERIOD_S):
            t_ns, range_m = self.measure()
            with contextlib.suppress(SurffollowError):  # the service is away
                self.client.push_range(0, t_ns, range_m if range_m < 0.15 else None)


def run(name: str, seconds: float) -> list[float]:
    """Follow the ground; true stand-off errors [m]."""
    arm, errors = Arm(), []
    laser, robot = Laser(name, arm), attach(name, label="robot")
    robot.claim_pose()
    robot.sf_reset(STANDOFF_M)
    laser.start()
    sent: dict[int, float] = {}
    setpoint_m, path_m, speed_mps, settled, following = STANDOFF_M, 0.0, 0.0, 0, False
    next_ns = start_ns = time.monotonic_ns()
    while next_ns < start_ns + round(seconds * 1e9):
        t_ns = time.monotonic_ns()
        x_m, z_m = arm.at(t_ns)
        sent[t_ns] = z_m
        with contextlib.suppress(SurffollowError):
            robot.ee_pos((x_m, 0.0, z_m, 0.0, 0.0, 0.0, 1.0), t_ns)
        demand = robot.dev_vector()
        setpoint_m = z_m if following else setpoint_m
        following = demand.valid and demand.pose_t_ns in sent
        if following:
            setpoint_m = sent[demand.pose_t_ns] + demand[2]
            settled += abs(demand[2]) < SETTLED_M
        expected = ACCEL_MPS2 if following and settled >= SETTLED_TICKS else -ACCEL_MPS2
        speed_mps = min(max(speed_mps + expected * TICK_NS * 1e-9, 0.0), SPEED_MPS)
        path_m += speed_mps * TICK_NS * 1e-9
        if following and speed_mps > 0.0:
            errors.append(z_m - ground_m(x_m) - STANDOFF_M)
        arm.move_to(t_ns, path_m, setpoint_m)
        while len(sent) > 64:
            del sent[next(iter(sent))]
        next_ns += TICK_NS
        time.sleep(max(0.0, (next_ns - time.monotonic_ns()) * 1e-9))
    laser.over.set()
    laser.join()
    laser.client.close()
    robot.close()
    return errors


def main() -> int:
    words = argparse.ArgumentParser(description="Follow a pretended ground with a laser of your own.")
    words.add_argument("service", nargs="?", default="surf")
    words.add_argument("seconds", nargs="?", type=float, default=20.0)
    options = words.parse_args()
    if not 0.0 < options.seconds <= 1e6:
        words.error("seconds: more than 0, at most 1e6")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        errors = run(options.service, options.seconds)
    except SurffollowError as error:
        print(f"push_range: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    rms_mm = 1e3 * math.sqrt(sum(e * e for e in errors) / len(errors)) if errors else math.nan
    print(f"ticks {len(errors)} standoff_rms_mm {rms_mm:.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
