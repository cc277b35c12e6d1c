"""A client whose calls are answered, for tests of a service under strain."""

from __future__ import annotations

from collections.abc import Callable

from running_service import Service, until
from surffollow.client import Client

Make = Callable[..., Service]


def goes_on(client: Client) -> None:
    """The cycle and the housekeeping go on, and the service answers."""
    before = client.status()
    until(lambda: client.status()["cycles"] > before["cycles"] + 100, "100 cycles")
    until(lambda: client.status()["main"]["t_ns"] > before["main"]["t_ns"], "a heartbeat")
    client.set_params(max_demand="20 mm")
