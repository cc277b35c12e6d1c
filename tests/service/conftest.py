"""Fixtures of the tests of the service."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from running_service import Service, World


@pytest.fixture
def killable(make_service: Callable[..., Service]) -> Iterator[Service]:
    """A service with a simulated sensor over flat ground."""
    s = make_service(kind="simulated", access='parameters = "any"')
    s.world = World(s.name)
    yield s.start()
    s.world.close()
