"""A simulated cart, the low-level controller of the resource `robot`: it obeys the newest command."""

import sys
import time

from surffollow.arbiter import command_reader
from surffollow.blocks import F64, Block, mem_attach


class Cart(Block):
    """Where the cart is."""

    x = F64(unit="m")
    speed = F64(unit="m/s")


def main(name: str, seconds: float) -> None:
    """Drive for so long, 100 times a second."""
    end = time.monotonic() + seconds
    with command_reader(name, "robot") as reader, mem_attach(Cart, name, write=True) as memory:
        x = 0.0
        while time.monotonic() < end:
            command = reader.latest()
            speed = command.values[0] if command.values else 0.0
            x += speed * 0.01
            with memory.cart.write() as cart:
                cart.x, cart.speed = x, speed
            time.sleep(0.01)
    print(f"the cart ended at {x:.2f} m")


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
