"""Poses and times for tests of the follower in process."""

from __future__ import annotations

MS = 1_000_000
T0 = 1_000 * MS
LEVEL = (0.0, 0.0, 0.0, 1.0)


def at(x, z, y=0.0):
    return (x, y, z, *LEVEL)
