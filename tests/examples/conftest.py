"""A service for the example controllers."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from running_service import Service


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service as `surffollow start` starts it without a configuration."""
    with Service(tmp_path_factory.mktemp("bare"), "").running() as service:
        yield service
