"""A robot controller in Python: a path over the ground at 100 Hz, whose height follows the service's demands.

    surffollow start &
    surffollow status --wait 600    # until it is READY
    python controller.py surf 20 --plot run.png

The arm is a stand-in: an axis that reaches its setpoint within a speed limit. Put your own read_pose() and
move_to() in its place; the rest is what a real controller does. The path is a circle of 80 mm between the
boxes of the default simulated ground. The stand-off printed is that of the sensor.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import signal
import sys
import time

from surffollow.client import Demand, attach
from surffollow.errors import SurffollowError

TICK_NS = 10_000_000
STANDOFF_M = 0.1
SPEED_MPS = 0.05
ACCEL_MPS2 = 0.2  # along the path: at rest 0.25 s after the tick that missed the demand
CENTRE_M, RADIUS_M = (0.937, 0.6), 0.08
SETTLED_M = 0.5e-3  # the path begins when the demand was that small for SETTLED_TICKS
SETTLED_TICKS = 30


class Arm:
    """The stand-in: an axis that moves at most 0.2 m/s."""

    def __init__(self) -> None:
        self.x_m, self.y_m, self.z_m = CENTRE_M[0] + RADIUS_M, CENTRE_M[1], STANDOFF_M

    def read_pose(self) -> tuple[float, ...]:
        return (self.x_m, self.y_m, self.z_m, 0.0, 0.0, 0.0, 1.0)

    def move_to(self, path_m: float, z_m: float) -> None:
        most = 0.2 * TICK_NS * 1e-9
        self.z_m += max(-most, min(most, z_m - self.z_m))
        self.x_m = CENTRE_M[0] + RADIUS_M * math.cos(path_m / RADIUS_M)
        self.y_m = CENTRE_M[1] + RADIUS_M * math.sin(path_m / RADIUS_M)


def run(name: str, seconds: float) -> tuple[list[tuple[float, ...]], Demand]:
    """Drive the arm.

    Returns rows of time [s], x, y, z [m], stand-off by the sensor [m] and demand [m], and the last demand.
    """
    arm, rows = Arm(), []
    robot = attach(name)
    robot.claim_pose()  # who sends the pose may set parameters
    robot.sf_reset(STANDOFF_M)
    sent: dict[int, float] = {}  # height of the tool by the time that it was reported for
    setpoint_m, path_m, speed_mps, settled, following = arm.z_m, 0.0, 0.0, 0, False
    next_ns = start_ns = time.monotonic_ns()
    end_ns, demand = start_ns + round(seconds * 1e9), robot.dev_vector()
    while next_ns < end_ns:
        t_ns, pose = time.monotonic_ns(), arm.read_pose()
        sent[t_ns] = pose[2]
        posed = False
        with contextlib.suppress(SurffollowError):  # whatever the reason: nothing is followed in this tick
            robot.ee_pos(pose, t_ns)
            posed = True
        demand = robot.dev_vector()
        # without a valid demand (stale, in doubt, stopped): hold the height, brake along the path
        setpoint_m = pose[2] if following else setpoint_m
        following = posed and demand.valid and demand.pose_t_ns in sent
        if following:
            # the demand adds to the pose that it names, not to a newer one
            setpoint_m = sent[demand.pose_t_ns] + demand[2]
            settled += abs(demand[2]) < SETTLED_M
        expected = ACCEL_MPS2 if following and settled >= SETTLED_TICKS else -ACCEL_MPS2
        speed_mps = min(max(speed_mps + expected * TICK_NS * 1e-9, 0.0), SPEED_MPS)
        path_m += speed_mps * TICK_NS * 1e-9
        if following and speed_mps > 0.0:
            rows.append(((t_ns - start_ns) * 1e-9, *pose[:3], robot.raw_distance(), demand[2]))
        arm.move_to(path_m, setpoint_m)
        while len(sent) > 64:
            del sent[next(iter(sent))]
        next_ns += TICK_NS
        time.sleep(max(0.0, (next_ns - time.monotonic_ns()) * 1e-9))
    robot.close()
    return rows, demand


def plot(rows: list[tuple[float, ...]], path: str) -> None:
    """Draw height and stand-off over time (needs matplotlib: pip install '.[plot]')."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    t_s, _, _, z_m, range_m, _ = zip(*rows)
    figure, (height, error) = pyplot.subplots(2, sharex=True, figsize=(8, 5), layout="constrained")
    height.plot(t_s, [1e3 * z for z in z_m], label="tool")
    height.plot(t_s, [1e3 * (z - r) for z, r in zip(z_m, range_m)], label="ground by the sensor")
    height.set_ylabel("height [mm]")
    height.legend()
    error.plot(t_s, [1e3 * (r - STANDOFF_M) for r in range_m])
    error.set(ylabel="stand-off error [mm]", xlabel="time [s]")
    figure.savefig(path)


def main() -> int:
    words = argparse.ArgumentParser(description="Follow the ground of a surffollow service.")
    words.add_argument("service", nargs="?", default="surf")
    words.add_argument("seconds", nargs="?", type=float, default=20.0)
    words.add_argument("--plot", metavar="FILE", help="draw the run (PNG, SVG, PDF)")
    words.add_argument("--trace", metavar="FILE", help="write the run as CSV")
    options = words.parse_args()
    if not 0.0 < options.seconds <= 1e6:
        words.error("seconds: more than 0, at most 1e6")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        rows, demand = run(options.service, options.seconds)
    except SurffollowError as error:
        print(f"controller: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    if not rows:
        print(
            f"controller: the tool did not begin its path; the last demand was {' '.join(demand.names)}; "
            f"surffollow status --name {options.service} says more",
            file=sys.stderr,
        )
        return 1
    if options.trace:
        with open(options.trace, "w") as file:
            file.write("t_s,x_m,y_m,z_m,range_m,demand_m\n")
            file.writelines(",".join(f"{v:.9g}" for v in row) + "\n" for row in rows)
    errors = [row[4] - STANDOFF_M for row in rows if math.isfinite(row[4])]
    rms_mm = 1e3 * math.sqrt(sum(e * e for e in errors) / len(errors)) if errors else math.nan
    print(f"ticks {len(rows)} readings {len(errors)} standoff_rms_mm {rms_mm:.3f}")
    if options.plot:
        plot(rows, options.plot)
    return 0


if __name__ == "__main__":
    sys.exit(main())
