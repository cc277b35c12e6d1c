"""ArbiterProcess arbiters and their children."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from arbiter.arbiter_process import ArbiterProcess, Child


@pytest.fixture(scope="module")
def arbiter(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ArbiterProcess]:
    """A server for the whole module; do not kill it, leave its resources free."""
    with ArbiterProcess(tmp_path_factory.mktemp("arbiter")).running() as one:
        yield one


@pytest.fixture
def make_arbiter(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., ArbiterProcess]]:
    """Servers of a test's own, not started."""
    made: list[ArbiterProcess] = []

    def make(**options: str) -> ArbiterProcess:
        made.append(ArbiterProcess(tmp_path_factory.mktemp("arbiter"), **options))
        return made[-1]

    yield make
    for one in made:
        one.purge()


@pytest.fixture
def child() -> Iterator[Callable[..., Child]]:
    """Forked clients that are gone when the test ends."""
    made: list[Child] = []

    def start(work: Callable[..., None]) -> Child:
        made.append(Child(work))
        return made[-1]

    yield start
    for one in made:
        one.kill()
