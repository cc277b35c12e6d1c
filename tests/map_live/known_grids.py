"""The grids of a live map that are known."""

from __future__ import annotations

from surffollow.client import Client
from surffollow.shm import map_layout as ml


def known_grids(client: Client) -> int:
    return int((client.map_window().heights != ml.UNKNOWN).sum())
