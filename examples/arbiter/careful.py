"""The client of the higher priority: turns the cart round whenever it is past 0.3 m."""

import sys
import time

from surffollow.arbiter import attach
from surffollow.blocks import F64, Block, mem_attach


class Cart(Block):
    """Where the cart is."""

    x = F64(unit="m")
    speed = F64(unit="m/s")


def main(name: str, seconds: float) -> None:
    """Watch for so long; take the cart only while it is too far."""
    turned = 0
    with attach(name, "careful", timeout_s=10.0) as arbiter, mem_attach(Cart, name, timeout_s=10.0) as memory:
        robot, end = arbiter.resource("robot"), time.monotonic() + seconds
        while time.monotonic() < end:
            x = memory.cart.latest()["x"]  # never through the arbiter
            if not robot.held and x > 0.3 and robot.request():
                turned += 1
            if robot.held:
                robot.command(-0.4, 0.0)
                if x < 0.1:
                    robot.relinquish()
            time.sleep(0.01)
    print(f"careful turned the cart round {turned} times")


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
